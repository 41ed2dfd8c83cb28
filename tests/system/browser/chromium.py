"""A headless Chromium that can reach only this machine."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Browser

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
ARGUMENTS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--disable-dev-shm-usage",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    # no name but this machine's can be looked up: what the pages ask for elsewhere fails, whatever else fails to see it
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
    "--force-color-profile=srgb",
    "--hide-scrollbars",
)


def executable() -> str | None:
    """Path of a Chromium: LIPSERVE_CHROMIUM, or one that is installed; None where there is none."""
    return os.environ.get("LIPSERVE_CHROMIUM") or next((path for name in NAMES if (path := shutil.which(name))), None)


@contextmanager
def chromium() -> Iterator[Browser]:
    """Start the browser; skip, with the reason, where it or Playwright is missing.

    Playwright's synchronous interface keeps an event loop in the main thread while it lives: nothing else in this
    thread may run one, so leave it as soon as the browser's tests have ended.
    """
    api = pytest.importorskip("playwright.sync_api", reason="Playwright is missing: pip install playwright")
    path = executable()
    if path is None:
        pytest.skip("no Chromium: .ci/install-browser installs one on Debian; or set LIPSERVE_CHROMIUM to one")
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=list(ARGUMENTS))
        try:
            yield browser
        finally:
            browser.close()
