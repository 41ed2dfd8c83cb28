"""What the owner of a learning model sees and decides, and events of a model followed live, as the API has them."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, PlainValidator, WithJsonSchema

from lipcore.online.record import LEVEL
from lipcore.vocabulary import CODES, JointType
from service.contract.models import VersionNumber
from service.contract.observations import MOST_SEQUENCE, LearningOptions, State
from service.contract.payload import LivePayload
from service.foundation.errors import invalid_request

REPLAYABLE = tuple(code for code in CODES if code not in ("learnt", "non_finite", "edge", "late"))
"""Codes whose rows are complete, so that they can be learnt after all."""
Nullable = list[float | None]

AlarmKind = Literal["change", "payload", "novelty", "linearisation", "refresh", "promotion", "clock"]


class Figures(BaseModel):
    """Per joint, over rows that could be predicted; null where there are none, nmse also where torque did not vary."""

    rows: int
    nmse: Nullable = Field(description="Mean squared error / variance of the measured torque")
    rmse: Nullable = Field(description="N·m")
    coverage: Nullable = Field(description="Share of measurements inside the 95 % interval, noise included")
    nlpd: Nullable = Field(description="Mean negative log predictive density, nats")


class QualityWindow(Figures):
    """Figures of the rows that arrived in the last `seconds`, and what became of these."""

    seconds: float
    accepted: int = Field(description="Rows that teach")
    rejected: dict[str, int] = Field(description="Rows that were kept out, by code")
    coverage_answered: Nullable = Field(
        description="As `coverage`, of intervals as they were answered, wide by their `scale`, and of contacts and "
        "rows at rest, too; null where the scale is switched off"
    )


class Quality(BaseModel):
    """Prequential quality: each row is predicted by the version and revision that answered when it arrived."""

    model: str
    version: int
    revision: int = Field(description="That of answers now")
    joint_names: list[str]
    level: float = Field(LEVEL, description="Probability of the interval whose coverage is told")
    windows: list[QualityWindow]
    scale: list[float] = Field(description="Per joint, factor on the half width that questions are answered with now")


class Observation(BaseModel):
    """A batch of the log, and what became of it."""

    stream_id: str
    sequence: int
    last_sequence: int = Field(description="Of its last frame; equal to `sequence` where it came in one request")
    event: int = Field(description="Its place in the model's log")
    state: State
    received_at: str
    first_at: str | None = Field(description="Event time of its first row that has one")
    last_at: str | None = Field(description="Event time of its last row that has one")
    version: int | None = Field(description="The version that predicted its rows before they were learnt")
    revision: int | None
    rows: int
    accepted: int = Field(description="Rows that teach")
    rejected: dict[str, int] = Field(description="Rows that were kept out, by code")


class ObservationPage(BaseModel):
    """One page of batches, newest first."""

    items: list[Observation]
    next_cursor: str | None


class Replay(BaseModel):
    """Rows of a batch that were kept out at first and were learnt later."""

    event: int = Field(description="Its place in the model's log")
    replayed_at: str
    state: State
    codes: list[str] = Field(description="Codes whose rows were learnt")
    rows: int


class ObservationRows(BaseModel):
    """All rows of a batch as they are kept; null stands for what was not a finite number."""

    time: Nullable = Field(description="Event time, Unix seconds")
    q: list[Nullable]
    dq: list[Nullable]
    ddq: list[Nullable] = Field(description="As sent, or as derived from dq")
    tau: list[Nullable]
    code: list[str] = Field(description=f"What became of each: {', '.join(CODES)}")


class ObservationDetail(Observation):
    """A batch with its acknowledgement, how well it was predicted, and its rows where asked for."""

    report: dict[str, Any] | None = Field(description="What its acknowledgement said")
    figures: Figures | None = Field(description="How well its rows were predicted; null where none could be")
    replays: list[Replay]
    observed: ObservationRows | None = Field(
        description="Its rows, where asked for. A batch whose accelerations were derived may bring along rows of the "
        "batches next to it that had to wait for it"
    )


class Revised(BaseModel):
    """What was changed is in every answer of this version whose `revision` is at least this one."""

    model: str
    version: int
    revision: int


class Unlearnt(Revised):
    """A batch was taken out."""

    stream_id: str
    sequence: int
    rows: int = Field(description="Rows that do not teach any more, replayed ones included")
    trained: list[int] = Field(
        description="Versions trained after the batch came, perhaps on its rows: nothing is taken out of these"
    )


def _code(value: Any) -> str:
    if value not in REPLAYABLE:
        raise invalid_request("codes", value, f"some of {', '.join(REPLAYABLE)}: other rows cannot be learnt")
    return str(value)


ReplayCode = Annotated[str, PlainValidator(_code), WithJsonSchema({"type": "string", "enum": list(REPLAYABLE)})]


class ReplayRequest(BaseModel):
    """Which rows of a batch to learn after all."""

    model_config = ConfigDict(extra="forbid", strict=True, json_schema_extra={"examples": [{"codes": ["contact"]}]})

    codes: list[ReplayCode] | None = Field(
        None, min_length=1, max_length=len(CODES), description="Rows kept out by these codes; by any code by default"
    )


class Replayed(Revised):
    """Rows that were kept out are learnt."""

    stream_id: str
    sequence: int
    rows: int
    codes: dict[str, int] = Field(description="Rows by the code that had kept them out")


class RollbackRequest(BaseModel):
    """Where to go back to: a revision of the version that serves, or another version."""

    model_config = ConfigDict(
        extra="forbid", strict=True, json_schema_extra={"examples": [{"revision": 120}, {"version": 1}]}
    )

    revision: int | None = Field(
        None, ge=0, le=MOST_SEQUENCE, description="What was learnt after it is forgotten; the log keeps the rows"
    )
    version: VersionNumber | None = Field(None, description="It serves from now on, with what it has learnt itself")


class RolledBack(Revised):
    """The model is back where it was."""

    undone: int = Field(description="Batches and replays that do not teach any more")
    complete: bool = Field(
        description="Whether all is kept that the version learns: to an old version the log may reach back no more"
    )


class Stream(BaseModel):
    """A source of observations."""

    stream_id: str
    kind: Literal["batches", "frames"]
    last: int = Field(description="Highest sequence that has come")
    last_at: str | None = Field(description="When that came; null where an earlier release has logged it")
    offset_s: float = Field(description="Event time (Unix seconds) - the stream's own time")
    gaps: list[list[int]] = Field(description="Ranges [first, last] of sequences that have not come, the latest ones")
    missing: int = Field(description="Sequences that have not come, of all gaps that are kept")
    forgotten: int | None = Field(description="Up to this sequence batches are no longer kept, nor known again")


class Held(BaseModel):
    """The robot seems to have changed, or a stream not to be of it (`evidence.kind` is `opening`): nothing is learnt
    until the owner has decided, or has chosen otherwise."""

    at: float | None = Field(description="Event time of the change, Unix seconds")
    evidence: dict[str, Any]


class Snapshot(BaseModel):
    """A revision whose state is stored."""

    revision: int
    created_at: str


class LearningStatus(BaseModel):
    """Where learning stands."""

    version: int = Field(description="The version that serves")
    revision: int = Field(description="Its revision once all of the log is learnt")
    published: int = Field(description="The revision that answers contain now")
    lag_events: int = Field(description="Events of the log that answers do not contain yet")
    lag_rows: int = Field(description="Rows to be learnt that answers do not contain yet")
    lag_s: float = Field(description="Seconds since the first row arrived that answers do not contain yet")
    events: int = Field(description="Number of the newest event of the log")
    novel_share: float | None = Field(
        description="Share of the latest samples that lie beyond the basis; null until some are learnt"
    )
    linearisation_error: list[float] | None = Field(
        None,
        description="Error of taking the torque of a learnt arm as linear around the arm as trained, root mean square "
        "of each joint in units of √(tau_std² + noise_std²); zero for a joint predicted as well as stated, null "
        "without such an arm and until something is learnt",
    )
    failure: str | None = Field(description="Why the version does not learn, where it should; it is tried again")
    held: Held | None
    candidate: None = Field(
        None, deprecated=True, description="Always null: a refreshed version is compared before it is published"
    )
    streams: list[Stream]
    reachable: list[list[int]] = Field(
        description="Ranges [first, last] of revisions that a rollback can return to; 0 is the version as trained"
    )
    snapshots: list[Snapshot] = Field(description="Those whose state is stored, newest first")


class Learning(BaseModel):
    """How a model learns, as its owner has set it, and where it stands."""

    model: str
    options: LearningOptions
    status: LearningStatus


class ChangeRequest(BaseModel):
    """What to do about a change that learning is held for."""

    model_config = ConfigDict(
        extra="forbid", strict=True, json_schema_extra={"examples": [{"decision": "adapt", "replay": True}]}
    )

    decision: Literal["adapt", "ignore"] = Field(
        description="adapt: the robot has changed, what was learnt before counts less from then on; ignore: go on"
    )
    replay: bool = Field(False, description="Also learn the rows that were kept out since with the code `change`")


class Decided(Revised):
    """Learning goes on."""

    decision: Literal["adapt", "ignore"]
    at: float | None = Field(description="Event time of the change, Unix seconds")
    rows: int = Field(description="Rows that were kept out since and are learnt now")


class Alarm(BaseModel):
    """Something about a learning model that its owner should know."""

    id: int
    kind: AlarmKind
    at: str
    message: str
    evidence: dict[str, Any]


class AlarmPage(BaseModel):
    """One page of alarms, newest first."""

    items: list[Alarm]
    next_cursor: str | None


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
    lag_rows: int = Field(description="Rows to be learnt that answers do not contain yet")
    lag_s: float = Field(description="Seconds since the first row arrived that answers do not contain yet")
    joint_names: list[str]
    joint_types: list[JointType] = Field(description="What the torques' units follow from: N·m, prismatic: N")
    torque_convention: str
    learns: bool = Field(description="False: learning is paused")
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
    scale: list[float] = Field(description="Per joint, factor on the half width that questions are answered with now")
    payloads: list[LivePayload] | None = Field(description="What each stream's arm carries; null: no arm is known")
    answers: LiveAnswers | None = Field(description="null at first, and where there are too many models to tell apart")
    alarms: list[Alarm] = Field(description="The newest ones, newest first")


class LiveLost(BaseModel):
    """Data of a `lost` event: whoever reads too slowly misses events rather than falling behind."""

    events: int = Field(description="Events of either kind that were dropped, the oldest ones")


class RefreshRequest(BaseModel):
    """Nothing to choose: estimator, options and robot are those of the version that serves."""

    model_config = ConfigDict(extra="forbid", strict=True, json_schema_extra={"examples": [{}]})
