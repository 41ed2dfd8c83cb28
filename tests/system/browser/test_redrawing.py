"""Updates of pages in place; states of the live page."""

from __future__ import annotations

import re
from itertools import cycle
from typing import TYPE_CHECKING, Any

import pytest

from tests.choosing import slow
from tests.service.data import stream
from tests.service.learning.payloads import payload_batches, send_payload_batches
from tests.service.models.versions import publish_arm_at
from tests.system.browser.accessibility import audit, expect
from tests.system.browser.conftest import Dashboard, Visit
from tests.system.browser.robot import playing
from tests.system.browser.visitor import PHONE, Visitor

if TYPE_CHECKING:
    from playwright.sync_api import ElementHandle, Locator, Route


def node(place: Locator) -> ElementHandle:
    """Return the node itself, to detect its replacement."""
    found = place.element_handle()
    assert found is not None
    return found


def there(kept: ElementHandle) -> bool:
    """Whether a node is still part of the page."""
    return kept.evaluate("(each) => each.isConnected")


@pytest.mark.parametrize("route", [slow("#/"), "#/jobs"])
def test_new_job_keeps_existing_links(visitor: Visitor, dashboard: Dashboard, route: str) -> None:
    page = visitor.open(route)
    place = page.get_by_role("main")
    some = place.locator('a[href^="#/jobs/"]').first
    expect(some).to_be_visible()
    known = place.locator(f'a[href="{some.get_attribute("href")}"]')
    links = [node(known), node(place.get_by_role("link", name="Train a model", exact=True).first)]
    if route == "#/":
        cards = ("Follow live: pendulum", "pendulum")
        links += [node(place.get_by_role("link", name=name, exact=True)) for name in ("All jobs", *cards)]
    links[0].focus()

    def more(route: Route) -> None:
        answer: dict[str, Any] = route.fetch().json()
        begun = {**dashboard.job, "id": "job_begun", "state": "queued", "version": None, "finished_at": None}
        route.fulfill(json={**answer, "items": [begun, *answer["items"]]})

    page.route("**/v1/jobs", more)
    expect(place.locator('a[href="#/jobs/job_begun"]')).to_be_visible()
    if route == "#/":
        expect(place.get_by_role("listitem").filter(has_text="queued")).to_have_count(1)
    assert [there(each) for each in links] == [True] * len(links)
    expect(known).to_be_focused()
    page.unroute_all(behavior="wait")


def test_overview_update_keeps_focus_and_open_details(visitor: Visitor) -> None:
    page = visitor.open("#/")
    health = page.get_by_role("region", name="Health")
    expect(health.get_by_role("status")).to_contain_text("ready")
    expect(health.get_by_text("database")).to_be_hidden()  # one line if all checks pass
    health.get_by_text("All checks").click()
    expect(health.get_by_text("database")).to_be_visible()
    models = page.get_by_role("region", name="Models")
    where = models.get_by_role("link").first.get_attribute("href")
    link = models.locator(f'a[href="{where}"]').first  # the order may change
    link.focus()
    with page.expect_response("**/v1/overview?*"), page.expect_response("**/health/ready"):
        pass
    expect(link).to_be_focused()
    expect(health.get_by_text("database")).to_be_visible()


PAYLOAD = 30.0
"""Change of the torque, N·m."""


@pytest.fixture(scope="module")
def arm(dashboard: Dashboard) -> str:
    """A model that streams may change: a copy of the shared one."""
    archive = dashboard.client.get(f"/v1/models/{dashboard.model}/export").content
    answer = dashboard.client.post(
        "/v1/models/import",
        content=archive,
        headers={"content-type": "application/x-tar"},
        params={"name": "live-arm", "promotion": "always"},
    )
    assert answer.status_code == 201, answer.text
    return "live-arm"


def test_change_is_decided_and_outdated_rows_are_marked(
    visitor: Visitor, dashboard: Dashboard, windows: Visit, arm: str
) -> None:
    page = visitor.open(f"#/live/{arm}")
    expect(page.get_by_text(f"lipserve stream {arm}")).to_be_visible()
    motion = stream(samples=400, rate=50.0, seed=21, speed=1.0)
    rows = cycle(zip(motion.q, motion.dq, motion.ddq, motion.tau + PAYLOAD, strict=True))
    with playing(dashboard.server.url, arm, rows, rate=50.0):
        decision = page.get_by_role("region", name="Decision")
        expect(decision).to_be_visible()
        expect(page.get_by_role("region", name="Alarms")).to_contain_text("change")
        expect(page.get_by_role("region", name="Innovation").locator(".legend")).to_contain_text(
            "waiting for a decision"
        )
        assert audit(page) == []
        phone = windows(dashboard.server.url, size=PHONE, scheme="dark", touch=True)
        phone.open(f"#/live/{arm}")
        expect(phone.page.get_by_role("region", name="Decision")).to_be_visible()
        assert phone.overflow() == 0
        assert audit(phone.page) == []
        decision.get_by_label("Also learn the rows rejected since then").check()
        decision.get_by_role("button", name="Adapt").click()
        page.get_by_role("dialog").get_by_role("button", name="Adapt").click()
        expect(page.get_by_text("Learning has resumed, with")).to_be_visible()
        expect(decision).to_have_count(0)
    expect(page.get_by_text("no new rows, data is outdated")).to_be_visible()


def test_live_page_shows_payloads_and_contacts(visitor: Visitor, dashboard: Dashboard) -> None:
    publish_arm_at(dashboard.server.home, "carrier")
    send_payload_batches(dashboard.client, "carrier", "cell-1")
    last = payload_batches("cell-1")[-1]  # again, now that the payload is estimated
    later = last | {"sequence": last["sequence"] + 1, "t": [each + 0.25 for each in last["t"]]}
    dashboard.client.post("/v1/models/carrier/observations", json=later).raise_for_status()
    send_payload_batches(dashboard.client, "carrier", "cell-2", mass=0.0, external_torque=30.0)
    page = visitor.open("#/live/carrier")
    carried = page.get_by_role("region", name="Payload", exact=True)
    lifted, touched = (carried.get_by_role("row").filter(has_text=name) for name in ("cell-1", "cell-2"))
    expect(lifted).to_contain_text(re.compile(r"1\.[45]\d ± 0\.\d\d\skg"))
    expect(lifted).to_contain_text(re.compile(r"payload.*since .*\d\d:\d\d:\d\d"))
    expect(touched).to_contain_text("no payload")
    expect(carried).to_contain_text("contact on cell-2")
    expect(page.get_by_role("region", name="Learning", exact=True)).to_contain_text("with a payload")
    assert audit(page) == []
    visitor.open(f"#/live/{dashboard.model}")
    expect(page.get_by_role("region", name="Learning", exact=True)).to_be_visible()
    expect(carried).to_have_count(0)


def test_live_page_without_model_lists_models(visitor: Visitor, dashboard: Dashboard) -> None:
    page = visitor.open("#/live")
    page.get_by_role("main").get_by_role("link", name=dashboard.model, exact=True).click()
    expect(page.get_by_role("heading", level=1, name=f"{dashboard.model} live")).to_be_visible()


def test_live_page_reconnects_after_a_lost_connection(visitor: Visitor, dashboard: Dashboard) -> None:
    page = visitor.open(f"#/live/{dashboard.model}")
    expect(page.get_by_text("connected, no rows yet")).to_be_visible()
    live = f"**/v1/models/{dashboard.model}/live"
    page.route(live, lambda route: route.abort())
    page.evaluate("window.dispatchEvent(new Event('hashchange'))")
    expect(page.get_by_text("connection lost")).to_be_visible()
    page.unroute(live)
    expect(page.get_by_text("connection lost")).to_have_count(0)
    expect(page.get_by_text("connected, no rows yet")).to_be_visible()
    visitor.problems[:] = [each for each in visitor.problems if "ERR_FAILED" not in each]  # caused by this test
