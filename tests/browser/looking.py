"""Playwright's `expect`, as patient as machines are slow. Without Playwright the module that imports it is skipped."""

from __future__ import annotations

import pytest

from tests.browser.visitor import PATIENCE_MS

expect = pytest.importorskip("playwright.sync_api", reason="Playwright is missing: pip install playwright").expect
expect.set_options(timeout=PATIENCE_MS)
