"""Observation batches. Written by `python clients/python/records.py`."""

from __future__ import annotations

from typing import Any, Literal

from lipserve.records import Record


class DerivedAcceleration(Record, frozen=True, kw_only=True):
    """Derivation of accelerations: the slope of a parabola through the velocities around each row.

    delay_s: Delay from a row to its acceleration, s
    window: Rows used on either side of a row
    rate_hz: Sampling rate of the rows, Hz
    carried: Rows of neighbouring batches that had to wait for this one and are counted with it
    """

    delay_s: float
    window: int
    rate_hz: float
    carried: int


class Derivation(Record, frozen=True, kw_only=True):
    """Derived quantities."""

    ddq: DerivedAcceleration


class ObservationResponse(Record, frozen=True, kw_only=True):
    """Acknowledgement: the rows are logged durably, and `accepted` of them are learnt soon.

    version: Version that predicted the rows before it learnt them
    revision: Responses of this version with this `revision` or a later one contain the batch
    rows: Rows received
    accepted: Rows that are learnt
    effective_samples: Effective samples of the accepted rows: neighbouring rows of a fast stream are correlated, and
        with `forgetting_s` late rows count less. Null for a batch logged by an earlier release
    duplicate: Whether the batch was received before; then this is its first acknowledgement
    state: Present state of the batch
    rejected: Rows that are stored but not learnt, by code: `non_finite`, `limit`, `time_jump`, `saturation`,
        `stationary`, `contact`, `change` (the robot changed or the stream does not fit, and the owner has not decided
        yet), `payload` (the arm carries a payload, which the row updates instead), `edge` (acceleration cannot be
        derived yet; if the stream continues, these are learnt with the next batch), `late` (so late that with
        `forgetting_s` it counts less than 0.001), `paused` (learning is paused), `implausible` (not a measured torque:
        zero against gravity, the model's own prediction, or constant while the arm moves)
    gaps: Latest ranges [first, last] of missing sequences of the stream
    derived: Derived quantities; null if all were sent
    held: Whether learning is paused until the model's owner decides about a change
    """

    model: str
    version: int
    revision: int
    stream_id: str
    sequence: int
    rows: int
    accepted: int
    effective_samples: float | None = None
    duplicate: bool
    state: Literal["learnt", "unlearnt", "rolled_back"]
    rejected: dict[str, int]
    gaps: list[list[int]]
    derived: Derivation | None = None
    held: bool


class Observation(Record, frozen=True, kw_only=True):
    """An observation batch of the log, and its outcome.

    last_sequence: Sequence of its last frame; equal to `sequence` if it came in one request
    event: Number of its event in the model's log
    first_at: Event time of its first row with a time
    last_at: Event time of its last row with a time
    version: Version that predicted its rows before they were learnt
    accepted: Rows that are learnt
    rejected: Rejected rows, by code
    """

    stream_id: str
    sequence: int
    last_sequence: int
    event: int
    state: Literal["learnt", "unlearnt", "rolled_back"]
    received_at: str
    first_at: str | None
    last_at: str | None
    version: int | None
    revision: int | None
    rows: int
    accepted: int
    rejected: dict[str, int]


class Figures(Record, frozen=True, kw_only=True):
    """Quality per joint over rows that could be predicted; null without rows, and nmse if torque is constant.

    nmse: Mean squared error / variance of the measured torque
    rmse: Root mean squared error, N·m
    coverage: Share of measurements inside the 95 % interval, noise included
    nlpd: Mean negative log predictive density, nats
    """

    rows: int
    nmse: list[float | None]
    rmse: list[float | None]
    coverage: list[float | None]
    nlpd: list[float | None]


class Replay(Record, frozen=True, kw_only=True):
    """Rejected rows of a batch that were learnt later.

    event: Number of its event in the model's log
    codes: Codes of these rows
    """

    event: int
    replayed_at: str
    state: Literal["learnt", "unlearnt", "rolled_back"]
    codes: list[str]
    rows: int


class ObservationRows(Record, frozen=True, kw_only=True):
    """All rows of a batch as stored; null stands for a number that is not finite.

    time: Event time, Unix seconds
    ddq: Accelerations as sent, or as derived from dq
    code: Outcome of each row: learnt, non_finite, limit, time_jump, saturation, stationary, contact, change, edge,
        payload, late, paused, implausible
    """

    time: list[float | None]
    q: list[list[float | None]]
    dq: list[list[float | None]]
    ddq: list[list[float | None]]
    tau: list[list[float | None]]
    code: list[str]


class ObservationDetail(Record, frozen=True, kw_only=True):
    """An observation batch with its acknowledgement, its quality and, if requested, its rows.

    last_sequence: Sequence of its last frame; equal to `sequence` if it came in one request
    event: Number of its event in the model's log
    first_at: Event time of its first row with a time
    last_at: Event time of its last row with a time
    version: Version that predicted its rows before they were learnt
    accepted: Rows that are learnt
    rejected: Rejected rows, by code
    report: The acknowledgement
    figures: Quality of the predictions of its rows; null if none could be predicted
    observed: Its rows, if requested. If accelerations were derived, they may include rows of neighbouring batches that
        had to wait for this one
    """

    stream_id: str
    sequence: int
    last_sequence: int
    event: int
    state: Literal["learnt", "unlearnt", "rolled_back"]
    received_at: str
    first_at: str | None
    last_at: str | None
    version: int | None
    revision: int | None
    rows: int
    accepted: int
    rejected: dict[str, int]
    report: dict[str, Any] | None
    figures: Figures | None
    replays: list[Replay]
    observed: ObservationRows | None


class Unlearnt(Record, frozen=True, kw_only=True):
    """An observation batch was unlearnt.

    rows: Rows that were unlearnt, replayed ones included
    trained: Versions that were trained after the batch arrived and may contain its rows. They are not changed
    """

    model: str
    version: int
    revision: int
    stream_id: str
    sequence: int
    rows: int
    trained: list[int]


class Replayed(Record, frozen=True, kw_only=True):
    """Rejected rows were learnt.

    codes: Learnt rows, by the code that rejected them
    """

    model: str
    version: int
    revision: int
    stream_id: str
    sequence: int
    rows: int
    codes: dict[str, int]
