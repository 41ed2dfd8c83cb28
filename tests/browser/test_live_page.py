"""The live page where something is out of the ordinary: a change to decide about, old rows, a lost connection."""

from __future__ import annotations

from itertools import cycle

import pytest

from tests.browser.accessibility import audit
from tests.browser.conftest import Dashboard, Visit
from tests.browser.looking import expect
from tests.browser.robot import playing
from tests.browser.visitor import PHONE, Visitor
from tests.service.data import stream

PAYLOAD = 30.0
"""By how much the torque is off what was learnt, N·m: as by a payload."""


@pytest.fixture(scope="module")
def arm(dashboard: Dashboard) -> str:
    """A model that streams may teach: a copy of the shared one."""
    archive = dashboard.client.get(f"/v1/models/{dashboard.model}/export").content
    answer = dashboard.client.post(
        "/v1/models/import", content=archive, headers={"content-type": "application/x-tar"}, params={"name": "live-arm"}
    )
    assert answer.status_code == 201, answer.text
    return "live-arm"


@pytest.mark.slow
def test_a_change_is_decided_and_old_rows_are_said_to_be_old(
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
        expect(page.get_by_role("region", name="Innovation").locator(".legend")).to_contain_text("waits for a decision")
        assert audit(page) == []
        phone = windows(dashboard.server.url, size=PHONE, scheme="dark", touch=True)
        phone.open(f"#/live/{arm}")
        expect(phone.page.get_by_role("region", name="Decision")).to_be_visible()
        assert phone.overflow() == 0
        assert audit(phone.page) == []
        decision.get_by_label("Also learn the rows kept out since").check()
        decision.get_by_role("button", name="Adapt").click()
        page.get_by_role("dialog").get_by_role("button", name="Adapt").click()
        expect(page.get_by_text("that had been kept out")).to_be_visible()
        expect(decision).to_have_count(0)
    expect(page.get_by_text("no new rows: what is shown is old")).to_be_visible()


def test_who_chooses_no_model_is_asked_which(visitor: Visitor, dashboard: Dashboard) -> None:
    page = visitor.open("#/live")
    page.get_by_role("main").get_by_role("link", name=dashboard.model, exact=True).click()
    expect(page.get_by_role("heading", level=1, name=f"{dashboard.model} live")).to_be_visible()


@pytest.mark.slow
def test_a_lost_connection_is_said_and_made_again(visitor: Visitor, dashboard: Dashboard) -> None:
    page = visitor.open(f"#/live/{dashboard.model}")
    expect(page.get_by_text("connected, no rows yet")).to_be_visible()
    live = f"**/v1/models/{dashboard.model}/live"
    page.route(live, lambda route: route.abort())
    page.evaluate("window.dispatchEvent(new Event('hashchange'))")
    expect(page.get_by_text("connection lost")).to_be_visible()
    page.unroute(live)
    expect(page.get_by_text("connection lost")).to_have_count(0)
    expect(page.get_by_text("connected, no rows yet")).to_be_visible()
    visitor.problems[:] = [each for each in visitor.problems if "ERR_FAILED" not in each]  # which this test has made
