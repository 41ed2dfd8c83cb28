"""Online learning: quality, options, decisions, alarms. Written by `python clients/python/records.py`."""

from __future__ import annotations

from typing import Any, Literal

from msgspec import field

from lipserve.records import Record
from lipserve.records.verdicts import Verdict


class RolledBack(Record, frozen=True, kw_only=True):
    """The model was rolled back.

    undone: Batches and replays that were undone
    complete: Whether the log still has everything that the version learnt. For an old version it may not
    """

    model: str
    version: int
    revision: int
    undone: int
    complete: bool


class QualityWindow(Record, frozen=True, kw_only=True):
    """Quality and outcomes of the rows that arrived in the last `seconds`.

    nmse: Mean squared error / variance of the measured torque
    rmse: Root mean squared error, N·m
    coverage: Share of measurements inside the 95 % interval, noise included
    nlpd: Mean negative log predictive density, nats
    accepted: Rows that are learnt
    rejected: Rejected rows, by code
    coverage_answered: Coverage of the intervals in responses, which their `scale` widens, contacts and rows at rest
        included; null if the scale is off
    """

    rows: int
    nmse: list[float | None]
    rmse: list[float | None]
    coverage: list[float | None]
    nlpd: list[float | None]
    seconds: float
    accepted: int
    rejected: dict[str, int]
    coverage_answered: list[float | None]


class Quality(Record, frozen=True, kw_only=True):
    """Prequential quality: each row is predicted by the version and revision that served when it arrived.

    revision: Serving revision
    level: Probability of the interval
    scale: Per joint, the present factor on the half width of intervals
    verdict: Verdict on the intervals in responses, by the shortest window
    """

    model: str
    version: int
    revision: int
    joint_names: list[str]
    level: float = 0.95
    windows: list[QualityWindow]
    scale: list[float]
    verdict: Verdict


class LearningOptions(Record, frozen=True, kw_only=True):
    """Options of online learning.

    enabled: False pauses learning: rows are predicted, checked and logged, but not learnt
    forgetting_s: Time constant of forgetting, s of event time: a sample of this age has the weight 1/e. Null: nothing
        is forgotten
    friction_walk_s: Time over which friction may drift by about 30 %, s, as in an arm that warms up. Learning follows
        it, and masses and geometry do not become less certain. 1800 suits most arms; null: friction does not drift
    on_change: Reaction if the robot has changed, or if the first second of a stream is outside the 95 % interval.
        `hold`: learning is paused until the owner decides; that second is not learnt. `adapt`: a new regime begins.
        `learn`: learning continues as before
    torque_limits: Max |tau| of each joint's actuator, N·m, to reject saturated samples; null: unknown
    contact_threshold: Predictive standard deviations, noise included, beyond which a torque counts as a contact
    adaptive_intervals: Adapt interval widths online, by the `scale` of responses, so that 95 % of the streams'
        measurements are inside. If false, the scale is 1
    payloads: Detect payloads that the arm picks up and puts down, and include them in predictions at once; for models
        with arm geometry. While a payload is carried, rows update the payload, not the arm
    auto_refresh: Retrain in the background when motion leaves the known region or the arm its linearisation
    auto_promote: Serve the retrained version if it predicts better
    """

    enabled: bool = True
    forgetting_s: float | None = None
    friction_walk_s: float | None = None
    on_change: Literal["hold", "adapt", "learn"] = "hold"
    torque_limits: list[float] | None = None
    contact_threshold: float = 8.0
    adaptive_intervals: bool = True
    payloads: bool = True
    auto_refresh: bool = True
    auto_promote: bool = True


class Held(Record, frozen=True, kw_only=True):
    """A detected change of the robot, or a stream that does not fit it (`evidence.kind` is `opening`).

    Learning is paused until the owner decides or changes `on_change`.

    at: Event time of the change, Unix seconds
    """

    at: float | None
    evidence: dict[str, Any]


class Stream(Record, frozen=True, kw_only=True):
    """A stream of observations from one robot or recording.

    last: Highest sequence received
    last_at: Time of its arrival; null if an earlier release logged it
    offset_s: Event time (Unix seconds) minus the stream's own time
    gaps: Latest ranges [first, last] of missing sequences
    missing: Number of missing sequences in all stored gaps
    forgotten: Batches up to this sequence are deleted, and duplicates of them are not recognised
    """

    stream_id: str
    kind: Literal["batches", "frames"]
    last: int
    last_at: str | None
    offset_s: float
    gaps: list[list[int]]
    missing: int
    forgotten: int | None


class Snapshot(Record, frozen=True, kw_only=True):
    """A revision with a stored state."""

    revision: int
    created_at: str


class Export(Record, frozen=True, kw_only=True):
    """Last export of a model in one format.

    outdated: Whether another version serves, or this one has learnt since
    """

    format: Literal["archive", "urdf", "mjcf", "c", "onnx", "torch", "jax"]
    version: int
    revision: int
    at: str
    outdated: bool


class LearningStatus(Record, frozen=True, kw_only=True):
    """Status of learning.

    version: Serving version
    revision: Its revision once the whole log is learnt
    published: Serving revision
    lag_events: Events of the log that responses do not contain yet
    lag_rows: Rows to learn that responses do not contain yet
    lag_s: Time since the arrival of the first row that responses do not contain yet, s
    events: Number of the newest event of the log
    novel_share: Share of the latest samples that the model's basis does not represent; null until rows are learnt
    linearisation_error: Error of linearising the torque of a learnt arm around the trained arm: root mean square per
        joint in units of √(tau_std² + noise_std²). Zero for a joint predicted as well as stated; null without such an
        arm and until rows are learnt
    failure: Why learning fails; null if it does not. It is retried
    candidate: Always null: a refreshed version is compared before it is published
    reachable: Ranges [first, last] of revisions that a rollback can return to; 0 is the version as trained
    snapshots: Revisions with a stored state, newest first
    exports: Last export in each format, newest first, from the audit log
    """

    version: int
    revision: int
    published: int
    lag_events: int
    lag_rows: int
    lag_s: float
    events: int
    novel_share: float | None
    linearisation_error: list[float] | None = None
    failure: str | None
    held: Held | None
    candidate: None = None
    streams: list[Stream]
    reachable: list[list[int]]
    snapshots: list[Snapshot]
    exports: list[Export] = field(default_factory=list)


class Learning(Record, frozen=True, kw_only=True):
    """Learning options of a model, and the status of its learning."""

    model: str
    options: LearningOptions
    status: LearningStatus


class Decided(Record, frozen=True, kw_only=True):
    """Learning was resumed.

    at: Event time of the change, Unix seconds
    rows: Rejected rows that are learnt now
    """

    model: str
    version: int
    revision: int
    decision: Literal["adapt", "ignore"]
    at: float | None
    rows: int


class Alarm(Record, frozen=True, kw_only=True):
    """An alarm of a learning model for its owner."""

    id: int
    kind: Literal["change", "payload", "novelty", "linearisation", "refresh", "promotion", "clock", "friction"]
    at: str
    message: str
    evidence: dict[str, Any]
