"""Facts about a machine with a verdict and advice, and access to the files that the kernel describes itself with."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Literal, NamedTuple

Verdict = Literal["ok", "warning", "unknown"]


class Finding(NamedTuple):
    """A fact about a part of the machine. advice: what to do about a warning."""

    part: str
    name: str
    value: str
    verdict: Verdict = "ok"
    advice: str = ""


class System:
    """Files of the kernel below `root`. Missing and unreadable files are None: containers and macOS lack many."""

    def __init__(self, root: Path = Path("/")) -> None:
        self.root = root

    def text(self, path: str) -> str | None:
        """Return the text of a file without surrounding white space."""
        try:
            return (self.root / path).read_text(errors="replace").strip()
        except (OSError, ValueError):
            return None

    def number(self, path: str) -> int | None:
        """Return the number in a file; None also for text such as `max`."""
        text = self.text(path)
        return int(text) if text is not None and re.fullmatch(r"-?\d+", text) else None

    def texts(self, pattern: str) -> list[str]:
        """Return the texts of all readable files of a pattern, in the order of their paths."""
        paths = sorted(self.root.glob(pattern))
        return [text for path in paths if (text := self.text(str(path.relative_to(self.root)))) is not None]

    def fields(self, path: str) -> dict[str, str]:
        """Return the lines `name: value` of a file."""
        lines = (self.text(path) or "").splitlines()
        return {name: value.strip() for name, colon, value in (line.partition(":") for line in lines) if colon}

    def control_groups(self, controller: str) -> Iterator[str]:
        """Yield the folders of this process's control group and of those above it, of version 2 and 1."""
        for line in (self.text("proc/self/cgroup") or "").splitlines():
            _, names, path = line.split(":", 2)
            if names and controller not in names.split(","):
                continue
            for base in [f"sys/fs/cgroup/{names}"] if names else ["sys/fs/cgroup", "sys/fs/cgroup/unified"]:
                at = Path(path.lstrip("/"))
                # a container sees its own group as the topmost one, whatever its path is
                yield from (str(Path(base) / each) for each in (at, *at.parents))
