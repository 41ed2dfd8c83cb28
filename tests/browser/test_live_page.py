"""The live page where something is out of the ordinary: a change to decide about, old rows, a lost connection."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from tests.browser.accessibility import audit
from tests.browser.conftest import Dashboard, Visit
from tests.browser.looking import expect
from tests.browser.visitor import PHONE, Visitor
from tests.service.data import stream
from tests.service.server import Server

PERIOD_S = 0.02
PAYLOAD = 30.0
"""By how much the torque is off what was learnt, N·m: as by a payload."""


@contextmanager
def robot(server: Server, model: str) -> Iterator[None]:
    """A simulated robot with a payload that streams until the end of the block."""
    from service.client.stream import StreamClient

    samples, stop = stream(samples=400, rate=50.0, seed=21, speed=1.0), threading.Event()

    def run() -> None:
        with StreamClient(model, server.url, stream_id="arm") as asked:
            for row in range(10**6):
                place = row % len(samples.t)
                asked.ask(samples.q[place], samples.dq[place], samples.ddq[place], tau=samples.tau[place] + PAYLOAD)
                if stop.wait(PERIOD_S):
                    return

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(30)


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
    with robot(dashboard.server, arm):
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
    visitor.expect_refusals(404)
    page = visitor.open("#/live/nobody")
    expect(page.get_by_text("Not there.")).to_be_visible()


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
