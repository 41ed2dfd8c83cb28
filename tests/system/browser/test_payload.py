"""A robot that picks up a payload, on the live page.

`make screenshots` records the film of the README with it. The time of the robot waits for the page.
"""

from __future__ import annotations

import os
import re
from typing import TYPE_CHECKING

import pytest

from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Payload, Simulation, simulate
from tests.service.data import eventually
from tests.system.browser.accessibility import audit, expect
from tests.system.browser.conftest import Dashboard, Visit
from tests.system.browser.film import Film

if TYPE_CHECKING:
    from lipcore.data.samples import Samples


PICTURES = bool(os.environ.get("LIPSERVE_SCREENSHOTS"))
MODEL, STREAM = "cell-7", "robot-7"
RATE = 100.0
MASS, TAKEN = 1.5, 8.0
"""Mass of the payload, kg, and time of the pickup, s."""
BEGIN, END = 5.5, 13.0
"""Time range of the film, s: at its start, a window of ten seconds is half full."""
STEP = 0.1 if PICTURES else 0.5
"""Time between two frames, s."""
WINDOW = (1180, 1100)
TOP = "document.querySelector('main').getBoundingClientRect().top"
BOTTOM = "document.querySelector('section[aria-label=Torque]').getBoundingClientRect().bottom"
SHOWN = """() => {
  const plot = document.querySelector("section[aria-label=Innovation] .js-plotly-plot");
  return plot?.data ? [plot.data[0].x.length, plot.data[0].y.slice(-40)].join() : "";
}"""
"""Return the newest innovations of the first joint, which are drawn last."""


@pytest.fixture
def robot(dashboard: Dashboard) -> str:
    """A copy of the shipped model, for the streaming arm."""
    archive = dashboard.client.get("/v1/models/panda-sim/export").content
    headers = {"content-type": "application/x-tar"}
    answer = dashboard.client.post(
        "/v1/models/import", content=archive, headers=headers, params={"name": MODEL, "promotion": "always"}
    )
    assert answer.status_code == 201, answer.text
    return MODEL


def batch(samples: Samples, first: int, last: int) -> dict[str, object]:
    """Return rows of a recording as an observation batch."""
    values = {name: getattr(samples, name)[first:last].tolist() for name in ("t", "q", "dq", "ddq", "tau")}
    return {"stream_id": STREAM, "sequence": first, **values}


def test_payload_is_estimated_and_included_in_predictions(windows: Visit, dashboard: Dashboard, robot: str) -> None:
    load = Payload(MASS, TAKEN)
    samples = simulate(
        load_robot("panda"), Simulation(int(END * RATE), RATE, noise=0.05, speed=5.0, payload=load), seed=3
    )
    client, where = dashboard.client, f"/v1/models/{robot}"
    visitor = windows(dashboard.server.url, size=WINDOW)
    page = visitor.open(f"#/live/{robot}?window=10")
    expect(page.get_by_text("connected, no rows yet")).to_be_visible()
    payload, forces = (page.get_by_role("region", name=name) for name in ("Payload", "External torque"))
    film = Film(page, "live")
    clip = None

    def send(first: float, last: float) -> None:
        """Send the rows of these seconds and wait until they are learnt and drawn."""
        before = page.evaluate(SHOWN)
        answer = client.post(f"{where}/observations", json=batch(samples, round(first * RATE), round(last * RATE)))
        assert answer.status_code == 200, answer.text
        eventually(lambda: client.get(f"{where}/learning").json()["status"]["lag_events"] == 0)
        visitor.until(lambda: page.evaluate(SHOWN) != before)

    for step in range(round(END / STEP)):
        at = step * STEP
        send(at, at + STEP)
        if at + STEP == pytest.approx(TAKEN):
            expect(payload).to_contain_text("no payload")
            expect(forces).to_contain_text("no external torque")
        if at < BEGIN:
            continue
        if clip is None:
            top, bottom = page.evaluate(TOP), page.evaluate(BOTTOM)
            clip = {"x": 0.0, "y": top, "width": float(WINDOW[0]), "height": bottom - top + 8}
        film.take(clip)
    expect(payload).to_contain_text(re.compile(r"1\.[45]\d+ ± 0\.\d+\skg"))
    expect(forces).to_contain_text("no external torque")
    expect(page.get_by_role("region", name="Alarms")).to_contain_text("more than in training")
    marks = page.locator(".linked .mark[data-word=payload]")
    expect(marks).to_have_count(8)  # one a joint, the innovation
    for mark in marks.all():  # at the start of the payload, not at its detection
        assert mark.evaluate("(mark) => parseFloat(mark.style.left)") == pytest.approx(10 * (10 - END + TAKEN), abs=3)
    assert audit(page) == []
    taken = round((TAKEN - BEGIN) / STEP)
    film.save(STEP, slow=range(taken, taken + 8), still=taken + 3)
