"""Fenced blocks of the documentation, and the marks before them that say why one is not run."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
GENERATED = ("docs/reference", "docs/reproduction")
"""Written by commands, which their own tests run."""
REASONS = frozenset(
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
"""Why a block may stay unrun; anything else has to run."""
RUN = ("sh", "bash", "python", "json")
SLOW = "slow"
_MARK = re.compile(r"<!--\s*(?:not run:\s*(?P<reason>.*?)|(?P<slow>slow))\s*-->")
_FENCE = re.compile(r"(?P<indent> *)```(?P<language>[\w-]*)\s*")
_SERVE = re.compile(r"(\.venv/bin/)?lipserve serve\s*")


@dataclass(frozen=True)
class Block:
    """A fenced block. page: its file; line: of its fence; reason: why it is not run, None where it is."""

    page: Path
    line: int
    language: str
    text: str
    reason: str | None
    slow: bool

    @property
    def place(self) -> str:
        """Where it is, for people."""
        return f"{self.page.relative_to(ROOT)}:{self.line}"

    @property
    def serves(self) -> bool:
        """Whether it starts the service and does nothing else: it goes on until the page has ended."""
        return self.language in ("sh", "bash") and _SERVE.fullmatch(self.text) is not None


def pages() -> list[Path]:
    """README.md, and every page of docs that is written by hand."""
    found = [path for path in sorted((ROOT / "docs").rglob("*.md")) if not _generated(path)]
    return [ROOT / "README.md", *found]


def all_pages() -> list[Path]:
    """Every page, generated ones too."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def _generated(path: Path) -> bool:
    return path.relative_to(ROOT).as_posix().startswith(GENERATED)


def blocks(page: Path) -> list[Block]:
    """The blocks of a page, in its order. One after a slow one is slow too: it may stand on what that has done."""
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
    """A page without its fenced blocks."""
    return re.sub(r"^ *```.*?^ *```$", "", page.read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)
