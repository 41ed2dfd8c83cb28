"""Page of a model: long recordings, empty states, aliases, lineage, predictions, candidates."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from lipcore.robots.dirt import Dirt
from tests.service.data import QUICK, stream, train, upload
from tests.system.browser.accessibility import audit, expect
from tests.system.browser.conftest import Dashboard, Visit
from tests.system.browser.visitor import DESKTOP, PHONE, Visitor

if TYPE_CHECKING:
    from playwright.sync_api import Route


ROWS = 1200
COVERED = """() => {
  const kinds = ".joint, .measure > span, .answer strong, .badge, .dial > *";
  const seen = [...document.querySelectorAll(kinds)].filter((each) => each.checkVisibility());
  const boxes = seen.map((each) => [each, each.getBoundingClientRect()]);
  const beside = (a, b) => a.right <= b.left + 1 || b.right <= a.left + 1;
  const above = (a, b) => a.bottom <= b.top + 1 || b.bottom <= a.top + 1;
  return boxes.flatMap(([one, a], at) => boxes.slice(at + 1)
    .filter(([other, b]) => !one.contains(other) && !other.contains(one) && !beside(a, b) && !above(a, b))
    .map(([other]) => `${one.outerHTML} covers ${other.outerHTML}`));
}"""
"""Names, values and controls that cover another one."""
CUT = """() => [...document.querySelectorAll(".joint, .measure > span, .answer strong, .dial input[type=number]")]
  .filter((each) => each.scrollWidth > each.clientWidth + 1 && getComputedStyle(each).display !== "inline")
  .map((each) => each.outerHTML)"""
"""Names and values that are wider than their place."""


@pytest.fixture(scope="module")
def model(dashboard: Dashboard) -> str:
    """A model whose aliases no other test moves."""
    train(dashboard.client, "looked-at", dashboard.dataset["id"], holdout={"share": 0.3})
    return "looked-at"


@pytest.fixture(scope="module")
def long(dashboard: Dashboard) -> str:
    """A recording with more rows than a plot shows."""
    return upload(dashboard.client, stream(samples=ROWS, rate=100.0, seed=4), name="long.npz")["id"]


def test_long_recording_is_thinned_until_rows_are_selected(visitor: Visitor, model: str, long: str) -> None:
    page = visitor.open(f"#/models/{model}?dataset={long}")
    expect(page.get_by_text("Showing 1\u202f000 of 1\u202f200 samples, evenly spaced")).to_be_visible()
    page.get_by_label("Joint", exact=True).select_option("joint2")
    page.get_by_label("Show", exact=True).select_option("residual, measured − predicted")
    expect(page.get_by_role("img", name=re.compile("residual.* of joint2 along"))).to_be_visible()
    expect(page.get_by_role("img", name=re.compile("of joint1 along"))).to_have_count(0)

    page.get_by_text("Select rows").click()
    page.get_by_label("From row").fill("100")
    page.get_by_label("To row").fill("299")
    page.get_by_role("button", name="Show these rows").click()
    expect(page.get_by_text("Showing all 200 samples (rows 100 to 299).")).to_be_visible()
    expect(page.get_by_role("img", name="200 of 200 rows")).to_be_visible()
    page.get_by_label("From row").fill("5000")
    visitor.expect_refusals(422)
    page.get_by_role("button", name="Show these rows").click()
    expect(page.get_by_role("alert")).to_contain_text("a row of the data set, 0 to 1199")
    page.get_by_role("button", name="Show all rows").click()
    expect(page.get_by_text("Showing 1\u202f000 of 1\u202f200 samples")).to_be_visible()
    assert audit(page) == []


def test_plots_of_all_joints_share_one_cursor(visitor: Visitor, model: str, long: str) -> None:
    page = visitor.open(f"#/models/{model}?dataset={long}")
    plots = page.get_by_role("region", name="Measured and predicted torque").locator(".js-plotly-plot")
    cursors = plots.locator(".linked .cursor")
    expect(cursors).to_have_count(2)
    expect(cursors.first).to_be_hidden()
    plots.last.hover()
    expect(cursors.first).to_be_visible()
    places = {each.evaluate("(cursor) => cursor.style.left") for each in cursors.all()}
    assert len(places) == 1


@pytest.mark.parametrize("tab", ["learning", "ask"])
def test_selected_tab_is_in_view_on_a_phone(windows: Visit, dashboard: Dashboard, model: str, tab: str) -> None:
    page = windows(dashboard.server.url, size=PHONE, touch=True).open(f"#/models/{model}?tab={tab}")
    shown = page.locator(".tabs [aria-selected=true]")
    expect(shown).to_have_attribute("data-name", tab)
    expect(shown).to_be_in_viewport(ratio=0.95)


def test_model_without_matching_recording_asks_for_an_upload(visitor: Visitor) -> None:

    def others(route: Route) -> None:
        body = route.fetch().json()
        body["items"] = [each for each in body["items"] if each["joint_names"][0] != "panda_joint1"]
        route.fulfill(json=body)

    visitor.page.route(re.compile(r"/v1/datasets(\?.*)?$"), others)  # other tests upload recordings of Pandas
    page = visitor.open("#/models/panda-sim")
    expect(page.get_by_text("has the joints of this model (panda_joint1")).to_be_visible()
    expect(page.get_by_role("link", name="Upload a recording")).to_be_visible()
    page.get_by_role("tab", name="Arm and friction").click()
    expect(page.get_by_role("table").filter(has_text="Coulomb")).to_contain_text("joint7")
    assert audit(page) == []


def test_alias_is_created_and_removed(visitor: Visitor, dashboard: Dashboard, model: str) -> None:
    page = visitor.open(f"#/models/{model}?tab=versions")
    page.get_by_text("Create or move an alias").click()
    page.get_by_label("Alias", exact=True).fill("production")
    page.get_by_role("button", name="Set alias").click()
    expect(page.get_by_role("row").filter(has_text="production → 1")).to_be_visible()
    assert dashboard.client.get(f"/v1/models/{model}").json()["aliases"] == {"production": 1}
    expect(page.get_by_role("button", name="Delete")).to_have_count(0)
    page.get_by_role("button", name="Remove: production").click()
    page.get_by_role("dialog").get_by_role("button", name="Remove alias").click()
    expect(page.get_by_text("Alias production removed.")).to_be_visible()
    assert dashboard.client.get(f"/v1/models/{model}").json()["aliases"] == {}


def test_lineage_links_to_data_set_and_job(visitor: Visitor, dashboard: Dashboard, model: str) -> None:
    page = visitor.open(f"#/models/{model}?tab=lineage")
    trained = page.get_by_role("region", name="Trained on")
    expect(trained.get_by_role("link", name="pendulum.npz")).to_have_attribute(
        "href", f"#/data/{dashboard.dataset['id']}"
    )
    expect(page.get_by_role("columnheader", name="Training data: nMSE")).to_be_visible()
    expect(page.get_by_role("link", name="a training job")).to_have_attribute("href", re.compile("^#/jobs/job_"))
    assert audit(page) == []


def test_prediction_outside_the_training_range_shows_a_warning(visitor: Visitor, model: str) -> None:
    page = visitor.open(f"#/models/{model}?tab=ask")
    answer = page.get_by_role("region", name="Predicted torque")
    expect(answer.get_by_role("listitem")).to_have_count(2)
    expect(page.get_by_text("outside", exact=False).filter(has_text="dq")).to_have_count(0)
    page.get_by_label("dq of joint2", exact=True).fill("40")
    expect(page.get_by_text("dq outside")).to_be_visible()
    expect(page.get_by_text("Do not send this torque to a robot without a check")).to_be_visible()
    assert audit(page) == []


def test_sliders_set_the_state_and_the_torque_is_shown_with_its_components(
    visitor: Visitor, dashboard: Dashboard, model: str
) -> None:
    page = visitor.open(f"#/models/{model}?tab=ask")
    version = dashboard.client.get(f"/v1/models/{model}/versions/1").json()
    slider = page.get_by_role("slider", name="q of joint1, slider", exact=True)
    slider.focus()
    slider.press("End")
    highest = version["training_range"]["q"]["max"][0]
    q = float(page.get_by_label("q of joint1", exact=True).input_value())
    assert q == pytest.approx(highest, abs=1e-2)
    middle = float(page.get_by_label("q of joint2", exact=True).input_value())
    state = {"q": [q, middle], "dq": [0.0, 0.0], "ddq": [0.0, 0.0], "components": ["gravity", "friction"]}
    found = dashboard.client.post(f"/v1/models/{model}/predict", json=state).json()
    bar = page.get_by_role("region", name="Predicted torque").get_by_role("listitem").first.get_by_role("img")
    for name in ("gravity", "friction"):
        expect(bar).to_have_attribute("aria-label", re.compile(f"{name} {found['components'][name]['mean'][0]:.3g}"))
    for name in ("q", "dq", "ddq"):  # the whole slider is inside the training range
        for end in ("Home", "End"):
            page.get_by_role("slider", name=f"{name} of joint2, slider", exact=True).press(end)
            expect(page.locator(".states .badge")).to_have_count(0)
    page.get_by_role("button", name="At rest, middle of the range").click()
    expect(bar).not_to_have_attribute(
        "aria-label", re.compile(f"gravity {found['components']['gravity']['mean'][0]:.3g}")
    )


@pytest.fixture(scope="module")
def named(dashboard: Dashboard) -> str:
    """A model of joints with long names."""
    recorded = replace(stream(samples=120, seed=5), joint_names=("left_shoulder_lift_joint", "left_wrist_3_joint"))
    data = upload(dashboard.client, recorded, name="long names.npz")
    train(dashboard.client, "long-names", data["id"], holdout={"share": 0.3})
    return "long-names"


@pytest.mark.parametrize("tab", ["accuracy", "ask", "parts"])
@pytest.mark.parametrize("size", [DESKTOP, PHONE])
def test_long_joint_names_cover_nothing_and_no_value_is_cut(
    windows: Visit, dashboard: Dashboard, named: str, tab: str, size: tuple[int, int]
) -> None:
    visitor = windows(dashboard.server.url, size=size)
    page = visitor.open(f"#/models/{named}?tab={tab}")
    expect(page.locator("main .joint").first).to_have_text("shoulder_lift")
    assert visitor.overflow() <= 0
    assert page.evaluate(COVERED) == []
    assert page.evaluate(CUT) == []


def test_code_of_the_lineage_is_not_clipped_on_a_phone(windows: Visit, dashboard: Dashboard, model: str) -> None:
    page = windows(dashboard.server.url, size=PHONE, touch=True).open(f"#/models/{model}?tab=lineage")
    page.get_by_text("Lineage as JSON").click()
    code = page.locator("pre")
    expect(code).to_contain_text('"lineage"')
    assert code.evaluate("(each) => each.scrollWidth <= each.clientWidth")


def test_warnings_are_chips_that_open_their_text(visitor: Visitor, model: str) -> None:
    texts = ["The fit did not converge. Train with `max_iterations` 500.", "The joints moved together: by 0.5 rad."]

    def warned(route: Route) -> None:
        route.fulfill(json={**route.fetch().json(), "warnings": texts})

    visitor.page.route("**/versions/1", warned)
    page = visitor.open(f"#/models/{model}?tab=lineage")
    chips = page.get_by_role("region", name="Warnings")
    expect(chips.locator("summary")).to_have_text(["! The fit did not converge", "! The joints moved together"])
    text = chips.get_by_text("Train with max_iterations 500.")
    expect(text).to_be_hidden()
    chips.locator("summary").first.press("Enter")
    expect(text).to_be_visible()
    expect(text.locator("code")).to_have_text("max_iterations")
    assert audit(page) == []


def test_candidate_shows_its_reason_and_can_be_served(visitor: Visitor, dashboard: Dashboard) -> None:
    good = stream(samples=120, rate=10.0, seed=11)
    noise = np.random.default_rng(0).standard_normal(good.tau.shape) * (np.arange(120) >= 84)[:, None]
    first, second = (upload(dashboard.client, each)["id"] for each in (good, replace(good, tau=good.tau + 5 * noise)))
    train(dashboard.client, "waits", first)
    job = train(dashboard.client, "waits", second, holdout={"share": 0.3}, promotion="ask")
    reason = job["verdict"]["reason"]
    page = visitor.open(f"#/jobs/{job['id']}")
    expect(page.get_by_role("note").get_by_text("wrong", exact=False).first).to_be_visible()
    assert audit(page) == []

    page = visitor.open(f"#/models/waits?version=2&dataset={second}&part=held_out")
    expect(page.get_by_text(reason).first).to_be_visible()
    expect(page.get_by_text("✕ wrong").first).to_be_visible()
    serve = page.get_by_role("button", name="Serve version 2 anyway")
    expect(serve).to_have_class("danger")
    serve.click()
    page.get_by_role("dialog").get_by_role("button", name="Serve version 2 anyway").click()
    expect(page.get_by_text("Version 2 of waits is now serving.")).to_be_visible()
    assert audit(page) == []


def test_selection_by_auto_is_shown_with_job_and_version(visitor: Visitor, dashboard: Dashboard) -> None:
    dataset = upload(dashboard.client, stream(samples=120, seed=9, dirt=Dirt()), name="chosen.npz")
    options = {**QUICK, "posterior_samples": 100, "search_seconds": 1.0, "starts": 1}
    job = train(dashboard.client, "chosen", dataset["id"], estimator="auto", options=options)
    chosen = dashboard.client.get("/v1/models/chosen/versions/1").json()["estimator"]
    for page in (visitor.open(f"#/jobs/{job['id']}"), visitor.open("#/models/chosen?tab=lineage")):
        card = page.get_by_role("region", name="Selection of the estimator")
        expect(card.get_by_text("Evaluated on 2 held-out segments")).to_be_visible()
        expect(card.get_by_role("columnheader", name="nMSE at the edge")).to_be_visible()
        expect(card.locator("tbody tr")).to_have_count(3)
        expect(card.locator("strong").first).to_have_text(chosen)
        visitor.settled()
        assert audit(page) == []


def test_learning_curve_is_shown_with_job_and_version(visitor: Visitor, dashboard: Dashboard) -> None:
    dataset = upload(dashboard.client, stream(samples=300, seed=6), name="curved.npz")
    job = train(dashboard.client, "curved", dataset["id"], holdout={"share": 0.3})
    for where in (f"#/jobs/{job['id']}", "#/models/curved?tab=lineage"):
        page = visitor.open(where)
        card = page.get_by_role("region", name="Learning curve")
        expect(card.get_by_role("img", name=re.compile("^nMSE against training samples: .* with "))).to_be_visible()
        card.get_by_text("Numbers").click()
        expect(card.locator("tbody tr")).to_have_count(4)
        expect(card.get_by_role("cell", name="the first ones")).to_be_visible()
        visitor.settled()
        assert audit(page) == []


def test_model_page_opens_with_the_held_out_part(visitor: Visitor, dashboard: Dashboard, model: str, long: str) -> None:
    assert dashboard.client.get("/v1/datasets").json()["items"][0]["id"] != dashboard.dataset["id"], (
        "a newer one is there"
    )
    page = visitor.open(f"#/models/{model}")
    expect(page.get_by_label("Recording", exact=True)).to_have_value(dashboard.dataset["id"])
    expect(page.get_by_label("Part", exact=True)).to_have_value("held_out")
    expect(page.get_by_text("Optimistic figures")).to_have_count(0)


def test_coverage_and_verdict_fit_on_a_phone(windows: Visit, dashboard: Dashboard, model: str) -> None:
    visitor = windows(dashboard.server.url, size=PHONE, touch=True)
    page = visitor.open(f"#/models/{model}")
    joints = page.get_by_role("region", name="Verdict", exact=True).get_by_role("listitem")
    expect(joints).to_have_count(2)
    for joint in joints.all():
        for part in (*joint.get_by_role("img").all(), joint.locator(".badge")):
            box = part.bounding_box()
            assert box is not None
            assert box["x"] >= 0
            assert box["x"] + box["width"] <= PHONE[0]


@pytest.mark.parametrize("size", [DESKTOP, PHONE])
def test_click_in_progress_survives_a_change_of_the_header(
    windows: Visit, dashboard: Dashboard, size: tuple[int, int]
) -> None:
    name = f"changing-{size[0]}"
    for _ in range(2):
        train(dashboard.client, name, dashboard.dataset["id"])
    visitor = windows(dashboard.server.url, size=size)
    page = visitor.open(f"#/models/{name}?version=2&tab=lineage")
    place = page.get_by_role("link", name="Follow live").bounding_box()
    assert place is not None
    page.mouse.move(place["x"] + place["width"] / 2, place["y"] + place["height"] / 2)
    page.mouse.down()
    page.get_by_label("Version", exact=True).select_option("1")
    expect(page.get_by_role("button", name="Serve version 1")).to_be_visible()
    page.mouse.up()
    expect(page.get_by_role("heading", level=1, name=f"{name} live")).to_be_visible()


@pytest.mark.parametrize(
    ("times", "breaks", "expected"),
    [
        ([5, 6, 7, 8], [], [0, 1, 2, 3]),
        ([5, 6, 8, 9], [2], [0, 1, 3, 4]),
        ([5, 6, 1006, 1007], [2], [0, 1, 1.1, 2.1]),
        ([5, 6, 1006, 1007, 9007], [2, 4], [0, 1, 1.1, 2.1, 2.2]),
    ],
)
def test_long_pauses_are_cut(visitor: Visitor, times: list[float], breaks: list[int], expected: list[float]) -> None:
    found = visitor.open("#/data").evaluate(
        """async (trace) => {
          const { axis } = await import("/dashboard/pages/model/curves.js");
          return axis(trace, 5);
        }""",
        {"t": times, "breaks": breaks},
    )
    assert found["x"] == pytest.approx(expected)
    assert found["isCut"] == (times[-1] > 1000)
