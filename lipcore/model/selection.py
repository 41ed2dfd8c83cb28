"""How an estimator was chosen, in plain data: for manifests, answers and pages."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TypedDict

import numpy as np

from lipcore.vocabulary import AUTO

MOST_TEXT = 300
"""Characters of a reason or an error."""


class Candidate(TypedDict):
    """How an estimator did on held-out samples.

    log_density: log predictive density, noise included, summed over the joints, nats a sample; difference: from that of
    the best, with its standard error; nmse, coverage: (n,), None for a joint whose torque does not vary; seconds: that
    it took; error: why it could not be trained. None where it was not judged.
    """

    estimator: str
    log_density: float | None
    difference: float | None
    standard_error: float | None
    nmse: list[float | None] | None
    coverage: list[float | None] | None
    seconds: float
    error: str | None


class HeldOut(TypedDict):
    """What was judged on: how many rows, in how many blocks.

    repeats: all motion of the recording repeats other motion of it, so that figures flatter.
    """

    rows: int
    blocks: int
    repeats: bool


class Selection(TypedDict):
    """How an estimator was chosen: what was asked for and what was chosen, why, on which rows, and how each did."""

    asked: str
    chosen: str
    reason: str
    held_out: HeldOut
    table: list[Candidate]


def selection(
    chosen: str, reason: str, table: list[Candidate], rows: int = 0, blocks: int = 0, repeats: bool = False
) -> Selection:
    """A choice of `auto`; rows, blocks and repeats of what was held out, nothing by default."""
    held = HeldOut(rows=rows, blocks=blocks, repeats=repeats)
    return Selection(asked=AUTO, chosen=chosen, reason=shortened(reason), held_out=held, table=table)


def unjudged(estimator: str, seconds: float, error: Exception | None = None) -> Candidate:
    """An estimator that was trained, in so many seconds, or failed with an error, and was not judged."""
    return Candidate(
        estimator=estimator,
        log_density=None,
        difference=None,
        standard_error=None,
        nmse=None,
        coverage=None,
        seconds=round(seconds, 3),
        error=None if error is None else shortened(f"{type(error).__name__}: {error}"),
    )


def shortened(text: str) -> str:
    """One line of printable characters, MOST_TEXT at most."""
    return "".join(each if each.isprintable() else " " for each in text)[:MOST_TEXT]


def plain(values: Iterable[float]) -> list[float | None]:
    """Numbers, None for what is not finite."""
    return [float(each) if np.isfinite(each) else None for each in values]
