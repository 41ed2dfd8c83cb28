"""What a page owes to those who use a keyboard or a screen reader, or see little; checked in the page itself."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.browser.visitor import PATIENCE_MS

if TYPE_CHECKING:
    from playwright.sync_api import Page

expect = pytest.importorskip("playwright.sync_api", reason="Playwright is missing: pip install playwright").expect
"""Playwright's, as patient as machines are slow. Without Playwright the module that imports it is skipped."""
expect.set_options(timeout=PATIENCE_MS)
AUDIT = (Path(__file__).parent / "audit.js").read_text()


def audit(page: Page) -> list[str]:
    """What is wrong with the page as it stands, a sentence each: names of controls, headings, landmarks, contrast."""
    return page.evaluate(AUDIT)


FOCUSED = (Path(__file__).parent / "focused.js").read_text()


def focused(page: Page) -> dict[str, object] | None:
    """What has the keyboard's focus: `name`, `tag`, and whether it can be seen: `ring`, `inView`. None: nothing."""
    return page.evaluate(FOCUSED)


def tab_to(page: Page, name: str, most: int = 80) -> dict[str, object]:
    """Press Tab until a control whose name starts with `name` has the focus, which has to be visible all the way."""
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
