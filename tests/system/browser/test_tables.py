"""Tables of models, versions and jobs: quality, sorting, filters, comparison, held-out check."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import pytest

from tests.service.data import stream, train, upload
from tests.system.browser.accessibility import audit, expect
from tests.system.browser.conftest import Dashboard, Visit
from tests.system.browser.visitor import PHONE, Visitor

if TYPE_CHECKING:
    from playwright.sync_api import Locator


@pytest.fixture(scope="module")
def rows(dashboard: Dashboard) -> dict[str, Any]:
    """A model of three versions as in the API; the last one has no held-out rows."""
    dataset = upload(dashboard.client, stream(samples=160, seed=31), name="compared.npz")["id"]
    held = {"kind": "last", "share": 0.3}
    train(dashboard.client, "three", dataset, holdout=held)
    train(dashboard.client, "three", dataset, estimator="se", holdout=held)
    train(dashboard.client, "three", dataset, estimator="gip")
    return dashboard.client.get("/v1/models/three").json()


def keys(table: Locator) -> list[str]:
    """Return the keys of the rows in order."""
    return [str(each.get_attribute("data-key")) for each in table.locator("tbody tr").all()]


def largest_error(version: dict[str, Any]) -> float:
    """Return the largest error of a joint, in per cent of the range of its torque."""
    return 100 * float(max(each["range_share"] for each in version["verdict"]["joints"]))


def test_versions_are_sorted_by_quality(visitor: Visitor, rows: dict[str, Any]) -> None:
    page = visitor.open("#/models/three?tab=versions")
    table = page.get_by_role("table", name="Versions, newest first")
    assert keys(table) == ["3", "2", "1"]
    for version in rows["versions"][:2]:
        row = table.locator(f'tr[data-key="{version["version"]}"]')
        expect(row).to_contain_text(version["verdict"]["label"])
        expect(row).to_contain_text(f"{largest_error(version):.1f}")
    expect(table.locator('tr[data-key="3"]')).to_contain_text("not judged")

    by_error = sorted(rows["versions"][:2], key=largest_error)
    order = [str(each["version"]) for each in by_error]
    head = table.get_by_role("columnheader", name="Error")
    head.get_by_role("button").click()
    expect(head).to_have_attribute("aria-sort", "ascending")
    assert keys(table) == [*order, "3"]
    head.get_by_role("button").click()
    expect(head).to_have_attribute("aria-sort", "descending")
    assert keys(table) == [*reversed(order), "3"], "unknown values stay last"
    head.get_by_role("button").click()
    expect(head).to_have_attribute("aria-sort", "none")
    assert keys(table) == ["3", "2", "1"]
    assert audit(page) == []


def test_version_shows_the_reason_of_its_verdict(visitor: Visitor, rows: dict[str, Any]) -> None:
    page = visitor.open("#/models/three?tab=versions")
    table = page.get_by_role("table", name="Versions, newest first")
    verdicts = {number: rows["versions"][number - 1]["verdict"] for number in (1, 3)}
    for number, verdict in verdicts.items():
        judged = table.locator(f'tr[data-key="{number}"]').locator(".why")
        expect(judged.locator("summary")).to_contain_text(verdict["label"])
        judged.locator("summary").click()
        expect(judged.get_by_text(verdict["reason"])).to_be_visible()
    page.get_by_role("button", name="Serve: version 1").click()
    dialog = page.get_by_role("dialog")
    expect(dialog).to_contain_text(f"Verdict: {verdicts[1]['label']}. {verdicts[1]['reason']}")
    dialog.get_by_role("button", name="Cancel").click()
    page = visitor.open("#/models/three?version=1&tab=lineage")
    expect(page.get_by_role("main").get_by_text(verdicts[1]["reason"]).first).to_be_visible()


def test_three_versions_are_compared_in_one_plot(
    visitor: Visitor, windows: Visit, dashboard: Dashboard, rows: dict[str, Any]
) -> None:
    page = visitor.open("#/models/three?tab=versions")
    choices = page.get_by_role("group", name="Versions")
    expect(choices.get_by_role("checkbox", checked=True)).to_have_count(2)
    choices.get_by_label(re.compile("3, gip")).uncheck()
    choices.get_by_label(re.compile("1, lip-chain")).uncheck()
    choices.get_by_label(re.compile("2, se")).uncheck()
    expect(page.get_by_text("Select at least two versions.")).to_be_visible()
    expect(page.get_by_role("button", name="Compare", exact=True)).to_be_disabled()
    for box in choices.get_by_role("checkbox").all():
        box.check()
    recording = page.get_by_label("Recording", exact=True)
    recording.select_option(label=str(recording.locator("option", has_text="compared.npz").first.text_content()))
    page.get_by_role("button", name="Compare", exact=True).click()
    plots = page.get_by_role("region", name="Torques along the recording")
    expect(plots.locator(".js-plotly-plot:has(.main-svg)")).to_have_count(2)
    visitor.settled()
    named = plots.locator(".js-plotly-plot").first.evaluate("(each) => each.data.map((line) => line.name)")
    assert named[0] == f"version {rows['serving_version']}"
    assert sorted(named) == ["version 1", "version 2", "version 3"]
    plots.get_by_label("Show", exact=True).select_option("measured and predicted torque")
    first = plots.locator(".js-plotly-plot").first
    visitor.until(lambda: "measured" in first.evaluate("(each) => each.data.map((line) => line.name)"))
    drawn = first.evaluate(
        "(each) => each.data.map((line) => [line.name, line.line.dash, line.line.color, [...line.y]])"
    )
    assert len({colour for _, _, colour, _ in drawn}) == 4
    assert len({dash for name, dash, _, _ in drawn if name != "measured"}) == 3
    dataset = str(recording.input_value())
    for name, _, _, values in drawn[1:]:
        asked = {"dataset": dataset, "version": int(name.split()[1]), "points": 1000}
        trace = dashboard.client.post("/v1/models/three/trace", json=asked).json()
        assert values == pytest.approx([row[0] for row in trace["mean"]], rel=1e-6)
    expect(page.get_by_text("trained on this recording: optimistic")).to_have_count(3)
    expect(page.get_by_text(", by joint")).to_have_count(2)
    assert audit(page) == []
    phone = windows(dashboard.server.url, size=PHONE, scheme="dark", touch=True)
    phone.open("#/models/three?tab=versions")
    assert phone.overflow() <= 0
    assert audit(phone.page) == []


def test_filters_of_models_and_jobs_survive_updates(
    visitor: Visitor, rows: dict[str, Any], dashboard: Dashboard
) -> None:
    page = visitor.open("#/models")
    table = page.get_by_role("table", name="Models", exact=True)
    every = len(keys(table))
    page.get_by_role("searchbox", name="Filter models").fill("THREE gip")
    assert keys(table) == ["three"]
    expect(page.get_by_text(f"1 of {every} models")).to_be_visible()
    page.get_by_role("searchbox").fill("no such")
    expect(table).to_contain_text("No models match.")
    page.get_by_role("searchbox").fill("")
    assert len(keys(table)) == every
    table.get_by_role("button", name="Model", exact=True).click()
    by_number = [[int(part) if part.isdigit() else part for part in re.split(r"(\d+)", each)] for each in keys(table)]
    assert by_number == sorted(by_number)
    assert audit(page) == []

    page = visitor.open("#/jobs")
    table = page.get_by_role("table", name="Jobs", exact=True)
    expect(table.locator(f'tr[data-key="{dashboard.job["id"]}"]')).to_contain_text("not judged")
    page.get_by_role("searchbox", name="Filter jobs").fill("three se")
    expect(table.locator("tbody tr")).to_have_count(1)
    expect(table).to_contain_text(f"{largest_error(rows['versions'][1]):.1f}")
    with page.expect_response("**/v1/jobs"):
        pass
    with page.expect_response("**/v1/jobs"):  # the first response is drawn
        pass
    expect(table.locator("tbody tr")).to_have_count(1)
    expect(page.get_by_role("searchbox")).to_have_value("three se")
    assert audit(page) == []


def test_list_of_jobs_fits_a_desktop_window_and_shows_result_and_time(
    windows: Visit, dashboard: Dashboard, rows: dict[str, Any]
) -> None:
    page = windows(dashboard.server.url, size=(1440, 900)).open("#/jobs")
    table = page.get_by_role("table", name="Jobs", exact=True)
    row = table.locator(f'tr[data-key="{dashboard.job["id"]}"]')
    expect(row).to_contain_text(re.compile(r"version 1 after \d+"))
    expect(row).to_contain_text("ago")
    around = page.get_by_role("region", name="Jobs", exact=True).last
    assert around.evaluate("(each) => each.scrollWidth - each.clientWidth") <= 0
