"""A browser window on the dashboard that records errors of the console and the network."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast
from urllib.parse import urlsplit

if TYPE_CHECKING:
    from playwright.sync_api import Browser, BrowserContext, ConsoleMessage, Page, Route

TIMEOUT_MS = 60_000
"""Timeout of any wait on a page, ms: the machine may be busy with other tests."""
DESKTOP = (1280, 800)
PHONE = (390, 844)
MAX_SHOT_BYTES = 250_000
"""Max size of a screenshot, bytes."""
UNDRAWN = "main :is(.plot, .strip):visible:not(:has(.main-svg)), main .objective:empty, main .arm:empty"
"""Places of plots that are not drawn yet."""
SLOW = ("Canvas2D: Multiple readback operations", "GPU stall due to ReadPixels")
"""Warnings of the browser about slow 3-D drawing without a graphics card."""
_REFUSED = "Failed to load resource: the server responded with a status of "


class Visitor:
    """A browser window on one service; `problems` lists its errors.

    size: width and height in CSS pixels. scheme: `light` or `dark`.
    """

    def __init__(
        self, browser: Browser, url: str, size: tuple[int, int] = DESKTOP, scheme: str = "light", touch: bool = False
    ) -> None:
        self.url, self.problems, self._refusals = url.rstrip("/"), list[str](), set[int]()
        self.context: BrowserContext = browser.new_context(
            viewport={"width": size[0], "height": size[1]},
            color_scheme="dark" if scheme == "dark" else "light",
            reduced_motion="reduce",
            has_touch=touch,
            is_mobile=touch,
            locale="en-GB",
            timezone_id="UTC",
        )
        self.context.set_default_timeout(TIMEOUT_MS)
        # intercept only requests to other hosts: Python may be busy
        self.context.route(re.compile(f"^(?!{re.escape(self.url)}/)"), self._outside)
        self.context.on("console", self._logged)
        self.context.on("weberror", lambda raised: self.problems.append(f"uncaught: {raised.error}"))
        self.context.on("request", lambda request: self._asked(request.url))
        self.page: Page = self.context.new_page()
        self.page.on("websocket", lambda socket: self._asked(socket.url))

    def expect_refusals(self, *statuses: int) -> None:
        """Ignore console errors about responses with these statuses."""
        self._refusals.update(statuses)

    def open(self, route: str = "#/") -> Page:
        """Open a page of the dashboard and wait until it is drawn; or of the service, if `route` starts with /."""
        address = self.url + (route if route.startswith("/") else f"/{route}")
        if self.page.url == address:
            self.page.reload()
        else:
            self.page.goto(address)
        if not route.startswith("/"):
            self.settled()
        return self.page

    def settled(self) -> Page:
        """Wait until the page is drawn and loads nothing more."""
        from tests.system.browser.accessibility import expect

        self.page.evaluate("new Promise((done) => setTimeout(done))")  # a changed hash takes effect a moment later
        self.page.locator("main").locator("h1, .error, .empty").first.wait_for()
        expect(self.page.locator("main .loading")).to_have_count(0)
        return self.page

    def drawn(self) -> Page:
        """Wait until the page and all plots of it are drawn."""
        from tests.system.browser.accessibility import expect

        expect(self.settled().locator(UNDRAWN)).to_have_count(0)
        return self.page

    def until(self, look: Callable[[], Any]) -> Any:
        """Call `look` until its result is true, and return it. Unlike a plain sleep, this processes browser events."""
        end = time.monotonic() + TIMEOUT_MS / 1000
        while not (seen := look()):
            assert time.monotonic() < end, "timeout"
            self.page.wait_for_timeout(20)
        return seen

    def shot(self, name: str, height: int | None = None) -> None:
        """Save a picture as LIPSERVE_SCREENSHOTS/name.png, if that is set.

        height: height of the picture from the top of the page, CSS pixels; None: that of the window.
        """
        folder = os.environ.get("LIPSERVE_SCREENSHOTS")
        if not folder:
            return
        path = Path(folder) / f"{name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        usual = self.page.viewport_size
        assert usual is not None
        if height is not None:
            self.page.set_viewport_size({"width": usual["width"], "height": height})
            self.page.evaluate("scrollTo(0, 0)")
            self.page.wait_for_timeout(1000)  # plots are drawn when they come into view
        self.page.screenshot(path=path, animations="disabled", caret="hide")
        self.page.set_viewport_size(usual)
        compress(path)
        assert path.stat().st_size <= MAX_SHOT_BYTES, f"{path} has {path.stat().st_size} bytes"

    def overflow(self) -> float:
        """Return the pixels by which the page is wider than the window."""
        return self.page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth")

    def close(self) -> None:
        """Close the window."""
        self.context.close()

    def _outside(self, route: Route) -> None:
        if urlsplit(route.request.url).scheme in {"data", "blob"}:
            route.continue_()
        else:
            route.abort()

    def _asked(self, url: str) -> None:
        address, ours = urlsplit(url), urlsplit(self.url)
        if address.scheme not in {"data", "blob"} and address.netloc != ours.netloc:
            self.problems.append(f"requested {url} from another host")

    def _logged(self, message: ConsoleMessage) -> None:
        text = message.text
        if message.type not in {"error", "warning"}:
            return
        if message.type == "warning" and any(each in text for each in SLOW):
            return
        if text.startswith(_REFUSED) and int(text.removeprefix(_REFUSED)[:3]) in self._refusals:
            return
        self.problems.append(f"console {message.type}: {text} ({message.location.get('url')})")


def compress(path: Path) -> None:
    """Reduce a picture to 256 colours, which is enough for plots and text."""
    from PIL import Image

    with Image.open(path) as opened:
        picture = opened.convert("RGB")
    counted = picture.getcolors(picture.width * picture.height)
    assert counted is not None
    # keep the most frequent colours exactly: those of joints and backgrounds
    kept = [colour for _, colour in sorted(counted, reverse=True)[:256]]
    palette = Image.new("P", (1, 1))
    palette.putpalette([part for colour in kept for part in cast("tuple[int, int, int]", colour)])
    picture.quantize(palette=palette, dither=Image.Dither.NONE).save(path, optimize=True)
