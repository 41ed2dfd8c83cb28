"""Fenced blocks of the documentation, and the comments before them that say why one is not run."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tests import ROOT

GENERATED = ("docs/reference", "docs/reproduction")
"""Folders of pages that commands generate; other tests run them."""
ALLOWED_REASONS = frozenset(
    {
        "installs the package",
        "needs Docker",
        "needs Kubernetes",
        "needs a reverse proxy",
        "needs a robot",
        "needs ROS 2",
        "configuration of another program",
    }
)
"""Allowed reasons not to run a block."""
RUN_LANGUAGES = ("sh", "bash", "python", "json")
SLOW = "slow"
_MARK = re.compile(r"<!--\s*(?:not run:\s*(?P<reason>.*?)|(?P<slow>slow))\s*-->")
_FENCE = re.compile(r"(?P<indent> *)```(?P<language>[\w-]*)\s*")
_SERVE = re.compile(r"(\.venv/bin/)?lipserve serve\s*")


@dataclass(frozen=True)
class Block:
    """A fenced block. page: its file; line: of its fence; reason: why it is not run, None if it is."""

    page: Path
    line: int
    language: str
    text: str
    reason: str | None
    slow: bool

    @property
    def place(self) -> str:
        """Path and line, for messages."""
        return f"{self.page.relative_to(ROOT)}:{self.line}"

    @property
    def serves(self) -> bool:
        """Whether the block only starts the service, which runs until the end of the page."""
        return self.language in ("sh", "bash") and _SERVE.fullmatch(self.text) is not None


def pages() -> list[Path]:
    """Return README.md and the pages of docs that are written by hand."""
    return [path for path in all_pages() if not path.relative_to(ROOT).as_posix().startswith(GENERATED)]


def all_pages() -> list[Path]:
    """Return all pages, including generated ones."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def blocks(page: Path) -> list[Block]:
    """Return the blocks of a page in order. Blocks after a slow one are slow too, because they may depend on it."""
    return list(_blocks(page))


def _blocks(page: Path) -> Iterator[Block]:
    slow, mark = False, None
    lines = enumerate(page.read_text("utf-8").splitlines(), 1)
    for number, line in lines:
        if fence := _FENCE.fullmatch(line):
            text = []
            for _, inside in lines:
                if inside.strip() == "```":
                    break
                text.append(inside.removeprefix(fence["indent"]))
            else:
                raise ValueError(f"{page}:{number}: the block does not end")
            slow = slow or (mark is not None and mark["slow"] is not None)
            reason = None if mark is None else mark["reason"]
            yield Block(page, number, fence["language"], "\n".join(text), reason, slow)
        if line.strip():
            mark = _MARK.fullmatch(line.strip())


def prose(page: Path) -> str:
    """Return a page without its fenced blocks."""
    return re.sub(r"^ *```.*?^ *```$", "", page.read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)
