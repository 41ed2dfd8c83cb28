"""Events of the live view of a model."""

from __future__ import annotations

from pydantic import BaseModel, Field

from lipcore.online.record import LEVEL
from lipcore.vocabulary import CODES, JointType
from service.contract.learning import Alarm, Held, Nullable, QualityWindow
from service.contract.payload import LivePayload
from service.contract.verdict import Verdict

DECIMALS = 6
"""Decimals of torques in `rows` events: 1e-6 N·m."""


class LivePart(BaseModel):
    """Rows of one stream since the last event, predicted by one revision before it learnt them.

    All rows are counted, but only evenly spaced ones are shown. Where rows were rejected, a rejected one is shown.
    """

    stream_id: str
    version: int
    revision: int
    rows: int = Field(description="Number of all rows")
    counts: dict[str, int] = Field(
        description=f"Rows by outcome: {', '.join(CODES)}. Rows at an `edge` come again with their acceleration if the "
        "stream continues"
    )
    worst: Nullable = Field(
        description="Per joint, the largest |tau - mean| / sqrt(std² + noise_std²) of all rows; null if none could be "
        "predicted"
    )
    noise_std: list[float] = Field(description="Standard deviation of the noise, per joint, N·m")
    time: Nullable = Field(description="Event times of the rows shown, Unix seconds")
    q: Nullable = Field(description="Positions of the newest row shown, rad (m); empty if none is shown")
    tau: list[Nullable] = Field(description="Measured torque, N·m; null if it was not a finite number")
    mean: list[Nullable] = Field(description="Torque predicted before learning, N·m; null if it could not be predicted")
    std: list[Nullable] = Field(description="Standard deviation of the learnt function, N·m, without measurement noise")
    code: list[str] = Field(description="Outcome of each row shown")


class LiveRows(BaseModel):
    """Data of a `rows` event."""

    parts: list[LivePart]


class LiveNovelty(BaseModel):
    """Rows of a stream, shown since the last status, that the version's basis does not cover."""

    stream_id: str
    times: list[float] = Field(description="Event times of these rows, Unix seconds")
    unknown: int = Field(description="Shown rows that were not checked, to limit the time this takes")


class LiveAnswers(BaseModel):
    """Responses on the model's streams since the last status."""

    seconds: float = Field(description="Duration, s")
    count: int = Field(description="Number of responses without errors")
    refused: int
    late: int = Field(description="Responses after their deadline: the frame's own, else LIPSERVE_STREAM_DEADLINE_S")
    p50_at_most_s: float | None = Field(
        description="Upper bound of the median time from a frame's arrival to its response, s: a bucket bound of the "
        "histogram in /metrics. Null without responses or beyond the largest bound"
    )
    p99_at_most_s: float | None = Field(description="The same for the 99 % quantile")


class LiveStatus(BaseModel):
    """Data of a `status` event: the present status of the model."""

    model: str
    at: float = Field(description="Time of the status by the service's clock, Unix seconds")
    version: int = Field(description="Serving version")
    revision: int = Field(description="Serving revision")
    lag_events: int = Field(description="Events of the log that responses do not contain yet")
    lag_rows: int = Field(description="Rows to learn that responses do not contain yet")
    lag_s: float = Field(description="Time since the arrival of the first row that responses do not contain yet, s")
    joint_names: list[str]
    joint_types: list[JointType] = Field(description="Types that determine the torque units: N·m, prismatic: N")
    torque_convention: str
    learns: bool = Field(description="False: learning is paused")
    on_change: str = Field(description="Reaction to a detected change: hold, adapt or learn")
    contact_threshold: float = Field(description="Standard deviations beyond which a row counts as a contact")
    held: Held | None = Field(description="Why learning is paused until a decision; null if it is not")
    failure: str | None = Field(description="Why learning fails; null if it does not")
    novel_share: float | None = Field(
        description="Share of the latest samples that the model's basis does not represent; null until rows are learnt"
    )
    novel: list[LiveNovelty]
    counts: dict[str, int] = Field(
        description="Rows by outcome since the service started; also `batches` and `duplicates`"
    )
    level: float = Field(LEVEL, description="Probability of the interval")
    windows: list[QualityWindow] = Field(description="Prediction quality over sliding windows")
    scale: list[float] = Field(description="Per joint, the present factor on the half width of intervals")
    verdict: Verdict = Field(description="Verdict on the intervals in responses, by the shortest window")
    payloads: list[LivePayload] | None = Field(description="Payload of each stream; null without arm geometry")
    answers: LiveAnswers | None = Field(
        description="Null at first, and if the service has too many models to count them separately"
    )
    alarms: list[Alarm] = Field(description="Latest alarms, newest first")


class LiveLost(BaseModel):
    """Data of a `lost` event: a client that reads too slowly misses events."""

    events: int = Field(description="Number of dropped events, the oldest ones")
