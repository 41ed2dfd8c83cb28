"""Events of a model that is followed live, as the API sends them."""

from __future__ import annotations

from pydantic import BaseModel, Field

from lipcore.online.record import LEVEL
from lipcore.vocabulary import CODES, JointType
from service.learning.control.schema import Alarm, Held, Nullable, QualityWindow

DECIMALS = 6
"""Of torques in `rows` events: millionths of a N·m."""


class LivePart(BaseModel):
    """Rows of one stream that were judged since the last event, predicted by one revision before it learnt them.

    All rows are counted, few are shown: evenly picked, but where some of a stretch are kept out, one of these.
    """

    stream_id: str
    version: int
    revision: int
    rows: int = Field(description="Rows that were judged, all of them")
    counts: dict[str, int] = Field(
        description=f"What became of them, by code: {', '.join(CODES)}. Rows at an `edge` come again with their "
        "acceleration, where the stream goes on"
    )
    worst: Nullable = Field(
        description="Per joint, the largest |tau - mean| of all rows in standard deviations of a measurement, "
        "sqrt(std² + noise_std²); null where none could be predicted"
    )
    noise_std: list[float] = Field(description="Of each joint, N·m")
    time: Nullable = Field(description="Event times of the rows shown, Unix seconds")
    q: Nullable = Field(description="Positions of the newest row shown, rad (m); empty where none is shown")
    tau: list[Nullable] = Field(description="Measured, N·m; null where it was not a finite number")
    mean: list[Nullable] = Field(description="Predicted before it was learnt, N·m; null where it could not be")
    std: list[Nullable] = Field(description="Of the learnt function, N·m: a measurement scatters by noise_std besides")
    code: list[str] = Field(description="What became of each")


class LiveRows(BaseModel):
    """Data of a `rows` event."""

    parts: list[LivePart]


class LiveNovelty(BaseModel):
    """Which of the rows of a stream that were shown since the last status the version's basis does not cover."""

    stream_id: str
    times: list[float] = Field(description="Their event times, Unix seconds")
    unknown: int = Field(description="Rows shown of which it is not known: looking at all of them would take too long")


class LiveAnswers(BaseModel):
    """Answers of the model's streams since the last status."""

    seconds: float = Field(description="How long that was")
    count: int = Field(description="Answers, those that were refused left out")
    refused: int
    late: int = Field(description="After their deadline: the frame's own, else LIPSERVE_STREAM_DEADLINE_S")
    p50_at_most_s: float | None = Field(
        description="Half of them took at most so long from their frame's arrival until they were ready: upper bound "
        "of a bucket of the histogram in /metrics. null: there were none, or it is beyond the largest bound"
    )
    p99_at_most_s: float | None = Field(description="The same of 99 %")


class LiveStatus(BaseModel):
    """Data of a `status` event: where the model stands now."""

    model: str
    at: float = Field(description="When, by the service's clock, Unix seconds")
    version: int = Field(description="The version that serves")
    revision: int = Field(description="The revision that answers contain now")
    lag_events: int = Field(description="Events of the log that answers do not contain yet")
    joint_names: list[str]
    joint_types: list[JointType] = Field(description="What the torques' units follow from: N·m, prismatic: N")
    torque_convention: str
    learns: bool = Field(description="Whether observations are taken at all")
    on_change: str = Field(description="What follows a detected change: hold, adapt or learn")
    contact_threshold: float = Field(description="Standard deviations beyond which a row is taken for a contact")
    held: Held | None = Field(description="Why learning waits for a decision; null where it does not")
    failure: str | None = Field(description="Why the version does not learn, where it should")
    novel_share: float | None = Field(
        description="Share of the latest samples that lie beyond the basis; null until some are learnt"
    )
    novel: list[LiveNovelty]
    counts: dict[str, int] = Field(
        description="Rows by what became of them, since the service has started; also `batches` and `duplicates`"
    )
    level: float = Field(LEVEL, description="Probability of the interval whose coverage is told")
    windows: list[QualityWindow] = Field(description="How well it predicted, over sliding windows")
    answers: LiveAnswers | None = Field(description="null at first, and where there are too many models to tell apart")
    alarms: list[Alarm] = Field(description="The newest ones, newest first")


class LiveLost(BaseModel):
    """Data of a `lost` event: whoever reads too slowly misses events rather than falling behind."""

    events: int = Field(description="Events of either kind that were dropped, the oldest ones")
