"""Export of the plots of a model's page as PNG and CSV."""

from __future__ import annotations

import csv
from typing import TYPE_CHECKING

import pytest

from tests.service.data import stream, train, upload
from tests.system.browser.accessibility import expect
from tests.system.browser.conftest import Dashboard
from tests.system.browser.visitor import Visitor

if TYPE_CHECKING:
    from pathlib import Path

    from playwright.sync_api import Page

PNG = b"\x89PNG"
SAMPLES = 60
INTERVAL = "predicted, low", "predicted", "predicted, high"


@pytest.fixture(scope="module")
def model(dashboard: Dashboard) -> str:
    """A model with two versions, held out part in its evaluation."""
    for seed in (51, 52):
        data = upload(dashboard.client, stream(samples=SAMPLES, seed=seed), name=f"exports {seed}")["id"]
        train(dashboard.client, "exports", data, holdout={"kind": "last", "share": 0.3})
    return "exports"


def saved(page: Page, name: str, kind: str) -> Path:
    """Press an export button and return the file."""
    with page.expect_download() as download:
        page.get_by_role("button", name=f"Save {name} as {kind}").click()
    assert download.value.suggested_filename == f"{name.replace(', ', '-').replace(' ', '-')}.{kind.lower()}"
    return download.value.path()


def drawn(visitor: Visitor, route: str) -> Page:
    """Open a page and wait for its plots."""
    page = visitor.open(route)
    expect(page.locator(".js-plotly-plot").first).to_be_visible()
    return visitor.drawn()


def numbers(path: Path) -> list[dict[str, str]]:
    """Return the rows of a CSV file by heading."""
    return list(csv.DictReader(path.read_text().splitlines()))


def test_plots_of_the_accuracy_are_saved(visitor: Visitor, model: str) -> None:
    page = drawn(visitor, f"#/models/{model}?part=all")
    for name in ("torque", "reliability", "error by segment"):
        assert saved(page, f"{name} of {model} 2", "PNG").read_bytes().startswith(PNG), name
    torque = numbers(saved(page, f"torque of {model} 2", "CSV"))
    assert [row["joint"] for row in torque] == ["joint1"] * SAMPLES + ["joint2"] * SAMPLES
    assert [float(row["measured"]) for row in torque[:3]] == pytest.approx(stream(samples=SAMPLES, seed=52).tau[:3, 0])
    assert all(low < mean < high for low, mean, high in ([float(row[key]) for key in INTERVAL] for row in torque))
    page.get_by_label("Joint", exact=True).select_option("joint2")
    assert {row["joint"] for row in numbers(saved(page, f"torque of {model} 2", "CSV"))} == {"joint2"}
    reliability = numbers(saved(page, f"reliability of {model} 2", "CSV"))
    assert {row["joint"] for row in reliability} == {"joint1", "joint2"}
    assert all(0 <= float(row["observed coverage"]) <= 1 for row in reliability)
    segments = numbers(saved(page, f"error by segment of {model} 2", "CSV"))
    assert sum(int(row["samples"]) for row in segments) == 2 * SAMPLES


def test_components_are_saved(visitor: Visitor, model: str) -> None:
    page = drawn(visitor, f"#/models/{model}?part=all&tab=parts")
    assert saved(page, f"components of {model} 2", "PNG").read_bytes().startswith(PNG)
    rows = numbers(saved(page, f"components of {model} 2", "CSV"))
    assert len(rows) == 2 * SAMPLES
    assert {"gravity", "gravity, low", "friction, high"} <= rows[0].keys()


def test_comparison_is_saved(visitor: Visitor, model: str) -> None:
    page = visitor.open(f"#/models/{model}?tab=versions")
    page.get_by_role("button", name="Compare", exact=True).click()
    expect(page.locator(".joint-plots .js-plotly-plot").first).to_be_visible()
    visitor.drawn()
    name = f"versions 2, 1 of {model}"
    assert saved(page, name, "PNG").read_bytes().startswith(PNG)
    rows = numbers(saved(page, name, "CSV"))
    assert {"measured", "version 1", "version 2"} <= rows[0].keys()
    assert rows[0]["version 1"] != rows[0]["version 2"]
