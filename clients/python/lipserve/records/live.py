"""Events of a model followed live. Written by `python clients/python/records.py`."""

from __future__ import annotations

from typing import Literal

from lipserve.records import Record
from lipserve.records.learning import Alarm, Held, QualityWindow
from lipserve.records.payloads import Scalar


class LiveNovelty(Record, frozen=True, kw_only=True):
    """Which of the rows of a stream that were shown since the last status the version's basis does not cover.

    times: Their event times, Unix seconds
    unknown: Rows shown of which it is not known: looking at all of them would take too long
    """

    stream_id: str
    times: list[float]
    unknown: int


class LivePayload(Record, frozen=True, kw_only=True):
    """What one robot carries, in short.

    state: What its last rows show: `payload`, `contact`, `friction` (it has changed), or `none` of these
    declared: Whether the payload was declared, and not only seen
    since: Since when it carries what it carries, or nothing
    rows: Rows that the payload was seen on
    mass: kg; null: nothing that the model was not trained with
    """

    stream_id: str
    state: Literal["none", "payload", "contact", "friction"]
    declared: bool
    since: str | None
    rows: int
    mass: Scalar | None


class LiveAnswers(Record, frozen=True, kw_only=True):
    """Answers of the model's streams since the last status.

    seconds: How long that was
    count: Answers, those that were refused left out
    late: After their deadline: the frame's own, else LIPSERVE_STREAM_DEADLINE_S
    p50_at_most_s: Half of them took at most so long from their frame's arrival until they were ready: upper bound of a
        bucket of the histogram in /metrics. null: there were none, or it is beyond the largest bound
    p99_at_most_s: The same of 99 %
    """

    seconds: float
    count: int
    refused: int
    late: int
    p50_at_most_s: float | None
    p99_at_most_s: float | None


class LiveStatus(Record, frozen=True, kw_only=True):
    """Data of a `status` event: where the model stands now.

    at: When, by the service's clock, Unix seconds
    version: The version that serves
    revision: The revision that answers contain now
    lag_events: Events of the log that answers do not contain yet
    lag_rows: Rows to be learnt that answers do not contain yet
    lag_s: Seconds since the first row arrived that answers do not contain yet
    joint_types: What the torques' units follow from: N·m, prismatic: N
    learns: False: learning is paused
    on_change: What follows a detected change: hold, adapt or learn
    contact_threshold: Standard deviations beyond which a row is taken for a contact
    held: Why learning waits for a decision; null where it does not
    failure: Why the version does not learn, where it should
    novel_share: Share of the latest samples that lie beyond the basis; null until some are learnt
    counts: Rows by what became of them, since the service has started; also `batches` and `duplicates`
    level: Probability of the interval whose coverage is told
    windows: How well it predicted, over sliding windows
    scale: Per joint, factor on the half width that questions are answered with now
    payloads: What each stream's arm carries; null: no arm is known
    answers: null at first, and where there are too many models to tell apart
    alarms: The newest ones, newest first
    """

    model: str
    at: float
    version: int
    revision: int
    lag_events: int
    lag_rows: int
    lag_s: float
    joint_names: list[str]
    joint_types: list[Literal["revolute", "prismatic"]]
    torque_convention: str
    learns: bool
    on_change: str
    contact_threshold: float
    held: Held | None
    failure: str | None
    novel_share: float | None
    novel: list[LiveNovelty]
    counts: dict[str, int]
    level: float = 0.95
    windows: list[QualityWindow]
    scale: list[float]
    payloads: list[LivePayload] | None
    answers: LiveAnswers | None
    alarms: list[Alarm]


class LiveLost(Record, frozen=True, kw_only=True):
    """Data of a `lost` event: whoever reads too slowly misses events rather than falling behind.

    events: Events of either kind that were dropped, the oldest ones
    """

    events: int
