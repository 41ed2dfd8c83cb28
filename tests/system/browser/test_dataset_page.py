"""Page of a data set: recommendations, tabs, common cursor and zoom, range to hold out."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from PIL import Image

from tests.service.data import stream, upload
from tests.system.browser.accessibility import audit, expect
from tests.system.browser.conftest import Dashboard
from tests.system.browser.visitor import Visitor

if TYPE_CHECKING:
    from playwright.sync_api import Page


SAMPLES = stream(samples=200, rate=20.0, seed=31)
RANGES = "[...document.querySelectorAll('.strip')].map(({layout}) => layout.xaxis.range)"
CURSORS = "[...document.querySelectorAll('.strip .cursor')].map((each) => each.hidden ? null : each.style.left)"
SCALES = """[...document.querySelectorAll('.strip')].map(({data, layout}) => data.map(({y, yaxis}) =>
  [layout[(yaxis ?? "y").replace("y", "yaxis")].range, Math.min(...y), Math.max(...y)]))"""
"""Range of each y axis, and the smallest and largest value in it."""
NAMES = {"q": "Position", "dq": "Velocity", "ddq": "Acceleration", "tau": "Torque"}
AREA = """(plot) => {
  const {x, y, width, height} = plot.querySelector(".nsewdrag").getBoundingClientRect();
  return [x, y, width, height];
}"""


@pytest.fixture(scope="module")
def dataset(dashboard: Dashboard) -> str:
    """A recording of ten seconds whose report has recommendations."""
    return str(upload(dashboard.client, SAMPLES, name="ten seconds")["id"])


def drawn(page: Page) -> None:
    """Wait until all plots and their overlays are drawn."""
    expect(page.locator(".strip .linked")).to_have_count(4)


def at_cursor(page: Page, name: str) -> list[str]:
    """Return joints and their values at the cursor."""
    return page.get_by_role("list", name=f"{name} at the cursor").get_by_role("listitem").all_inner_texts()


def image_size(path: Path) -> tuple[int, int]:
    """Return width and height of a PNG, px."""
    with Image.open(path) as opened:
        return opened.size


def across(page: Page, plot: int, share: float) -> tuple[float, float]:
    """Return a point in a plot, px: at a share of its x axis, at half its height."""
    place = page.locator(".strip").nth(plot)
    place.scroll_into_view_if_needed()
    x, y, width, height = place.evaluate(AREA)
    return x + share * width, y + height / 2


def drag(page: Page, plot: int, start: float, end: float) -> None:
    """Drag with the mouse over a share of a plot's x axis."""
    page.mouse.move(*across(page, plot, start))
    page.mouse.down()
    page.mouse.move(*across(page, plot, (start + end) / 2))
    page.mouse.move(*across(page, plot, end))
    page.mouse.up()


def test_recommendations_come_first_and_tab_is_in_the_address(visitor: Visitor, dataset: str) -> None:
    page = visitor.open(f"#/data/{dataset}")
    drawn(page)
    advice, tabs = page.get_by_role("region", name="Recommendations"), page.get_by_role("tablist")
    expect(advice.get_by_role("listitem").first).to_be_visible()
    first, below = advice.bounding_box(), tabs.bounding_box()
    assert first is not None
    assert below is not None
    assert first["y"] + first["height"] <= below["y"]
    assert page.evaluate("document.documentElement.scrollHeight") < 2000

    page.get_by_role("tab", name="Signals").focus()
    steps = (
        ("ArrowRight", "Timing"),
        ("End", "Read again"),
        ("ArrowRight", "Signals"),
        ("ArrowLeft", "Read again"),
    )
    for key, name in steps:
        page.keyboard.press(key)
        expect(page.get_by_role("tab", name=name, exact=True)).to_be_focused()
        expect(page.get_by_role("tab", selected=True)).to_have_text(name)
        expect(page.get_by_role("tabpanel", name=name)).to_be_visible()
    expect(page).to_have_url(re.compile(r"\?tab=again$"))
    page.reload()
    visitor.settled()
    expect(page.get_by_role("tab", selected=True)).to_have_text("Read again")
    for name in ("Timing", "Excitation", "Friction", "Preparation"):
        page.get_by_role("tab", name=name).click()
        expect(page.get_by_role("tabpanel", name=name).get_by_role("region").first).to_be_visible()
        assert audit(page) == []


def test_all_plots_share_one_cursor(visitor: Visitor, dataset: str) -> None:
    page = visitor.open(f"#/data/{dataset}")
    drawn(page)
    page.mouse.move(*across(page, 2, 0.25))
    places = visitor.until(lambda: None not in (found := page.evaluate(CURSORS)) and found)
    assert len(places) == 4
    assert len(set(places)) == 1
    assert 24 < float(places[0].rstrip("%")) < 26
    low, high = page.evaluate(RANGES)[0]
    row = int(np.abs(SAMPLES.t - (low + 0.25 * (high - low))).argmin())
    for quantity, name in NAMES.items():
        for joint, text in enumerate(at_cursor(page, name)):
            samples = getattr(SAMPLES, quantity)[:, joint]
            step = np.abs(np.diff(samples)).max()
            assert float(text.split()[-1]) == pytest.approx(samples[row], abs=step + 0.01 * abs(samples[row]))
    slider = page.get_by_role("slider", name="Cursor")
    slider.focus()
    slider.press("End")
    expect(slider).to_have_attribute("aria-valuetext", re.compile("At 9.95 s"))
    expect(page.get_by_role("list", name="Position at the cursor").get_by_role("listitem").first).to_contain_text(
        f"{SAMPLES.q[-1, 0]:.2f}"
    )
    assert audit(page) == []


def test_each_joint_has_its_own_scale_and_unit(visitor: Visitor, dashboard: Dashboard) -> None:
    given = stream("panda", samples=120, rate=20.0, seed=34)
    tau = given.tau * np.array([1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1e-3])  # invisible on the scale of the others
    small = upload(dashboard.client, replace(given, tau=tau), name="small wrist", robot="panda")["id"]
    page = visitor.open(f"#/data/{small}")
    drawn(page)
    scales = page.evaluate(SCALES)
    assert [len(each) for each in scales] == [7] * 4
    for (low, high), least, most in (plot for column in scales for plot in column):
        assert low <= least <= most <= high
        assert most - least > 0.8 * (high - low)
    for name, unit in zip(NAMES.values(), ("rad", "rad/s", "rad/s²", "N·m"), strict=True):
        assert all(each.endswith(f"\u00a0{unit}") for each in at_cursor(page, name)), name
    assert visitor.overflow() <= 0
    assert audit(page) == []


def test_signals_are_saved_as_png_and_csv(visitor: Visitor, dataset: str) -> None:
    page = visitor.open(f"#/data/{dataset}")
    drawn(page)
    page.get_by_role("button", name="as PNG").focus()
    with page.expect_download() as picture:
        page.keyboard.press("Enter")
    assert picture.value.suggested_filename == "signals-of-ten-seconds.png"
    width, height = image_size(picture.value.path())
    strips = page.locator(".quantities").bounding_box()
    assert strips is not None
    assert width == pytest.approx(2 * strips["width"], abs=4)  # all plots, as on the page
    assert height > 2 * 150
    page.get_by_role("button", name="as CSV").focus()
    with page.expect_download() as numbers:
        page.keyboard.press("Enter")
    head, *rows = numbers.value.path().read_text().splitlines()
    assert head == 'joint,quantity,unit,sample,"time, s",value'
    assert len(rows) == 4 * SAMPLES.tau.size
    first = rows[0].split(",")
    assert first[:2] == [SAMPLES.joint_names[0], "q"]
    assert float(first[-1]) == pytest.approx(SAMPLES.q[0, 0], rel=1e-6)


def test_findings_name_fields_instead_of_flags(visitor: Visitor, dashboard: Dashboard, dataset: str) -> None:
    told = dashboard.client.get(f"/v1/datasets/{dataset}").json()
    said = ["Name the robot with `--robot` to check limits.", "Read the file again with `robot=ur10 effort=measured`."]
    told["report"] |= {"warnings": said[:1], "advice": said[1:]}
    visitor.page.route(f"**/v1/datasets/{dataset}", lambda route: route.fulfill(json=told))
    page = visitor.open(f"#/data/{dataset}")
    expect(page.get_by_role("region", name="Warnings")).to_contain_text("Name the robot with Robot to check limits.")
    expect(page.get_by_role("region", name="Recommendations")).to_contain_text(
        "Read the file again with Robot: ur10, Meaning of the torque column: measured."
    )
    expect(page.get_by_text("--robot")).to_have_count(0)
    page.get_by_role("tab", name="Read again").click()
    expect(page.get_by_label("Robot", exact=True)).to_be_visible()  # the field has this name
    expect(page.get_by_label("Meaning of the torque column")).to_be_visible()


def test_all_plots_share_one_zoom(visitor: Visitor, dataset: str) -> None:
    page = visitor.open(f"#/data/{dataset}")
    drawn(page)
    before = page.evaluate(RANGES)
    drag(page, 0, 0.2, 0.6)
    visitor.until(lambda: len({tuple(each) for each in page.evaluate(RANGES)}) == 1 and page.evaluate(RANGES) != before)
    low, high = page.evaluate(RANGES)[3]
    assert (low, high) == pytest.approx((0.2 * 9.95, 0.6 * 9.95), abs=0.3)
    page.get_by_role("button", name="Reset zoom").click()
    visitor.until(lambda: page.evaluate(RANGES) == before)


def test_dragged_range_is_held_out_of_the_training(visitor: Visitor, dashboard: Dashboard, dataset: str) -> None:
    page = visitor.open(f"#/data/{dataset}")
    drawn(page)
    page.get_by_label("Drag action").select_option("hold")
    drag(page, 1, 0.5, 0.75)
    held = page.get_by_role("group", name="Hold out")
    expect(held.get_by_role("status")).to_contain_text(re.compile(r"(49|50|51) of 200 samples"))
    assert page.locator(".strip .stretch:visible").count() == 4
    assert page.evaluate(RANGES)[0][0] <= 0, "it was zoomed"
    held.get_by_label("From").fill("5")
    held.get_by_label("To").fill("7.45")
    held.get_by_label("To").press("Tab")
    expect(held.get_by_role("status")).to_contain_text("50 of 200 samples (25\u00a0%)")
    expect(page).to_have_url(re.compile("hold_out=100-150"))
    page.reload()
    visitor.settled()
    expect(held.get_by_label("From")).to_have_value("5")
    assert audit(page) == []

    held.get_by_role("link", name="Train with this range held out").click()
    page.get_by_label("Model name").fill("held-by-hand")
    expect(page.get_by_label("Which part")).to_have_value("stretches")
    assert audit(page) == []
    with page.expect_request("**/v1/jobs") as asked:
        page.get_by_role("button", name="Start training").click()
    expect(page.get_by_role("heading", level=1, name="Training held-by-hand")).to_be_visible()
    job = page.url.rpartition("/")[2]
    dashboard.client.post(f"/v1/jobs/{job}/cancel")
    assert asked.value.post_data_json["holdout"] == {"kind": "stretches", "stretches": {dataset: [[100, 150]]}}


def test_selected_range_is_offered_only_if_there_is_one(visitor: Visitor, dataset: str) -> None:
    page = visitor.open(f"#/train?datasets={dataset}")
    expect(page.get_by_label("Which part").locator("option[value=stretches]")).to_have_count(0)


def test_joint_names_are_not_interpreted_as_markup(visitor: Visitor, dashboard: Dashboard) -> None:
    names = ("<a href='https://elsewhere.example'>one</a>", "<b>two</b>")
    given = replace(stream(samples=120, rate=20.0, seed=33), joint_names=names)
    page = visitor.open(f"#/data/{upload(dashboard.client, given, name='markup')['id']}")
    drawn(page)
    named = page.evaluate("[...document.querySelectorAll('.strip')].flatMap(({data}) => data.map(({name}) => name))")
    assert named
    assert not [name for name in named if "<" in name]
    expect(page.locator("a[href*='elsewhere']")).to_have_count(0)


def test_file_is_read_again_with_other_options(visitor: Visitor, dashboard: Dashboard) -> None:
    first = upload(dashboard.client, SAMPLES, name="again", torque_factors="1,-1")["id"]
    visitor.expect_refusals(422)
    page = visitor.open(f"#/data/{first}")
    page.get_by_role("tab", name="Read again").click()
    again = page.get_by_role("region", name="Read again")
    factors = again.get_by_label("Torque factors")
    expect(factors).to_have_value("1,-1")
    factors.fill("1")
    again.get_by_role("button", name="Read again", exact=True).click()
    expect(page.get_by_role("alert")).to_contain_text("Nothing was stored. ")
    factors.fill("")
    again.get_by_label("Joint names").fill("shoulder, elbow")
    again.get_by_role("button", name="Read again", exact=True).click()
    expect(page).not_to_have_url(re.compile(first))
    expect(page.get_by_role("heading", level=1)).to_have_text("again")
    dataset = dashboard.client.get("/v1/datasets/again").json()
    assert dataset["report"]["upload_options"] == {"joint_names": "shoulder, elbow"}
    assert dashboard.client.get(f"/v1/datasets/{first}").status_code == 404
    drawn(page)
    audit(page)
