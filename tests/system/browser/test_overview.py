"""Overview: cards of the models, and the health of the service."""

from __future__ import annotations

import re
from itertools import cycle, pairwise
from math import cos, sin
from typing import TYPE_CHECKING, Any

import pytest

from tests.choosing import slow
from tests.service.data import stream, train
from tests.system.browser.accessibility import audit, expect
from tests.system.browser.conftest import Dashboard, Visit
from tests.system.browser.robot import playing
from tests.system.browser.visitor import PHONE, Visitor

if TYPE_CHECKING:
    from playwright.sync_api import Locator, Page, Route


BOXES = "(all) => all.map((each) => each.getBoundingClientRect().toJSON())"


@pytest.fixture(scope="module")
def judged(dashboard: Dashboard) -> dict[str, Any]:
    """A model with an evaluation on held-out rows, as in `/v1/overview`."""
    train(dashboard.client, "judged", dashboard.dataset["id"], holdout={"share": 0.3})
    return glance(dashboard, "judged")


def glance(dashboard: Dashboard, name: str) -> dict[str, Any]:
    """Return a model of `/v1/overview`."""
    items = dashboard.client.get("/v1/overview").json()["items"]
    return next(each for each in items if each["name"] == name)


def card(page: Page, name: str) -> Locator:
    """Return the card of a model."""
    return page.get_by_role("region", name="Models").locator(f'li[data-key="{name}"]')


def changed(page: Page, name: str, **fields: Any) -> None:
    """Replace fields of a model in the answers of the service."""

    def answer(route: Route) -> None:
        body = route.fetch().json()
        items = [{**each, **(fields if each["name"] == name else {})} for each in body["items"]]
        route.fulfill(json={**body, "items": items})

    page.route("**/v1/overview?*", answer)


def test_card_says_which_version_serves_and_why(visitor: Visitor, judged: dict[str, Any]) -> None:
    page = visitor.open("#/")
    place = card(page, "judged")
    expect(place).to_contain_text("Version 1 serves")
    expect(place).to_contain_text(judged["verdict"]["label"])
    expect(place.get_by_text(judged["verdict"]["reason"])).to_be_visible()
    expect(place).to_contain_text("lip-chain")
    expect(place).to_contain_text("no stream yet")
    changed(page, "judged", serving_version=None, candidate=1)
    expect(place).to_contain_text("No version serves. Version 1 is a candidate")
    review = place.get_by_role("link", name="Review version 1 of judged")
    expect(review).to_have_attribute("href", "#/models/judged?tab=versions")


def test_card_shows_error_of_each_joint_in_torque_units_and_share_of_range(
    visitor: Visitor, judged: dict[str, Any]
) -> None:
    place = card(visitor.open("#/"), "judged")
    label = place.get_by_role("img", name="RMSE").get_attribute("aria-label")
    assert label is not None
    joints = judged["verdict"]["joints"]
    told = [tuple(map(float, each)) for each in re.findall(r"joint\d ([\d.e-]+)\sN·m, ([\d.]+)\s%", label)]
    for (error, share), joint in zip(told, joints, strict=True):
        assert error == pytest.approx(joint["rmse"], rel=0.05)
        assert share / 100 == pytest.approx(joint["range_share"], rel=0.05)
    worst = max(joints, key=lambda joint: joint["range_share"])
    expect(place).to_contain_text(f"largest: {worst['joint'].rpartition('_')[2]}")
    expect(place).not_to_contain_text("nMSE")
    bars = place.locator(".bars.rmse b").all()
    colours = [each.evaluate("(bar) => getComputedStyle(bar).backgroundColor") for each in bars]
    assert len(set(colours)) == 2, "each joint has its colour"
    heights = [each.evaluate("(bar) => bar.getBoundingClientRect().height") for each in bars]
    assert (heights[0] < heights[1]) == (joints[0]["range_share"] < joints[1]["range_share"])


def test_long_joint_names_fit_into_the_card(windows: Visit, dashboard: Dashboard, judged: dict[str, Any]) -> None:
    joints = judged["verdict"]["joints"]
    long = [{**each, "joint": f"{number}{'_shoulder' * 3}_{number}"} for number, each in enumerate(joints)]
    phone = windows(dashboard.server.url, size=PHONE, touch=True)
    changed(phone.page, "judged", verdict={**judged["verdict"], "joints": long})
    place = card(phone.open("#/"), "judged")
    expect(place).to_contain_text("_shoulder_shoulder_shoulder_")
    assert phone.overflow() <= 0
    boxes = place.locator(".most > *").evaluate_all(BOXES)
    assert all(one["bottom"] <= other["top"] or one["right"] <= other["left"] for one, other in pairwise(boxes))


def test_cards_have_one_size(visitor: Visitor, judged: dict[str, Any]) -> None:
    page = visitor.open("#/")
    changed(page, "judged", verdict={**judged["verdict"], "reason": "The errors are large. " * 15})
    expect(card(page, "judged")).to_contain_text("The errors are large.")
    boxes = page.get_by_role("region", name="Models").locator("li.robot").evaluate_all(BOXES)
    assert len(boxes) > 1
    assert len({(round(each["width"]), round(each["height"])) for each in boxes}) == 1


def test_card_draws_the_arm_if_one_was_learnt(visitor: Visitor, judged: dict[str, Any]) -> None:
    page = visitor.open("#/")
    arm = card(page, "panda-sim").get_by_role("img", name="Learnt arm of panda-sim, 7 joints")
    expect(arm.locator(".axis")).to_have_count(7)
    expect(card(page, "judged")).to_contain_text(f"{judged['estimator']} does not learn an arm")
    changed(page, "panda-sim", serving_version=None, candidate=1)
    expect(card(page, "panda-sim")).to_contain_text("No version serves")
    expect(arm.locator(".axis")).to_have_count(7)  # also that of a candidate
    drawn = [each.get_attribute("d") for each in arm.locator(".axis").all()]
    assert len(set(drawn)) == 7

    # the same posture from the parameters of the version, as in the 3-D drawing
    places = page.evaluate("""async () => {
      const { frames, times, gravityAlignment } = await import("/dashboard/pages/arm/kinematics.js");
      const read = async (address) => (await fetch(address)).json();
      const [shown, version] = [await read("/v1/overview"), await read("/v1/models/panda-sim/versions/1")];
      const model = shown.items.find((each) => each.name === "panda-sim");
      const { geometry } = version.parameters;
      return frames(geometry, model.position).map(({ origin }) => times(gravityAlignment(geometry.gravity), origin));
    }""")
    azimuth, elevation = -0.9, 0.3
    expected = [
        (
            cos(azimuth) * x + sin(azimuth) * y,
            -(cos(elevation) * z + sin(elevation) * (-sin(azimuth) * x + cos(azimuth) * y)),
        )
        for x, y, z in places
    ]
    path = arm.locator(".links").get_attribute("d")
    assert path is not None
    points = [tuple(map(float, each)) for each in re.findall(r"(-?[\d.]+) (-?[\d.]+)", path)]
    for seen, wanted in zip(points[1:-1], expected, strict=True):
        assert seen == pytest.approx(wanted, abs=2e-4)


def test_card_of_a_streaming_robot_is_live_and_shows_its_last_hour(visitor: Visitor, dashboard: Dashboard) -> None:
    archive = dashboard.client.get(f"/v1/models/{dashboard.model}/export").content
    headers = {"content-type": "application/x-tar"}
    answer = dashboard.client.post(
        "/v1/models/import", content=archive, headers=headers, params={"name": "glanced", "promotion": "always"}
    )
    assert answer.status_code == 201, answer.text
    page = visitor.open("#/")
    place = card(page, "glanced")
    expect(place).to_contain_text("no stream yet")
    expect(place.locator(".course")).to_have_count(0)
    motion = stream(samples=400, rate=50.0, seed=21, speed=1.0)
    rows = cycle(zip(motion.q, motion.dq, motion.ddq, motion.tau, strict=True))
    with playing(dashboard.server.url, "glanced", rows, rate=50.0):
        expect(place.get_by_text("live", exact=True)).to_be_visible()
        expect(place.locator(".course path")).to_have_count(2)
        expect(place).to_contain_text("Learning up to date")
        cards = page.get_by_role("region", name="Models").locator("li").all()
        order = [each.get_attribute("data-key") for each in cards]
        assert order.index("glanced") < order.index("panda-sim"), "live models come first"
        assert audit(page) == []
    seen = glance(dashboard, "glanced")
    assert seen["recent"]["rows"] > 0
    changed(page, "glanced", idle_s=65.0, lag_s=2.1)
    expect(place).to_contain_text("idle for 1\u00a0min 5\u00a0s")
    expect(place).to_contain_text("2.1\u00a0s behind")


def test_models_that_need_attention_come_first(visitor: Visitor, windows: Visit, dashboard: Dashboard) -> None:
    page = visitor.open("#/")
    name = "panda-sim"
    load = {"stream_id": "cell-1", "state": "payload", "declared": False, "since": None, "rows": 90}
    alarm = {"id": 1, "kind": "novelty", "message": "much is new", "evidence": {}}
    alarm["at"] = page.evaluate("new Date().toISOString()")
    changed(
        page,
        name,
        held=True,
        payloads=[{**load, "mass": {"mean": 1.25, "std": 0.05}}],
        alarm=alarm,
        candidate=4,
        idle_s=5,
    )
    place = card(page, name)
    expect(place).to_contain_text("Learning is paused until you decide")
    expect(place).to_contain_text("Payload 1.25 ± 0.05\u00a0kg")
    expect(place).to_contain_text("Version 4 is a candidate.")
    expect(place.get_by_role("link", name="Decide")).to_have_attribute("href", f"#/live/{name}")
    order = [each.get_attribute("data-key") for each in page.get_by_role("region", name="Models").locator("li").all()]
    assert order.index(name) < order.index(dashboard.model), "paused models come before idle ones"
    assert audit(page) == []
    page.unroute_all(behavior="wait")
    checked = [
        {**load, "state": "contact", "mass": None},
        {**load, "stream_id": "cell-2", "state": "none", "mass": None},
    ]
    changed(page, name, alarm=alarm, payloads=checked, idle_s=5)
    expect(place).to_contain_text("Much is new.")
    expect(place).to_contain_text("cell-1 contact")
    expect(place).to_contain_text("cell-2 no payload")
    phone = windows(dashboard.server.url, size=PHONE, scheme="dark", touch=True)
    phone.open("#/")
    assert phone.overflow() <= 0
    assert audit(phone.page) == []


def test_live_model_comes_before_an_idle_one_with_a_candidate(visitor: Visitor, dashboard: Dashboard) -> None:
    page, live = visitor.page, "panda-sim"

    def answer(route: Route) -> None:
        body = route.fetch().json()
        states = {live: {"idle_s": 5, "candidate": None}, dashboard.model: {"idle_s": None, "candidate": 4}}
        route.fulfill(json={**body, "items": [{**each, **states.get(each["name"], {})} for each in body["items"]]})

    page.route("**/v1/overview?*", answer)
    visitor.open("#/")
    expect(card(page, dashboard.model)).to_contain_text("Version 4 is a candidate.")
    cards = page.get_by_role("region", name="Models").locator("li").all()
    order = [each.get_attribute("data-key") for each in cards]
    assert order.index(live) < order.index(dashboard.model)


@pytest.mark.parametrize("state", [slow("warning"), "failed"])
def test_health_is_one_line_until_a_check_fails(visitor: Visitor, state: str) -> None:
    page = visitor.page

    def answer(route: Route) -> None:
        body = route.fetch().json()
        checks = [
            {**each, "state": state, "message": "is nearly full"} if each["name"] == "home" else each
            for each in body["checks"]
        ]
        if state == "warning":
            route.fulfill(json={**body, "checks": checks})
        else:
            detail = [{"field": "home", "value": "is nearly full", "expected": "ok"}]
            route.fulfill(status=503, json={"error": {"code": "not_ready", "message": "no", "detail": detail}})

    visitor.expect_refusals(503)
    visitor.open("#/")
    health = page.get_by_role("region", name="Health")
    expect(health.get_by_role("status")).to_have_text("✓ ready")
    expect(health.get_by_role("listitem").filter(visible=True)).to_have_count(0)
    page.route("**/health/ready", answer)
    expect(health.get_by_role("status")).to_contain_text("with warnings" if state == "warning" else "not ready")
    expect(health.get_by_role("listitem").filter(visible=True)).to_have_count(1)
    expect(health.get_by_role("listitem").filter(visible=True)).to_contain_text("is nearly full")
    page.unroute_all(behavior="wait")
    expect(health.get_by_role("status")).to_have_text("✓ ready")
    expect(health.get_by_role("listitem").filter(visible=True)).to_have_count(0)


def test_serving_version_is_no_candidate(visitor: Visitor, dashboard: Dashboard) -> None:
    page = visitor.page
    changed(page, dashboard.model, serving_version=1, candidate=1)
    visitor.open("#/")
    expect(card(page, dashboard.model)).to_contain_text("Version 1 serves")
    expect(card(page, dashboard.model)).not_to_contain_text("candidate")
