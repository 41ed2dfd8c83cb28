"""Define the rows that arrive online: samples with a time and a code."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lipcore.data.motion import Motion
from lipcore.data.samples import Array, joined_deflections
from lipcore.kernels.drive.play import PlayState
from lipcore.vocabulary import CODES, Code

AHEAD_S = 1.0
"""Max time by which learnt rows may be dated after their arrival, s."""


@dataclass(frozen=True)
class Rows:
    """N rows of n joints. time: (N,) event time, s; q, dq, ddq, tau: (N, n), SI; code: (N,) uint8 places in CODES.

    weight: (N,) effective samples of each row (see `data.independence`), one by default. deflections: (N, 2 K, n), see
    `Motion`, of play elements with these widths, (K, n); both None if the motion before is unknown.
    """

    time: Array
    q: Array
    dq: Array
    ddq: Array
    tau: Array
    code: NDArray[np.uint8]
    weight: Array = field(default_factory=lambda: np.empty(0))
    deflections: Array | None = None
    widths: Array | None = None

    def __post_init__(self) -> None:
        if not len(self.weight):
            object.__setattr__(self, "weight", np.ones(len(self.q)))
        for name in ("dq", "ddq", "tau"):
            if getattr(self, name).shape != self.q.shape:
                raise ValueError(
                    f"{name} has shape {getattr(self, name).shape}, expected {self.q.shape}, the shape of q"
                )
        for name in ("time", "code", "weight"):
            if getattr(self, name).shape != self.q.shape[:1]:
                raise ValueError(f"{name} has shape {getattr(self, name).shape}, expected {self.q.shape[:1]}")

    def __len__(self) -> int:
        return len(self.time)

    def take(self, index: slice | NDArray[np.int64] | NDArray[np.bool_]) -> Rows:
        """Return the chosen rows."""
        deflections = None if self.deflections is None else self.deflections[index]
        arrays = {name: getattr(self, name)[index] for name in ARRAYS}
        return Rows(**arrays, deflections=deflections, widths=self.widths)

    @property
    def learnt(self) -> Rows:
        """Return the rows with the code `learnt`."""
        teaches = self.code == Code.LEARNT
        return self if teaches.all() else self.take(teaches)

    def motion(self) -> Motion:
        """Return the motion; raise ValueError if a number of q, dq or ddq is not finite."""
        return replace(Motion.from_arrays(self.q, self.dq, self.ddq), deflections=self.deflections)

    def followed(self, before: PlayState, widths: Array) -> tuple[Rows, PlayState]:
        """Return the rows with their deflections, and the state after them. before: state before the first row."""
        deflections, after = before.follow(self.time, self.q, self.dq, widths)
        return replace(self, deflections=deflections, widths=widths), after

    def rejected(self) -> dict[str, int]:
        """Return the number of rows per code other than `learnt`, without zeros."""
        counts = np.bincount(self.code, minlength=len(CODES))
        return {code: int(count) for code, count in zip(CODES, counts, strict=True) if count and code != "learnt"}

    @staticmethod
    def concatenate(parts: Sequence[Rows]) -> Rows:
        """Return the rows of all parts in order."""
        arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in ARRAYS}
        deflections = joined_deflections([part.deflections for part in parts], [len(part) for part in parts])
        widths = next((part.widths for part in parts if part.widths is not None), None)
        return Rows(**arrays, deflections=deflections, widths=widths)


ARRAYS = ("time", "q", "dq", "ddq", "tau", "code", "weight")
"""Fields of `Rows` that have one entry a row in any case."""


@dataclass(frozen=True)
class Placement:
    """Where the rows of a logged batch lie in their stream: what neighbouring batches need."""

    own: tuple[int, int]
    """First and last place of the batch's own rows among the rows logged with it."""
    span: tuple[float, float] | None = None
    """First and last time by the stream's clock, s; None if no row has a time."""
    window: int | None = None
    """Rows on either side from which accelerations are derived; None if accelerations were measured."""
    frames: tuple[tuple[int, int], ...] = ()
    """Ranges of sequences of frames that were logged together."""

    def to_json(self) -> dict[str, Any]:
        """Return the fields as the log stores them; `window` is stored with the derived values."""
        frames = {"frames": [list(each) for each in self.frames]} if self.frames else {}
        return {"own": list(self.own), "span": None if self.span is None else list(self.span), **frames}

    @staticmethod
    def from_json(report: Mapping[str, Any]) -> Placement:
        """Read what `to_json` returned, from the log's report of a batch."""
        span, derived = report["span"], report["derived"]
        return Placement(
            tuple(report["own"]),
            None if span is None else tuple(span),
            None if derived is None else int(derived["ddq"]["window"]),
            tuple((first, last) for first, last in report.get("frames", ())),
        )
