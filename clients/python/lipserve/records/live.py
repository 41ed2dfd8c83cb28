"""Events of the live view of a model. Written by `python clients/python/records.py`."""

from __future__ import annotations

from typing import Literal

from lipserve.records import Record
from lipserve.records.learning import Alarm, Held, QualityWindow
from lipserve.records.payloads import Scalar
from lipserve.records.verdicts import Verdict


class LiveNovelty(Record, frozen=True, kw_only=True):
    """Rows of a stream, shown since the last status, that the version's basis does not cover.

    times: Event times of these rows, Unix seconds
    unknown: Shown rows that were not checked, to limit the time this takes
    """

    stream_id: str
    times: list[float]
    unknown: int


class LivePayload(Record, frozen=True, kw_only=True):
    """Short summary of one robot's payload.

    state: State by the latest rows: `payload`, `contact`, `friction` (changed friction) or `none`
    declared: Whether the payload was declared rather than detected
    since: Time since which the robot carries this payload, or none
    rows: Rows used to estimate the payload
    mass: Mass, kg; null without a payload
    """

    stream_id: str
    state: Literal["none", "payload", "contact", "friction"]
    declared: bool
    since: str | None
    rows: int
    mass: Scalar | None


class LiveAnswers(Record, frozen=True, kw_only=True):
    """Responses on the model's streams since the last status.

    seconds: Duration, s
    count: Number of responses without errors
    late: Responses after their deadline: the frame's own, else LIPSERVE_STREAM_DEADLINE_S
    p50_at_most_s: Upper bound of the median time from a frame's arrival to its response, s: a bucket bound of the
        histogram in /metrics. Null without responses or beyond the largest bound
    p99_at_most_s: The same for the 99 % quantile
    """

    seconds: float
    count: int
    refused: int
    late: int
    p50_at_most_s: float | None
    p99_at_most_s: float | None


class LiveStatus(Record, frozen=True, kw_only=True):
    """Data of a `status` event: the present status of the model.

    at: Time of the status by the service's clock, Unix seconds
    version: Serving version
    revision: Serving revision
    lag_events: Events of the log that responses do not contain yet
    lag_rows: Rows to learn that responses do not contain yet
    lag_s: Time since the arrival of the first row that responses do not contain yet, s
    joint_types: Types that determine the torque units: N·m, prismatic: N
    learns: False: learning is paused
    on_change: Reaction to a detected change: hold, adapt or learn
    contact_threshold: Standard deviations beyond which a row counts as a contact
    held: Why learning is paused until a decision; null if it is not
    failure: Why learning fails; null if it does not
    novel_share: Share of the latest samples that the model's basis does not represent; null until rows are learnt
    counts: Rows by outcome since the service started; also `batches` and `duplicates`
    level: Probability of the interval
    windows: Prediction quality over sliding windows
    scale: Per joint, the present factor on the half width of intervals
    verdict: Verdict on the intervals in responses, by the shortest window
    payloads: Payload of each stream; null without arm geometry
    answers: Null at first, and if the service has too many models to count them separately
    alarms: Latest alarms, newest first
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
    verdict: Verdict
    payloads: list[LivePayload] | None
    answers: LiveAnswers | None
    alarms: list[Alarm]


class LiveLost(Record, frozen=True, kw_only=True):
    """Data of a `lost` event: a client that reads too slowly misses events.

    events: Number of dropped events, the oldest ones
    """

    events: int
