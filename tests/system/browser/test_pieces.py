"""Dashboard of a service without extras."""

from pathlib import Path

from tests.packaging.test_pieces import without
from tests.service.data import columns, csv, stream
from tests.service.server import Server
from tests.system.browser.accessibility import audit, expect
from tests.system.browser.conftest import Visit

INGEST, ROBOTS = "pip install 'lipserve[ingest]'", "pip install 'lipserve[robots]'"


def test_missing_extras_are_explained_beside_their_controls(windows: Visit, tmp_path: Path) -> None:
    with Server(tmp_path / "home", **without("pyarrow", "pinocchio")) as server:
        visitor = windows(server.url)
        visitor.expect_refusals(501)
        page = visitor.open("#/data")
        expect(page.get_by_text(INGEST)).to_be_visible()
        page.get_by_text("Import options: robot").click()
        expect(page.get_by_text(ROBOTS)).to_be_visible()
        expect(page.get_by_role("button", name="Add a URDF")).to_be_disabled()
        expect(page.get_by_role("button", name="Choose files")).to_be_enabled()
        assert audit(page) == []
        recording = {"name": "a.csv", "mimeType": "text/csv", "buffer": csv(columns(stream(seed=11)))}
        page.get_by_label("Recordings to upload").set_input_files([recording])
        page.get_by_role("button", name="Upload", exact=True).click()
        expect(page.get_by_role("alert")).to_contain_text(INGEST)
