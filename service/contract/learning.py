"""Online learning of a model: status, and decisions of its owner."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, PlainValidator, WithJsonSchema

from lipcore.online.record import LEVEL
from lipcore.vocabulary import CODES, ExportFormat
from service.contract.body import RequestBody
from service.contract.models import VersionNumber
from service.contract.observations import MAX_SEQUENCE, LearningOptions, State
from service.contract.verdict import Verdict
from service.foundation.errors import invalid_request

REPLAYABLE = tuple(code for code in CODES if code not in ("learnt", "non_finite", "edge", "late"))
"""Codes of complete rows, which can still be learnt."""
Nullable = list[float | None]

AlarmKind = Literal["change", "payload", "novelty", "linearisation", "refresh", "promotion", "clock", "friction"]


class Figures(BaseModel):
    """Quality per joint over rows that could be predicted; null without rows, and nmse if torque is constant."""

    rows: int
    nmse: Nullable = Field(description="Mean squared error / variance of the measured torque")
    rmse: Nullable = Field(description="Root mean squared error, N·m")
    coverage: Nullable = Field(description="Share of measurements inside the 95 % interval, noise included")
    nlpd: Nullable = Field(description="Mean negative log predictive density, nats")


class QualityWindow(Figures):
    """Quality and outcomes of the rows that arrived in the last `seconds`."""

    seconds: float
    accepted: int = Field(description="Rows that are learnt")
    rejected: dict[str, int] = Field(description="Rejected rows, by code")
    coverage_answered: Nullable = Field(
        description="Coverage of the intervals in responses, which their `scale` widens, contacts and rows at rest "
        "included; null if the scale is off"
    )


class Quality(BaseModel):
    """Prequential quality: each row is predicted by the version and revision that served when it arrived."""

    model: str
    version: int
    revision: int = Field(description="Serving revision")
    joint_names: list[str]
    level: float = Field(LEVEL, description="Probability of the interval")
    windows: list[QualityWindow]
    scale: list[float] = Field(description="Per joint, the present factor on the half width of intervals")
    verdict: Verdict = Field(description="Verdict on the intervals in responses, by the shortest window")


class Observation(BaseModel):
    """An observation batch of the log, and its outcome."""

    stream_id: str
    sequence: int
    last_sequence: int = Field(description="Sequence of its last frame; equal to `sequence` if it came in one request")
    event: int = Field(description="Number of its event in the model's log")
    state: State
    received_at: str
    first_at: str | None = Field(description="Event time of its first row with a time")
    last_at: str | None = Field(description="Event time of its last row with a time")
    version: int | None = Field(description="Version that predicted its rows before they were learnt")
    revision: int | None
    rows: int
    accepted: int = Field(description="Rows that are learnt")
    rejected: dict[str, int] = Field(description="Rejected rows, by code")


class ObservationPage(BaseModel):
    """One page of observation batches, newest first."""

    items: list[Observation]
    next_cursor: str | None


class Replay(BaseModel):
    """Rejected rows of a batch that were learnt later."""

    event: int = Field(description="Number of its event in the model's log")
    replayed_at: str
    state: State
    codes: list[str] = Field(description="Codes of these rows")
    rows: int


class ObservationRows(BaseModel):
    """All rows of a batch as stored; null stands for a number that is not finite."""

    time: Nullable = Field(description="Event time, Unix seconds")
    q: list[Nullable]
    dq: list[Nullable]
    ddq: list[Nullable] = Field(description="Accelerations as sent, or as derived from dq")
    tau: list[Nullable]
    code: list[str] = Field(description=f"Outcome of each row: {', '.join(CODES)}")


class ObservationDetail(Observation):
    """An observation batch with its acknowledgement, its quality and, if requested, its rows."""

    report: dict[str, Any] | None = Field(description="The acknowledgement")
    figures: Figures | None = Field(
        description="Quality of the predictions of its rows; null if none could be predicted"
    )
    replays: list[Replay]
    observed: ObservationRows | None = Field(
        description="Its rows, if requested. If accelerations were derived, they may include rows of neighbouring "
        "batches that had to wait for this one"
    )


class Revised(BaseModel):
    """A change that every response of this version contains from this `revision` on."""

    model: str
    version: int
    revision: int


class Unlearnt(Revised):
    """An observation batch was unlearnt."""

    stream_id: str
    sequence: int
    rows: int = Field(description="Rows that were unlearnt, replayed ones included")
    trained: list[int] = Field(
        description="Versions that were trained after the batch arrived and may contain its rows. They are not changed"
    )


def _code(value: Any) -> str:
    if value not in REPLAYABLE:
        raise invalid_request("codes", value, f"one of {', '.join(REPLAYABLE)}: other rows cannot be learnt")
    return str(value)


ReplayCode = Annotated[str, PlainValidator(_code), WithJsonSchema({"type": "string", "enum": list(REPLAYABLE)})]


class ReplayRequest(RequestBody):
    """Rejected rows of a batch to be learnt after all."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"codes": ["contact"]}]})

    codes: list[ReplayCode] | None = Field(
        None,
        min_length=1,
        max_length=len(CODES),
        description="Codes of the rejected rows to learn; all codes by default",
    )


class Replayed(Revised):
    """Rejected rows were learnt."""

    stream_id: str
    sequence: int
    rows: int
    codes: dict[str, int] = Field(description="Learnt rows, by the code that rejected them")


class RollbackRequest(RequestBody):
    """Target of a rollback: a revision of the serving version, or another version."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"revision": 120}, {"version": 1}]})

    revision: int | None = Field(
        None,
        ge=0,
        le=MAX_SEQUENCE,
        description="Revision to return to. Later learning is undone; the log keeps the rows",
    )
    version: VersionNumber | None = Field(None, description="Version that serves from now on, with its own learning")


class RolledBack(Revised):
    """The model was rolled back."""

    undone: int = Field(description="Batches and replays that were undone")
    complete: bool = Field(
        description="Whether the log still has everything that the version learnt. For an old version it may not"
    )


class Stream(BaseModel):
    """A stream of observations from one robot or recording."""

    stream_id: str
    kind: Literal["batches", "frames"]
    last: int = Field(description="Highest sequence received")
    last_at: str | None = Field(description="Time of its arrival; null if an earlier release logged it")
    offset_s: float = Field(description="Event time (Unix seconds) minus the stream's own time")
    gaps: list[list[int]] = Field(description="Latest ranges [first, last] of missing sequences")
    missing: int = Field(description="Number of missing sequences in all stored gaps")
    forgotten: int | None = Field(
        description="Batches up to this sequence are deleted, and duplicates of them are not recognised"
    )


class Held(BaseModel):
    """A detected change of the robot, or a stream that does not fit it (`evidence.kind` is `opening`).

    Learning is paused until the owner decides or changes `on_change`.
    """

    at: float | None = Field(description="Event time of the change, Unix seconds")
    evidence: dict[str, Any]


class Snapshot(BaseModel):
    """A revision with a stored state."""

    revision: int
    created_at: str


class Export(BaseModel):
    """Last export of a model in one format."""

    format: ExportFormat
    version: int
    revision: int
    at: str
    outdated: bool = Field(description="Whether another version serves, or this one has learnt since")


class LearningStatus(BaseModel):
    """Status of learning."""

    version: int = Field(description="Serving version")
    revision: int = Field(description="Its revision once the whole log is learnt")
    published: int = Field(description="Serving revision")
    lag_events: int = Field(description="Events of the log that responses do not contain yet")
    lag_rows: int = Field(description="Rows to learn that responses do not contain yet")
    lag_s: float = Field(description="Time since the arrival of the first row that responses do not contain yet, s")
    events: int = Field(description="Number of the newest event of the log")
    novel_share: float | None = Field(
        description="Share of the latest samples that the model's basis does not represent; null until rows are learnt"
    )
    linearisation_error: list[float] | None = Field(
        None,
        description="Error of linearising the torque of a learnt arm around the trained arm: root mean square per "
        "joint in units of √(tau_std² + noise_std²). Zero for a joint predicted as well as stated; null without such "
        "an arm and until rows are learnt",
    )
    failure: str | None = Field(description="Why learning fails; null if it does not. It is retried")
    held: Held | None
    candidate: None = Field(
        None, deprecated=True, description="Always null: a refreshed version is compared before it is published"
    )
    streams: list[Stream]
    reachable: list[list[int]] = Field(
        description="Ranges [first, last] of revisions that a rollback can return to; 0 is the version as trained"
    )
    snapshots: list[Snapshot] = Field(description="Revisions with a stored state, newest first")
    exports: list[Export] = Field([], description="Last export in each format, newest first, from the audit log")


class Learning(BaseModel):
    """Learning options of a model, and the status of its learning."""

    model: str
    options: LearningOptions
    status: LearningStatus


class ChangeRequest(RequestBody):
    """Decision about a change that has paused learning."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"decision": "adapt", "replay": True}]})

    decision: Literal["adapt", "ignore"] = Field(
        description="`adapt`: the robot has changed, so earlier rows count less. `ignore`: resume learning as before"
    )
    replay: bool = Field(False, description="Also learn the rows that were rejected with the code `change`")


class Decided(Revised):
    """Learning was resumed."""

    decision: Literal["adapt", "ignore"]
    at: float | None = Field(description="Event time of the change, Unix seconds")
    rows: int = Field(description="Rejected rows that are learnt now")


class Alarm(BaseModel):
    """An alarm of a learning model for its owner."""

    id: int
    kind: AlarmKind
    at: str
    message: str
    evidence: dict[str, Any]


class AlarmPage(BaseModel):
    """One page of alarms, newest first."""

    items: list[Alarm]
    next_cursor: str | None


class RefreshRequest(RequestBody):
    """Refresh of the serving version, with its estimator, options and robot. There are no fields."""

    model_config = ConfigDict(json_schema_extra={"examples": [{}]})
