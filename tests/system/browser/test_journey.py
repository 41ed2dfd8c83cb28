"""The whole workflow in a browser: upload, train, evaluate, promote, roll back, follow a stream live."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from lipcore.data.samples import Samples
from tests.service.data import arrays, npz, stream, train
from tests.system.browser.accessibility import audit, expect
from tests.system.browser.conftest import Dashboard
from tests.system.browser.robot import playing
from tests.system.browser.visitor import Visitor

if TYPE_CHECKING:
    from playwright.sync_api import Locator

PICTURES = bool(os.environ.get("LIPSERVE_SCREENSHOTS"))
ROBOT = "panda" if PICTURES else "double-pendulum"
SAMPLES = 500 if PICTURES else 200
OPTIONS = {
    "hyperparameter samples": 200 if PICTURES else 40,
    "posterior samples": 300 if PICTURES else 60,
    "max iterations": 60 if PICTURES else 12,
}
"""Options of a short fit, or of a realistic one for pictures."""
NAME = "monday.npz"
LONG_MS = 180_000
RATE = 100.0
CONTACTS = slice(350, 356)
"""Rows of each cycle of the stream with a collision."""


def drawn(place: Locator, plots: int = 1) -> None:
    """Wait until at least `plots` plots are drawn, each with a text for screen readers."""
    expect(place.locator(".js-plotly-plot:has(.main-svg)").nth(plots - 1)).to_be_attached()
    for each in place.locator(".js-plotly-plot").all():
        assert each.get_attribute("aria-label"), each


def bumping(samples: Samples) -> Iterator[tuple[np.ndarray, ...]]:
    """Yield rows of a robot with collisions."""
    for row in range(len(samples.t)):
        tau = samples.tau[row] + (40.0 if row in range(CONTACTS.start, CONTACTS.stop) else 0.0)
        yield samples.q[row], samples.dq[row], samples.ddq[row], tau


def uploaded(visitor: Visitor, samples: Samples) -> None:
    """Upload a recording and check its report and plots."""
    page = visitor.page
    page.get_by_role("link", name="Upload a recording").first.click()
    body = npz(**arrays(samples), joint_names=list(samples.joint_names))
    file = {"name": NAME, "mimeType": "application/octet-stream", "buffer": body}
    page.get_by_label("Recordings to upload").set_input_files(file)
    page.get_by_role("button", name="Upload", exact=True).click()
    page.get_by_role("link", name="View report").click()

    expect(page.get_by_role("heading", level=1, name=NAME)).to_be_visible()
    drawn(page.locator("main"), 4)
    visitor.settled()
    assert audit(page) == []
    visitor.shot("dataset", 1700)


def trained(visitor: Visitor) -> None:
    """Train on the recording and follow the job until its version exists."""
    page = visitor.page
    page.get_by_role("link", name="Train on this recording").first.click()
    page.get_by_label("Model name").fill("my-arm")
    expect(page.get_by_label(f"Train on {NAME}")).to_be_checked()
    assert audit(page) == []
    page.get_by_text("Options", exact=True).click()
    page.locator('input[type=radio][value="lip-chain"]').check()
    for label, value in OPTIONS.items():
        page.get_by_label(label, exact=True).fill(str(value))
    page.get_by_role("button", name="Start training").click()

    expect(page.get_by_role("heading", level=1, name="Training my-arm")).to_be_visible()
    version = page.get_by_role("link", name="View version 1")
    expect(version).to_be_visible(timeout=LONG_MS)
    expect(page.get_by_text(re.compile(r"^On \d+ held-out samples"))).to_be_visible()
    visitor.settled()
    assert audit(page) == []
    version.click()


def judged(visitor: Visitor) -> None:
    """Check the plots of torque and components, and a prediction."""
    page = visitor.settled()
    expect(page.get_by_role("heading", level=1, name="my-arm")).to_be_visible()
    recording = page.get_by_label("Recording", exact=True)
    recording.select_option(label=str(recording.locator("option", has_text=NAME).first.text_content()))
    expect(page.get_by_label("Part", exact=True)).to_have_value("held_out")
    drawn(page.locator("main"), 3)
    expect(page.get_by_text("Optimistic figures")).to_have_count(0)
    assert audit(page) == []
    visitor.shot("model", 1500)
    page.get_by_label("Part", exact=True).select_option("all")
    expect(page.get_by_text("Optimistic figures").first).to_be_visible()

    page.get_by_role("tab", name="Components").click()
    drawn(page.locator("main"))
    assert audit(page) == []
    page.get_by_role("tab", name="Predict").click()
    page.get_by_text("All numbers").click()
    expect(page.get_by_role("columnheader", name="95 % band")).to_be_visible()


def promoted(visitor: Visitor, dashboard: Dashboard, dataset: str) -> None:
    """Serve an earlier version, roll back, and compare the two."""
    page = visitor.page
    train(dashboard.client, "my-arm", dataset)
    page = visitor.open("#/models/my-arm?tab=versions")
    follow = page.get_by_role("link", name="Follow live").element_handle()

    def serving() -> int:
        return dashboard.client.get("/v1/models/my-arm").json()["serving_version"]

    page.get_by_role("button", name="Serve: version 1").click()
    page.get_by_role("dialog").get_by_role("button", name="Cancel").click()
    assert serving() == 2
    page.get_by_role("button", name="Serve: version 1").click()
    page.get_by_role("dialog").get_by_role("button", name="Serve version 1").click()
    expect(page.get_by_text("Version 1 of my-arm is now serving.")).to_be_visible()
    assert serving() == 1
    page.get_by_role("button", name="Roll back: serving").click()
    page.get_by_role("dialog").get_by_role("button", name="Roll back to version 2").click()
    expect(page.get_by_text("serving → version 2")).to_be_visible()
    assert serving() == 2
    page.get_by_role("button", name="Compare", exact=True).click()
    expect(page.get_by_text("blocks; ±")).to_be_visible()
    assert audit(page) == []
    page.get_by_role("button", name="Serve: version 1").click()
    page.get_by_role("dialog").get_by_role("button", name="Serve version 1").click()
    visitor.until(lambda: serving() == 1)
    assert follow is not None
    assert follow.evaluate("(each) => each.isConnected")  # the link is still the same node


def followed(visitor: Visitor, dashboard: Dashboard) -> None:
    """Follow a stream: empty state, then plots of torque and prediction, then a contact."""
    page = visitor.page
    page.get_by_role("link", name="Follow live").click()
    expect(page.get_by_text("lipserve stream my-arm")).to_be_visible()
    assert audit(page) == []
    samples = stream(ROBOT, samples=6000, seed=8, rate=RATE)
    with playing(dashboard.server.url, "my-arm", bumping(samples), RATE):
        state = page.locator("main").get_by_role("status").first
        expect(state).to_contain_text("live")
        drawn(page.get_by_role("region", name="Torque"), len(samples.joint_names))
        drawn(page.get_by_role("region", name="Innovation"))
        expect(page.get_by_role("region", name="Learning").get_by_role("row", name="learnt")).to_be_visible()
        expect(page.get_by_role("region", name="Quality").get_by_role("row").nth(1)).to_be_visible()
        expect(page.get_by_role("region", name="Stream answers")).to_contain_text("≤")
        expect(page.get_by_role("region", name="Learning").get_by_role("row", name="contact")).to_be_visible()
        learning = page.get_by_role("region", name="Learning")
        visitor.until(lambda: "revision 0" not in learning.inner_text())  # the streamed rows were learnt
        assert audit(page) == []
        page.get_by_role("button", name="Pause plots").click()
        expect(state).to_contain_text("paused")
    expect(state).to_contain_text("no new rows")


def test_upload_train_evaluate_promote_and_follow_live(visitor: Visitor, dashboard: Dashboard) -> None:
    visitor.open("#/")
    uploaded(visitor, stream(ROBOT, samples=SAMPLES, seed=5))
    dataset = visitor.page.url.rsplit("/", 1)[1]
    trained(visitor)
    judged(visitor)
    promoted(visitor, dashboard, dataset)
    followed(visitor, dashboard)
