"""Records of how an estimator was chosen, as plain data for manifests, responses and pages."""

from collections.abc import Iterable
from typing import Annotated, NotRequired, TypedDict

import numpy as np
from msgspec import Meta

from lipcore.vocabulary import AUTO

MAX_TEXT_LENGTH = 300
"""Max characters of a reason or an error."""
MAX_NAME = 100

Name = Annotated[str, Meta(min_length=1, max_length=MAX_NAME)]
Sentence = Annotated[str, Meta(min_length=1, max_length=MAX_TEXT_LENGTH)]
Count = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Positive = Annotated[float, Meta(ge=0)]
Share = Annotated[float, Meta(ge=0, le=1)]


class Candidate(TypedDict):
    """Figures of an estimator on held-out samples; None if it was not evaluated."""

    estimator: Name
    log_density: float | None
    """Log predictive density with noise, summed over the joints, nats per sample."""
    difference: float | None
    """Difference of the log density from that of the best estimator."""
    standard_error: Positive | None
    """Standard error of that difference."""
    nmse: list[Positive | None] | None
    """(n,), None for a joint with constant torque."""
    edge_nmse: NotRequired[list[Positive | None] | None]
    """(n,), of the rows at the edge of the data, relative to the variance of all held-out rows."""
    coverage: list[Share | None] | None
    """(n,), share of measurements inside the 95 % interval."""
    seconds: Positive
    error: Sentence | None
    """Reason why it could not be trained."""


class HeldOut(TypedDict):
    """Sizes of the held-out part."""

    rows: Count
    blocks: Count
    repeats: bool
    """Whether the recording repeats itself. The figures are then too good, except at the edge."""
    edge_rows: NotRequired[Count]
    """Rows at the edge of the data."""
    edge_blocks: NotRequired[Count]


class Selection(TypedDict):
    """Choice of an estimator: the requested and the chosen one, the reason, the held-out rows, and all figures."""

    asked: Name
    chosen: Name
    reason: Sentence
    held_out: HeldOut
    table: Annotated[list[Candidate], Meta(min_length=1, max_length=10)]


def selection(chosen: str, reason: str, table: list[Candidate], held_out: HeldOut | None = None) -> Selection:
    """Return a choice of `auto`. By default nothing was held out."""
    held_out = held_out or HeldOut(rows=0, blocks=0, repeats=False, edge_rows=0, edge_blocks=0)
    return Selection(asked=AUTO, chosen=chosen, reason=shortened(reason), held_out=held_out, table=table)


def unevaluated_candidate(estimator: str, seconds: float, error: Exception | None = None) -> Candidate:
    """Return the record of an estimator that was not evaluated.

    seconds: duration of its training; error: the error with which it failed, None if it did not fail.
    """
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
    """Return a text as one line of printable characters, at most MAX_TEXT_LENGTH long."""
    return "".join(each if each.isprintable() else " " for each in text)[:MAX_TEXT_LENGTH]


def plain(values: Iterable[float]) -> list[float | None]:
    """Return numbers, with None for those that are not finite."""
    return [float(each) if np.isfinite(each) else None for each in values]
