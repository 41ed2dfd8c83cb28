"""Live page: size of the plots, enlarged joint, cursor, marks, external torque, learning settings, list of robots."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import cycle, pairwise
from typing import TYPE_CHECKING, Any

import httpx
import numpy as np
import pytest

from tests.service.data import stream
from tests.system.browser.accessibility import audit, expect
from tests.system.browser.conftest import Dashboard, Visit
from tests.system.browser.robot import playing
from tests.system.browser.visitor import PHONE, Visitor

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from playwright.sync_api import Locator, Page, Route


RATE = 50.0
ROWS = 400
PUSH = 30.0
"""External torque on the second joint, N·m."""
KNOCKS, LEANS = np.where(np.arange(ROWS) % 200 < 15, PUSH, 0.0), np.full(ROWS, PUSH)
"""External torque of each row, N·m: short pushes, which are no change, or a constant one."""
FIRST_SEEN = """
window.firstSeen = [];
new MutationObserver((changes) => {
  for (const { addedNodes } of changes) for (const node of addedNodes) {
    if (!node.classList?.contains("plot-container")) continue;
    const plot = node.parentElement;
    const look = () => {
      const svg = plot.querySelector(".main-svg");
      if (!svg) return requestAnimationFrame(look);
      const points = Math.max(...plot.data.map(({x}) => x.length));
      firstSeen.push([svg.getBoundingClientRect().width, plot.clientWidth, points]);
    };
    requestAnimationFrame(look);
  }
}).observe(document, {childList: true, subtree: true});
"""
BOXES = "(all) => all.map((each) => each.getBoundingClientRect().toJSON())"
SCALES = """(plot) => {
  const find = (name) => plot.data.find((each) => each.name === name), [low, high] = plot.layout.yaxis.range;
  const measured = find("measured").y.filter((y) => y !== null);
  return [find("predicted").line.color, Math.max(...measured) - Math.min(...measured), high - low];
}"""
"""Colour of the prediction, span of the torque, and span of the axis."""
CURSORS = "[...document.querySelectorAll('.linked .cursor')].map((each) => each.hidden ? null : each.style.left)"


@pytest.fixture(scope="module", name="copied")
def copies(dashboard: Dashboard) -> Any:
    """Create models that streams may change: copies of the shared one."""
    archive = dashboard.client.get(f"/v1/models/{dashboard.model}/export").content

    def copied(name: str) -> str:
        headers = {"content-type": "application/x-tar"}
        answer = dashboard.client.post(
            "/v1/models/import", content=archive, headers=headers, params={"name": name, "promotion": "always"}
        )
        assert answer.status_code == 201, answer.text
        return name

    return copied


@contextmanager
def moving(dashboard: Dashboard, model: str, push: NDArray[np.float64] | None = None) -> Iterator[None]:
    """Stream to a model; push: external torque on its second joint, (ROWS,)."""
    motion = stream(samples=ROWS, rate=RATE, seed=21, speed=1.0)
    tau = motion.tau + np.outer(np.zeros(ROWS) if push is None else push, [0.0, 1.0])
    rows = cycle(zip(motion.q, motion.dq, motion.ddq, tau, strict=True))
    with playing(dashboard.server.url, model, rows, RATE):
        yield


def drawn(page: Page) -> None:
    """Wait until all plots over time are drawn: one for each joint, the innovation."""
    expect(page.locator(".linked")).to_have_count(3)


def width(place: Locator) -> float:
    """Return the width of the drawing in a place, px."""
    found: float = place.locator(".main-svg").first.evaluate("(each) => each.getBoundingClientRect().width")
    return found


def delayed(route: Route) -> None:
    """Answer with a status whose learning is 2.1 s behind."""
    answer = httpx.stream("GET", route.request.url)
    with answer as events:
        for line in events.iter_lines():
            if line.startswith("data:") and "lag_s" in line:
                status = json.loads(line.removeprefix("data:")) | {"lag_s": 2.1, "lag_rows": 40}
                break
    body = f"event: status\ndata: {json.dumps(status)}\n\n"
    route.fulfill(content_type="text/event-stream", body=body)


def options(dashboard: Dashboard, model: str) -> dict[str, Any]:
    """Return the learning options of a model."""
    found: dict[str, Any] = dashboard.client.get(f"/v1/models/{model}/learning").json()["options"]
    return found


def test_plots_appear_with_final_width_and_data(visitor: Visitor, dashboard: Dashboard, copied: Any) -> None:
    visitor.page.add_init_script(FIRST_SEEN)
    model = copied("first-moments")
    page = visitor.open(f"#/live/{model}")
    expect(page.get_by_text("connected, no rows yet")).to_be_visible()
    with moving(dashboard, model):
        drawn(page)
        seen = visitor.until(lambda: len(found := page.evaluate("firstSeen")) >= 3 and found)
    for width, place, points in seen:
        assert width == pytest.approx(place, abs=1)
        assert points > 0


def test_joint_with_largest_innovation_is_marked_and_any_joint_can_be_enlarged(
    visitor: Visitor, dashboard: Dashboard, copied: Any
) -> None:
    model = copied("farthest")
    page = visitor.open(f"#/live/{model}")
    with moving(dashboard, model, KNOCKS):
        torque = page.get_by_role("region", name="Torque", exact=True)
        first, second = (torque.locator(".trace").filter(has_text=f"joint{number}") for number in (1, 2))
        expect(second).to_contain_text("largest")
        forces = page.get_by_role("region", name="External torque")
        expect(forces).to_contain_text("external torque on joint2")
        expect(forces.get_by_role("listitem").filter(has_text="joint2")).to_have_text(
            re.compile(r"\+([5-9]|1\d|20)\.\d\d")
        )
        drawn(page)
        assert audit(page) == []
        small = width(first)

        forces.get_by_text("How to read this").click()
        button = page.get_by_role("button", name="Show joint1 large")
        button.click()
        expect(button).to_have_attribute("aria-pressed", "true")
        visitor.until(lambda: width(first) > 1.5 * small)
        assert button.evaluate("(each) => each === document.activeElement")
        expect(forces.get_by_text("Measured − predicted")).to_be_visible()  # still open after an update
        page.get_by_label("Time window").select_option("120")
        expect(page).to_have_url(re.compile(r"window=120&joint=joint1$"))
        page.reload()
        expect(button).to_have_attribute("aria-pressed", "true")
        expect(page.get_by_label("Time window")).to_have_value("120")
        button.click()
        expect(button).to_have_attribute("aria-pressed", "false")
        visitor.until(lambda: width(first) == pytest.approx(small, abs=2))
        expect(page).to_have_url(re.compile(r"window=120$"))


def test_each_joint_has_its_own_scale_and_colour(visitor: Visitor, dashboard: Dashboard, copied: Any) -> None:
    model = copied("scaled")
    page = visitor.open(f"#/live/{model}")
    with moving(dashboard, model):
        drawn(page)
        plots = page.locator(".trace .js-plotly-plot").all()
        seen = [each.evaluate(SCALES) for each in plots]
    assert len({colour for colour, _, _ in seen}) == 2
    for _, size, height in seen:
        assert size > 0.3 * height, "the torque fills its plot"


def test_long_joint_names_do_not_cover_values(windows: Visit, dashboard: Dashboard, copied: Any) -> None:
    model = copied("named")
    page = windows(dashboard.server.url, size=PHONE, touch=True).open(f"#/live/{model}")
    with moving(dashboard, model):
        drawn(page)
        rows = page.get_by_role("region", name="External torque").get_by_role("listitem")
        rows.first.locator(".joint").evaluate("(each) => (each.textContent = 'shoulder_lift_joint')")
        boxes = rows.first.locator("> *").evaluate_all(BOXES)
    assert all(one["right"] <= other["left"] for one, other in pairwise(boxes))


def test_state_tells_how_far_learning_is_behind(visitor: Visitor, dashboard: Dashboard, copied: Any) -> None:
    model = copied("lagging")
    page = visitor.open(f"#/live/{model}")
    with moving(dashboard, model):
        state = page.locator("main").get_by_role("status").first
        expect(state).to_contain_text("learning up to date")
        quality = page.get_by_role("region", name="Quality")
        expect(quality.get_by_role("columnheader", name="RMSE")).to_be_visible()
        expect(quality).not_to_contain_text("nMSE")
        visitor.until(lambda: quality.get_by_role("note").locator(".badge").inner_text() in state.inner_text())
        page.route("**/live", delayed)
        page.reload()
        expect(state).to_contain_text("learning 2.1\u00a0s behind")
        page.unroute_all(behavior="wait")


def test_new_contact_is_checked_for_a_payload_first(visitor: Visitor, dashboard: Dashboard) -> None:
    found = visitor.open(f"#/live/{dashboard.model}").evaluate("""async () => {
      const { track } = await import("/dashboard/pages/live/payload.js");
      const states = [[0, "contact"], [1, "none"], [2, "contact"], [3, "contact"], [9, "contact"], [10, "payload"]];
      const checked = [];
      let known = null;
      for (const [at, state] of states) {
        const payloads = [{ stream_id: "cell", state, mass: state === "payload" ? { mean: 1, std: 0.1 } : null }];
        known = track(known, payloads, at);
        checked.push(at < known.cell.checkedUntil);
      }
      return checked;
    }""")
    assert found == [False, False, True, True, False, False]


def test_all_plots_share_cursor_and_alarm_marks(visitor: Visitor, dashboard: Dashboard, copied: Any) -> None:
    model = copied("marked")
    page = visitor.open(f"#/live/{model}")
    with moving(dashboard, model, LEANS):
        drawn(page)
        expect(page.locator(".linked .mark[data-word=change]:visible")).to_have_count(3)
        page.get_by_role("button", name="Pause plots").click()
        slider = page.get_by_role("slider", name="Cursor")
        slider.focus()
        for _ in range(3):
            slider.press("ArrowLeft")
        places = visitor.until(lambda: None not in (found := page.evaluate(CURSORS)) and found)
        assert len(places) == 3
        assert len(set(places)) == 1
        expect(page.locator(".trace .value").first).to_have_text(re.compile(r"-?\d+\.\d\d \| -?\d+\.\d\d"))
        page.get_by_role("button", name="Show joint1 large").click()
        expect(page.locator(".trace.large .value")).to_have_text(
            re.compile(r"measured -?\d+\.\d\d, predicted -?\d+\.\d\d N·m")
        )
        slider.focus()
        slider.press("End")
        visitor.until(lambda: page.evaluate(CURSORS) == [None] * 3)
        page.locator(".trace .plot").last.hover()
        visitor.until(lambda: None not in page.evaluate(CURSORS))
        assert audit(page) == []
        page.set_viewport_size({"width": PHONE[0], "height": PHONE[1]})
        visitor.until(lambda: visitor.overflow() == 0)


def test_live_page_changes_learning_settings(visitor: Visitor, dashboard: Dashboard, copied: Any) -> None:
    model = copied("switched")
    page = visitor.open(f"#/live/{model}")
    with moving(dashboard, model):
        page.get_by_label("Forget", exact=True).select_option("600")
        visitor.until(lambda: options(dashboard, model)["forgetting_s"] == 600)
        page.get_by_label("When the robot changes").select_option("adapt")
        visitor.until(lambda: options(dashboard, model)["on_change"] == "adapt")
        assert options(dashboard, model)["forgetting_s"] == 600, "one setting reset another"

        page.get_by_label("Roll back to").select_option("0")
        page.get_by_role("button", name="Roll back").click()
        page.get_by_role("dialog").get_by_role("button", name="Cancel").click()
        page.get_by_role("button", name="Roll back").click()
        page.get_by_role("dialog").get_by_role("button", name="Roll back").click()
        expect(page.get_by_text(re.compile(r"Rolled back to revision 0: \d+ batch"))).to_be_visible()
    page.get_by_role("button", name="Pause learning").click()
    visitor.until(lambda: options(dashboard, model)["enabled"] is False)
    expect(page.get_by_role("region", name="Learning", exact=True)).to_contain_text("paused")
    assert audit(page) == []
    page.get_by_role("button", name="Resume learning").click()
    visitor.until(lambda: options(dashboard, model)["enabled"] is True)


def test_robots_are_listed_with_their_state(visitor: Visitor, dashboard: Dashboard, copied: Any) -> None:
    model = copied("listed")
    with moving(dashboard, model):
        page = visitor.open("#/live")
        row = page.get_by_role("region", name="Robots").get_by_role("row").filter(has_text=model)
        expect(row).to_contain_text("✓ live")
        expect(row.get_by_role("link", name="cell")).to_have_attribute("href", f"#/live/{model}")
        link = row.get_by_role("link", name=model).element_handle()
    expect(row).to_contain_text("· idle")
    assert link is not None
    assert link.evaluate("(each) => each.isConnected"), "the list was created again"
    expect(page.get_by_role("region", name="Models without a stream").get_by_role("link").first).to_be_visible()
    assert audit(page) == []
