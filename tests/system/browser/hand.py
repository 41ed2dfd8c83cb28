"""What a task costs its user: clicks, fields, pages, scrolls and seconds."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from tests.system.browser.visitor import TIMEOUT_MS

if TYPE_CHECKING:
    from playwright.sync_api import Locator, Page

VISIBLE = """(each) => {
  const { top, bottom, left, right } = each.getBoundingClientRect();
  return top >= 0 && bottom <= innerHeight && left >= 0 && right <= innerWidth;
}"""


class Hand:
    """A user on one page of the dashboard, whose acts are counted from now on."""

    def __init__(self, page: Page) -> None:
        self.page, self.clicks, self.fields, self.keys, self.scrolls = page, 0, 0, 0, 0
        self.pages = {self._place()}
        self._begin = time.monotonic()
        self._waited = 0.0

    def click(self, target: Locator) -> None:
        """Click on a control."""
        self.see(target)
        self.clicks += 1
        target.click()

    def choose(self, button: Locator, path: Path) -> None:
        """Choose a file in the dialog that a button opens: one click and one field."""
        with self.page.expect_file_chooser() as opened:
            self.click(button)
        opened.value.set_files(path)
        self.fields += 1

    def type(self, field: Locator, text: str) -> None:
        """Replace the text of a field."""
        self.see(field)
        self.fields += 1
        self.keys += len(text)
        field.fill(text)

    def see(self, target: Locator, timeout_ms: float = TIMEOUT_MS) -> None:
        """Wait until a thing is shown, and scroll to it if it is outside the window."""
        target.wait_for(timeout=timeout_ms)
        self.pages.add(self._place())
        if not target.evaluate(VISIBLE):
            self.scrolls += 1
            target.scroll_into_view_if_needed()

    def wait(self, target: Locator, timeout_ms: float = TIMEOUT_MS) -> None:
        """Wait for the service, which is no act of the user."""
        begin = time.monotonic()
        target.wait_for(timeout=timeout_ms)
        self._waited += time.monotonic() - begin

    def report(self, task: str) -> None:
        """Print the counts and the seconds, without those of `wait`."""
        seconds = time.monotonic() - self._begin - self._waited
        counts = f"{self.clicks} clicks, {self.fields} fields, {self.keys} keys, {len(self.pages)} pages"
        waited = f" + {self._waited:.1f} s of waiting" if self._waited else ""
        sys.stdout.write(f"{task}: {counts}, {self.scrolls} scrolls, {seconds:.1f} s{waited}\n")

    def _place(self) -> str:
        return self.page.url.partition("?")[0]
