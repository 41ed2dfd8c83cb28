"""What the learner process tells the service."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal


@dataclass(frozen=True)
class Published:
    """A version has learnt up to event `number`; answers of `revision` contain that.

    path: of the arrays, see `publication`; samples: weight of the rows learnt in this regime; novel_rows: rows beyond
    the basis since the process follows the version, novel_share: their share of the last ones; seconds: that learning
    and solving took; at: Unix time, s; linearisation: error of taking a learnt arm as linear, one number a joint, in
    units of what is stated, see `lipcore.model.warnings`; None without such an arm.
    """

    model: str
    version: int
    revision: int
    number: int
    path: Path
    samples: float
    novel_rows: int
    novel_share: float
    seconds: float
    at: float
    linearisation: tuple[float, ...] | None = None


@dataclass(frozen=True)
class Contested:
    """The contest between the version that serves and a candidate is decided."""

    model: str
    serving: int
    candidate: int
    verdict: Literal["promote", "dismiss"]
    evidence: dict[str, Any]


@dataclass(frozen=True)
class Failed:
    """A version cannot learn; it is tried again later. error: why, for people."""

    model: str
    version: int
    error: str


Message = Published | Contested | Failed
