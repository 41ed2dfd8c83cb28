"""How well a model learns, and what its owner sees and decides. Written by `python clients/python/records.py`."""

from __future__ import annotations

from typing import Any, Literal

from lipserve.records import Record


class RolledBack(Record, frozen=True, kw_only=True):
    """The model is back where it was.

    undone: Batches and replays that do not teach any more
    complete: Whether all is kept that the version learns: to an old version the log may reach back no more
    """

    model: str
    version: int
    revision: int
    undone: int
    complete: bool


class QualityWindow(Record, frozen=True, kw_only=True):
    """Figures of the rows that arrived in the last `seconds`, and what became of these.

    nmse: Mean squared error / variance of the measured torque
    rmse: N·m
    coverage: Share of measurements inside the 95 % interval, noise included
    nlpd: Mean negative log predictive density, nats
    accepted: Rows that teach
    rejected: Rows that were kept out, by code
    coverage_answered: As `coverage`, of intervals as they were answered, wide by their `scale`, and of contacts and
        rows at rest, too; null where the scale is switched off
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
    """Prequential quality: each row is predicted by the version and revision that answered when it arrived.

    revision: That of answers now
    level: Probability of the interval whose coverage is told
    scale: Per joint, factor on the half width that questions are answered with now
    """

    model: str
    version: int
    revision: int
    joint_names: list[str]
    level: float = 0.95
    windows: list[QualityWindow]
    scale: list[float]


class LearningOptions(Record, frozen=True, kw_only=True):
    """How a model learns from observations.

    enabled: False: learning is paused. Rows are judged, compared and logged, but not learnt
    forgetting_s: Age in s at which a sample counts 1/e of a new one, in event time; null: nothing is forgotten
    friction_walk_s: Time in s over which friction may change by about 30 %, as that of an arm that warms up does: it is
        followed, and masses and geometry are not opened. 1800 suits most arms; null: friction stays as learnt
    on_change: What follows a detected change of the robot, or a stream whose first second lies outside the 95 % band.
        `hold`: nothing is learnt until its owner decides, nor of that second; `adapt`: a new regime begins; `learn`:
        learning goes on as before
    torque_limits: Largest |tau| of each joint's actuator in N·m, to tell saturated samples; null: not known
    contact_threshold: Predictive standard deviations, noise included, beyond which a torque is taken for a contact
    adaptive_intervals: Widen and narrow intervals at once, so that 95 % of what streams measure lies inside: the
        `scale` of answers. Otherwise it is 1, as the model itself believes
    payloads: Notice what the arm takes up and puts down, and answer with it at once; for models that know the arm.
        Meanwhile rows teach the payload, and not the arm
    auto_refresh: Train a new version by itself where motion leaves what is known
    auto_promote: Let such a version serve if it predicts better
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
    """The robot seems to have changed, or a stream not to be of it (`evidence.kind` is `opening`): nothing is learnt
    until the owner has decided, or has chosen otherwise.

    at: Event time of the change, Unix seconds
    """

    at: float | None
    evidence: dict[str, Any]


class Stream(Record, frozen=True, kw_only=True):
    """A source of observations.

    last: Highest sequence that has come
    last_at: When that came; null where an earlier release has logged it
    offset_s: Event time (Unix seconds) - the stream's own time
    gaps: Ranges [first, last] of sequences that have not come, the latest ones
    missing: Sequences that have not come, of all gaps that are kept
    forgotten: Up to this sequence batches are no longer kept, nor known again
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
    """A revision whose state is stored."""

    revision: int
    created_at: str


class LearningStatus(Record, frozen=True, kw_only=True):
    """Where learning stands.

    version: The version that serves
    revision: Its revision once all of the log is learnt
    published: The revision that answers contain now
    lag_events: Events of the log that answers do not contain yet
    lag_rows: Rows to be learnt that answers do not contain yet
    lag_s: Seconds since the first row arrived that answers do not contain yet
    events: Number of the newest event of the log
    novel_share: Share of the latest samples that lie beyond the basis; null until some are learnt
    linearisation_error: Error of taking the torque of a learnt arm as linear around the arm as trained, root mean
        square of each joint in units of √(tau_std² + noise_std²); zero for a joint predicted as well as stated, null
        without such an arm and until something is learnt
    failure: Why the version does not learn, where it should; it is tried again
    candidate: Always null: a refreshed version is compared before it is published
    reachable: Ranges [first, last] of revisions that a rollback can return to; 0 is the version as trained
    snapshots: Those whose state is stored, newest first
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


class Learning(Record, frozen=True, kw_only=True):
    """How a model learns, as its owner has set it, and where it stands."""

    model: str
    options: LearningOptions
    status: LearningStatus


class Decided(Record, frozen=True, kw_only=True):
    """Learning goes on.

    at: Event time of the change, Unix seconds
    rows: Rows that were kept out since and are learnt now
    """

    model: str
    version: int
    revision: int
    decision: Literal["adapt", "ignore"]
    at: float | None
    rows: int


class Alarm(Record, frozen=True, kw_only=True):
    """Something about a learning model that its owner should know."""

    id: int
    kind: Literal["change", "payload", "novelty", "linearisation", "refresh", "promotion", "clock"]
    at: str
    message: str
    evidence: dict[str, Any]
