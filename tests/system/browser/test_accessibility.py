"""Choice of the theme, and training of a model by keyboard. test_pages.py checks every page."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from tests.service.data import arrays, npz, stream
from tests.system.browser.accessibility import expect, focused, tab_to
from tests.system.browser.conftest import Dashboard, Visit
from tests.system.browser.visitor import Visitor


def test_theme_choice_is_kept(windows: Visit, dashboard: Dashboard) -> None:
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


def test_model_is_trained_by_keyboard_only(visitor: Visitor) -> None:
    samples = stream(seed=3)
    file = {"name": "keys.npz", "mimeType": "application/octet-stream", "buffer": npz(**arrays(samples))}
    page = visitor.open("#/")
    choosers: list[FileChooser] = []
    # before it opens: a later listener may miss it
    page.on("filechooser", lambda opened: choosers.append(opened))  # noqa: PLW0108 -- Playwright marks what it is given
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    at = focused(page)
    assert at is not None
    assert at["tag"] == "main", "the first tab stop skips the navigation"

    page.reload()
    tab_to(page, "Data")
    page.keyboard.press("Enter")
    visitor.settled()
    tab_to(page, "Choose files")
    page.keyboard.press("Enter")
    visitor.until(lambda: choosers)[0].set_files([file])
    expect(page.get_by_role("button", name="Upload", exact=True)).to_be_focused()
    page.keyboard.press("Enter")
    expect(page.get_by_role("link", name="Train on this recording")).to_be_visible()
    tab_to(page, "Train on this recording")
    page.keyboard.press("Enter")
    visitor.settled()

    tab_to(page, "Model name")
    page.keyboard.type("keys")
    tab_to(page, "Options")
    page.keyboard.press("Enter")
    expect(page.get_by_role("radio", name=re.compile("^lip-chain"))).to_be_visible()
    tab_to(page, "auto")
    expect(page.get_by_role("radio", name="auto")).to_be_focused()
    for _ in ("rigid-body", "rigid-body+local", "lip-chain"):
        page.keyboard.press("ArrowDown")
    expect(page.get_by_role("radio", name=re.compile("^lip-chain"))).to_be_checked()
    expect(page.get_by_label("max iterations", exact=True)).to_be_visible()
    tab_to(page, "hyperparameter samples")
    page.keyboard.type("20")
    tab_to(page, "max iterations")
    page.keyboard.type("4")
    page.keyboard.press("Enter")  # sends the form, as everywhere

    expect(page.get_by_role("link", name="View version 1")).to_be_visible()
    tab_to(page, "View version 1")
    page.keyboard.press("Enter")
    visitor.settled()
    tab_to(page, "Accuracy")
    page.keyboard.press("ArrowRight")
    expect(page.get_by_role("tab", selected=True)).to_be_focused()
    expect(page.get_by_role("tab", selected=True)).not_to_have_text("Accuracy")
