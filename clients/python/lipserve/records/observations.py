"""Batches that a model learns from. Written by `python clients/python/records.py`."""

from __future__ import annotations

from typing import Any, Literal

from lipserve.records import Record


class DerivedAcceleration(Record, frozen=True, kw_only=True):
    """How accelerations were derived: as the slope of a parabola through the velocities around a row.

    delay_s: How much later than its row an acceleration is known, s
    window: Rows on either side of a row that its acceleration stands on
    rate_hz: Rows a second
    carried: Rows of the batches next to this one that had to wait for it, decided and counted with it
    """

    delay_s: float
    window: int
    rate_hz: float
    carried: int


class Derivation(Record, frozen=True, kw_only=True):
    """What was not measured."""

    ddq: DerivedAcceleration


class ObservationResponse(Record, frozen=True, kw_only=True):
    """The rows are logged for good: `accepted` of them are learnt within a moment.

    version: The version that predicted the rows before it learnt them
    revision: Answers of this version with this `revision` or a later one contain the batch
    rows: Rows that came
    accepted: Rows to be learnt
    effective_samples: Independent samples that these count as now: rows of a fast stream tell nearly the same, and with
        `forgetting_s` late rows count less; null for a batch that an earlier release has logged
    duplicate: Whether the batch had come before: then this is what was said the first time
    state: What has become of the batch since
    rejected: Rows that are kept but not learnt, by code: `non_finite`, `limit`, `time_jump`, `saturation`,
        `stationary`, `contact`, `change` (a changed robot, or a stream that did not fit, and its owner has not
        decided), `payload` (the arm carries something, of which the row teaches instead), `edge` (acceleration not
        derivable; where the stream goes on, these are learnt with the next batch), `late` (came so late that by
        `forgetting_s` it counts less than a thousandth), `paused` (learning is paused), `implausible` (a torque that
        nobody has measured: zero against gravity, the model's own answer, or the same all the time while the arm moves)
    gaps: Ranges [first, last] of sequences of the stream that have not come, the latest ones
    derived: What was derived because it was not sent
    held: Whether learning stands still until the model's owner has decided about a change
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
    """A batch of the log, and what became of it.

    last_sequence: Of its last frame; equal to `sequence` where it came in one request
    event: Its place in the model's log
    first_at: Event time of its first row that has one
    last_at: Event time of its last row that has one
    version: The version that predicted its rows before they were learnt
    accepted: Rows that teach
    rejected: Rows that were kept out, by code
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
    """Per joint, over rows that could be predicted; null where there are none, nmse also where torque did not vary.

    nmse: Mean squared error / variance of the measured torque
    rmse: N·m
    coverage: Share of measurements inside the 95 % interval, noise included
    nlpd: Mean negative log predictive density, nats
    """

    rows: int
    nmse: list[float | None]
    rmse: list[float | None]
    coverage: list[float | None]
    nlpd: list[float | None]


class Replay(Record, frozen=True, kw_only=True):
    """Rows of a batch that were kept out at first and were learnt later.

    event: Its place in the model's log
    codes: Codes whose rows were learnt
    """

    event: int
    replayed_at: str
    state: Literal["learnt", "unlearnt", "rolled_back"]
    codes: list[str]
    rows: int


class ObservationRows(Record, frozen=True, kw_only=True):
    """All rows of a batch as they are kept; null stands for what was not a finite number.

    time: Event time, Unix seconds
    ddq: As sent, or as derived from dq
    code: What became of each: learnt, non_finite, limit, time_jump, saturation, stationary, contact, change, edge,
        payload, late, paused, implausible
    """

    time: list[float | None]
    q: list[list[float | None]]
    dq: list[list[float | None]]
    ddq: list[list[float | None]]
    tau: list[list[float | None]]
    code: list[str]


class ObservationDetail(Record, frozen=True, kw_only=True):
    """A batch with its acknowledgement, how well it was predicted, and its rows where asked for.

    last_sequence: Of its last frame; equal to `sequence` where it came in one request
    event: Its place in the model's log
    first_at: Event time of its first row that has one
    last_at: Event time of its last row that has one
    version: The version that predicted its rows before they were learnt
    accepted: Rows that teach
    rejected: Rows that were kept out, by code
    report: What its acknowledgement said
    figures: How well its rows were predicted; null where none could be
    observed: Its rows, where asked for. A batch whose accelerations were derived may bring along rows of the batches
        next to it that had to wait for it
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
    """A batch was taken out.

    rows: Rows that do not teach any more, replayed ones included
    trained: Versions trained after the batch came, perhaps on its rows: nothing is taken out of these
    """

    model: str
    version: int
    revision: int
    stream_id: str
    sequence: int
    rows: int
    trained: list[int]


class Replayed(Record, frozen=True, kw_only=True):
    """Rows that were kept out are learnt.

    codes: Rows by the code that had kept them out
    """

    model: str
    version: int
    revision: int
    stream_id: str
    sequence: int
    rows: int
    codes: dict[str, int]
