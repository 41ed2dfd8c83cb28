"""Five tasks of a user from the overview, and the clicks that each takes; `pytest -s` prints the seconds."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Payload, Simulation, simulate
from service.cli.simulate import write_recording
from tests.service.data import QUICK, stream, train
from tests.system.browser.accessibility import audit
from tests.system.browser.conftest import Dashboard, Visit
from tests.system.browser.hand import Hand
from tests.system.browser.robot import playing

if TYPE_CHECKING:
    from playwright.sync_api import Locator, Page, Route

WINDOW = (1440, 900)
RATE, SECONDS = 100.0, 60.0
MASS, PICKUP = 1.5, 4.0
"""Mass of the payload, kg, and time of its pickup, s."""
TRAINING_MS = 180_000


@pytest.fixture
def page(windows: Visit, dashboard: Dashboard) -> Page:
    """The overview."""
    return windows(dashboard.server.url, size=WINDOW).open("#/")


@pytest.fixture
def versions(dashboard: Dashboard) -> str:
    """A model of three versions, of which the third serves."""
    for _ in range(3):
        train(dashboard.client, "promoted", dashboard.dataset["id"], promotion="always")
    return "promoted"


@pytest.fixture(scope="module")
def robot(dashboard: Dashboard) -> Iterator[str]:
    """A model with the stream of a robot that picks up a payload."""
    archive = dashboard.client.get("/v1/models/panda-sim/export").content
    headers, name = {"content-type": "application/x-tar"}, "picker"
    chosen = {"name": name, "promotion": "always"}
    answer = dashboard.client.post("/v1/models/import", content=archive, headers=headers, params=chosen)
    assert answer.status_code == 201, answer.text
    plan = Simulation(int(SECONDS * RATE), RATE, noise=0.05, speed=5.0, payload=Payload(MASS, PICKUP))
    samples = simulate(load_robot("panda"), plan, seed=3)
    with playing(dashboard.server.url, name, rows(samples.q, samples.dq, samples.ddq, samples.tau), RATE):
        yield name


def rows(*columns: np.ndarray) -> Iterator[tuple[np.ndarray, ...]]:
    """Yield the rows of a robot again and again."""
    while True:
        yield from zip(*columns, strict=True)


def card(page: Page, model: str) -> Locator:
    """Return a model's card on the overview."""
    return page.locator(f'li[data-key="{model}"]')


def button(page: Page, name: str) -> Locator:
    """Return the button with exactly this name."""
    return page.get_by_role("button", name=name, exact=True)


def link(page: Page, name: str) -> Locator:
    """Return the first link with exactly this name."""
    return page.get_by_role("link", name=name, exact=True).first


def train_quickly(page: Page) -> None:
    """Make the page's training requests those of a short fit."""

    def answer(route: Route) -> None:
        route.continue_(
            post_data=json.dumps({**route.request.post_data_json, "estimator": "lip-chain", "options": QUICK})
        )

    page.route("**/v1/jobs", lambda route: answer(route) if route.request.method == "POST" else route.continue_())


def test_from_file_to_verdict(page: Page, tmp_path: Path) -> None:
    write_recording(tmp_path / "Cell 4.csv", stream(samples=200, seed=11))
    train_quickly(page)
    hand = Hand(page)
    hand.click(link(page, "Upload a recording"))
    hand.choose(button(page, "Choose files"), tmp_path / "Cell 4.csv")
    hand.click(button(page, "Upload"))
    hand.click(link(page, "Train on this recording"))
    hand.click(button(page, "Start training"))
    verdict = page.get_by_role("region", name="Result").get_by_role("note")
    hand.wait(verdict, TRAINING_MS)
    hand.see(verdict)
    hand.report("from file to verdict")
    assert (hand.clicks, hand.fields) == (5, 1)
    assert page.get_by_role("heading", level=1).inner_text() == "Training cell-4"


def test_which_version_serves_and_why_and_the_old_one_back(page: Page, versions: str) -> None:
    hand = Hand(page)
    hand.click(link(page, versions))
    hand.click(button(page, "Roll back to version 2"))
    hand.click(page.get_by_role("dialog").get_by_role("button", name="Roll back to version 2"))
    why = page.get_by_text("Version 2 is serving: rolled back from version 3,")
    hand.see(why)
    hand.report("put the old version back")
    assert (hand.clicks, hand.fields) == (3, 0)
    assert audit(page) == []

    page.get_by_role("link", name="Overview").first.click()
    page.get_by_role("heading", level=1, name="Overview").wait_for()
    hand = Hand(page)
    hand.see(card(page, versions).get_by_text("Version 2 serves:"))
    hand.click(link(page, versions))
    hand.see(why)
    hand.report("which version serves, and why")
    assert (hand.clicks, hand.fields) == (1, 0)


def test_is_the_robot_all_right_and_what_does_it_carry(page: Page, robot: str) -> None:
    card(page, robot).locator(".live").wait_for()
    hand = Hand(page)
    hand.click(link(page, f"Follow live: {robot}"))
    state = page.locator("main").get_by_role("status").first
    for word in ("live", "learning up to date", "usable"):
        hand.see(state.get_by_text(re.compile(rf"^\W*{word}")))
    hand.report("is the robot all right now")
    assert (hand.clicks, hand.fields) == (1, 0)

    page.get_by_role("link", name="Overview").first.click()
    payload = card(page, robot).locator("dd", has_text=re.compile(r"1\.[45]\d+ ± 0\.\d+\skg"))
    hand = Hand(page)
    hand.wait(payload)
    hand.see(payload)
    hand.report("what did it pick up")
    assert (hand.clicks, hand.fields) == (0, 0)
