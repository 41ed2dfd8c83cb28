"""The theme that was chosen, and a model made with the keyboard alone. What every page owes: test_pages.py."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import pytest

from tests.browser.accessibility import expect, focused, tab_to
from tests.browser.conftest import Dashboard, Visit
from tests.browser.visitor import Visitor
from tests.service.data import arrays, npz, stream


@pytest.mark.slow
def test_the_theme_that_was_chosen_stays(windows: Visit, dashboard: Dashboard) -> None:
    visitor = windows(dashboard.server.url)
    page = visitor.open("#/")

    def background() -> str:
        return page.evaluate("getComputedStyle(document.body).backgroundColor")

    light = background()
    page.get_by_role("button", name="Theme: auto").click()
    page.get_by_role("button", name="Theme: light").click()
    expect(page.get_by_role("button", name="Theme: dark")).to_be_visible()
    assert background() != light
    visitor.open("#/")
    expect(page.get_by_role("button", name="Theme: dark")).to_be_visible()
    assert background() != light


if TYPE_CHECKING:
    from playwright.sync_api import FileChooser


@pytest.mark.slow
def test_a_model_is_made_without_a_mouse(visitor: Visitor) -> None:
    samples = stream(seed=3)
    file = {"name": "keys.npz", "mimeType": "application/octet-stream", "buffer": npz(**arrays(samples))}
    page = visitor.open("#/")
    choosers: list[FileChooser] = []
    # long before it opens, as listening later may miss it
    page.on("filechooser", lambda opened: choosers.append(opened))  # noqa: PLW0108 -- Playwright marks what it is given
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    at = focused(page)
    assert at is not None
    assert at["tag"] == "main", "the first stop skips what every page begins with"

    page.reload()
    tab_to(page, "Data")
    page.keyboard.press("Enter")
    visitor.settled()
    tab_to(page, "Choose files")
    page.keyboard.press("Enter")
    visitor.until(lambda: choosers)[0].set_files([file])
    expect(page.get_by_role("button", name="Upload", exact=True)).to_be_focused()
    page.keyboard.press("Enter")
    expect(page.get_by_role("link", name="Train on it")).to_be_visible()
    tab_to(page, "Train on it")
    page.keyboard.press("Enter")
    visitor.settled()

    tab_to(page, "Name of the model")
    page.keyboard.type("keys")
    tab_to(page, "More estimators")
    page.keyboard.press("Enter")
    expect(page.get_by_role("radio", name=re.compile("^lip-chain"))).to_be_visible()
    page.keyboard.press("Shift+Tab")
    expect(page.get_by_role("radio", name="auto")).to_be_focused()
    for _ in ("rigid-body", "rigid-body+local", "lip-chain"):
        page.keyboard.press("ArrowDown")
    expect(page.get_by_role("radio", name=re.compile("^lip-chain"))).to_be_checked()
    tab_to(page, "Advanced options")
    page.keyboard.press("Enter")
    expect(page.get_by_label("max iterations", exact=True)).to_be_visible()
    tab_to(page, "hyperparameter samples")
    page.keyboard.type("20")
    tab_to(page, "max iterations")
    page.keyboard.type("4")
    page.keyboard.press("Enter")  # sends the form, as everywhere

    expect(page.get_by_role("link", name="Look at version 1")).to_be_visible()
    tab_to(page, "Look at version 1")
    page.keyboard.press("Enter")
    visitor.settled()
    tab_to(page, "Accuracy")
    page.keyboard.press("ArrowRight")
    expect(page.get_by_role("tab", selected=True)).to_be_focused()
    expect(page.get_by_role("tab", selected=True)).not_to_have_text("Accuracy")
