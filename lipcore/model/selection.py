"""How an estimator was chosen, in plain data: for manifests, answers and pages."""

from collections.abc import Iterable
from typing import Annotated, NotRequired, TypedDict

import numpy as np
from msgspec import Meta

from lipcore.vocabulary import AUTO

MOST_TEXT = 300
"""Characters of a reason or an error."""
MAX_NAME = 100

Name = Annotated[str, Meta(min_length=1, max_length=MAX_NAME)]
Sentence = Annotated[str, Meta(min_length=1, max_length=MOST_TEXT)]
Count = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Positive = Annotated[float, Meta(ge=0)]
Share = Annotated[float, Meta(ge=0, le=1)]


class Candidate(TypedDict):
    """How an estimator did on held-out samples; None if it was not judged."""

    estimator: Name
    log_density: float | None
    """Log predictive density, noise included, summed over the joints, nats a sample."""
    difference: float | None
    """Difference of the log density from that of the best."""
    standard_error: Positive | None
    """Standard error of that difference."""
    nmse: list[Positive | None] | None
    """(n,), None for a joint whose torque does not vary."""
    edge_nmse: NotRequired[list[Positive | None] | None]
    """(n,), of the rows at the edge of the data, over the variance of all held-out rows."""
    coverage: list[Share | None] | None
    """(n,), share of measurements inside the 95 % interval."""
    seconds: Positive
    error: Sentence | None
    """Why it could not be trained."""


class HeldOut(TypedDict):
    """What was held out to judge by."""

    rows: Count
    blocks: Count
    repeats: bool
    """Whether the recording repeats itself, so that figures flatter, except at the edge."""
    edge_rows: NotRequired[Count]
    """Rows at the edge of the data."""
    edge_blocks: NotRequired[Count]


class Selection(TypedDict):
    """How an estimator was chosen: what was asked for and what was chosen, why, on which rows, and how each did."""

    asked: Name
    chosen: Name
    reason: Sentence
    held_out: HeldOut
    table: Annotated[list[Candidate], Meta(min_length=1, max_length=10)]


def selection(chosen: str, reason: str, table: list[Candidate], held_out: HeldOut | None = None) -> Selection:
    """Return a choice of `auto`; nothing was held out by default."""
    held_out = held_out or HeldOut(rows=0, blocks=0, repeats=False, edge_rows=0, edge_blocks=0)
    return Selection(asked=AUTO, chosen=chosen, reason=shortened(reason), held_out=held_out, table=table)


def unjudged(estimator: str, seconds: float, error: Exception | None = None) -> Candidate:
    """An estimator that was trained, in so many seconds, or failed with an error, and was not judged."""
    return Candidate(
        estimator=estimator,
        log_density=None,
        difference=None,
        standard_error=None,
        nmse=None,
        edge_nmse=None,
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
