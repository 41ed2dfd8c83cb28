"""Accessibility checks in the page: keyboard, screen reader, contrast."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.system.browser.visitor import TIMEOUT_MS

if TYPE_CHECKING:
    from playwright.sync_api import Page

expect = pytest.importorskip("playwright.sync_api", reason="Playwright is missing: pip install playwright").expect
"""Playwright's `expect` with a long timeout. Without Playwright, the importing module is skipped."""
expect.set_options(timeout=TIMEOUT_MS)
AUDIT = (Path(__file__).parent / "audit.js").read_text()


def audit(page: Page) -> list[str]:
    """Return the problems of the page: names of controls, headings, landmarks, contrast."""
    return page.evaluate(AUDIT)


BOXES = (Path(__file__).parent / "boxes.js").read_text()
OPEN_DETAILS = "for (const each of document.querySelectorAll('main details')) each.open = true"


def layout_problems(page: Page) -> list[str]:
    """Return the texts and controls that overlap, are cut or leave their card, with all details closed, then open."""
    closed = page.evaluate(BOXES)
    page.evaluate(OPEN_DETAILS)
    return list(dict.fromkeys([*closed, *page.evaluate(BOXES)]))


FOCUSED = (Path(__file__).parent / "focused.js").read_text()


def focused(page: Page) -> dict[str, object] | None:
    """Return the focused element: `name`, `tag`, and whether it is visible: `ring`, `inView`; None if there is none."""
    return page.evaluate(FOCUSED)


def tab_to(page: Page, name: str, most: int = 80) -> dict[str, object]:
    """Press Tab until a control whose name starts with `name` is focused; the focus must always be visible."""
    passed: list[object] = []
    for _ in range(most):
        page.keyboard.press("Tab")
        at = focused(page)
        if at is None:
            continue
        assert at["ring"], f"the focus cannot be seen on {at}"
        if str(at["name"]).startswith(name):
            assert at["inView"], at
            return at
        passed.append(at["name"])
    raise AssertionError(f"no {name!r} is reached by Tab, only {passed}")
