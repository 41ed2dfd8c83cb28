"""Animated pictures of a page, from frames that a test takes."""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from playwright.sync_api import FloatRect, Page

WIDTH_PX = 900
MAX_BYTES = 2_000_000
QUALITY = 70
SLOW, REST = 4, 15
"""Relative duration of slow frames, and of the last frame."""


class Film:
    """Frames of a page for LIPSERVE_SCREENSHOTS/name.webp, and one of them for name.png.

    Without LIPSERVE_SCREENSHOTS, nothing is recorded.
    """

    def __init__(self, page: Page, name: str) -> None:
        self.page, self.name = page, name
        self.folder = os.environ.get("LIPSERVE_SCREENSHOTS")
        self._frames: list[bytes] = []

    def take(self, clip: FloatRect) -> None:
        """Take a frame of a part of the window, CSS pixels."""
        if self.folder:
            self._frames.append(self.page.screenshot(clip=clip, animations="disabled", caret="hide"))

    def save(self, seconds: float, slow: range, still: int) -> None:
        """Write the frames, each shown for `seconds`.

        slow: frames that are shown longer; still: frame of name.png.
        """
        if not self.folder:
            return
        from PIL import Image

        frames = [Image.open(io.BytesIO(each)).convert("RGB") for each in self._frames]
        height = round(frames[0].height * WIDTH_PX / frames[0].width)
        small = [each.resize((WIDTH_PX, height), Image.Resampling.LANCZOS) for each in frames]
        path = Path(self.folder) / f"{self.name}.webp"
        path.parent.mkdir(parents=True, exist_ok=True)
        times = [SLOW if number in slow else 1 for number in range(len(small) - 1)] + [REST]
        lasting = [round(1000 * seconds * each) for each in times]
        small[0].save(path, save_all=True, append_images=small[1:], duration=lasting, loop=0, quality=QUALITY, method=4)
        small[still].save(path.with_suffix(".png"), optimize=True)  # not compressed: resizing adds colours
        assert path.stat().st_size <= MAX_BYTES, f"{path} has {path.stat().st_size} bytes"
