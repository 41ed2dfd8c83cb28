"""The dashboard of a service without extras: it shows what there is, and explains what is missing."""

from pathlib import Path

import pytest

from tests.browser.accessibility import audit, expect
from tests.browser.conftest import Visit
from tests.packaging.test_pieces import without
from tests.service.data import columns, csv, stream
from tests.service.server import Server

pytestmark = pytest.mark.slow
INGEST, ROBOTS = "pip install 'lipserve[ingest]'", "pip install 'lipserve[robots]'"


def test_what_is_missing_is_explained_where_it_is_wanted(windows: Visit, tmp_path: Path) -> None:
    with Server(tmp_path / "home", **without("pyarrow", "pinocchio")) as server:
        visitor = windows(server.url)
        visitor.expect_refusals(501)
        page = visitor.open("#/data")
        expect(page.get_by_text(INGEST)).to_be_visible()
        page.get_by_text("How to read it").click()
        expect(page.get_by_text(ROBOTS)).to_be_visible()
        expect(page.get_by_role("button", name="Add a URDF")).to_be_disabled()
        expect(page.get_by_role("button", name="Choose files")).to_be_enabled()
        assert audit(page) == []
        recording = {"name": "a.csv", "mimeType": "text/csv", "buffer": csv(columns(stream(seed=11)))}
        page.locator("input[type=file]").first.set_input_files([recording])
        page.get_by_role("button", name="Upload", exact=True).click()
        expect(page.get_by_role("alert")).to_contain_text(INGEST)
