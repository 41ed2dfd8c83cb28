"""Models, their versions and aliases. Written by `python clients/python/records.py`."""

from __future__ import annotations

from typing import Any, Literal

from lipserve.records import Record


class HeldOutQuality(Record, frozen=True, kw_only=True):
    """How well the judged fit of a version predicts what was held out, per joint; null where torque does not vary.

    samples: Samples that the figures are of
    nmse: Mean squared error / variance of the measured torque
    coverage: Share of measurements inside the 95 % interval
    coverage_low: Lower end of the coverage's confidence interval
    coverage_high: Its upper end
    """

    samples: int
    nmse: list[float | None]
    coverage: list[float | None]
    coverage_low: list[float]
    coverage_high: list[float]


class Promotion(Record, frozen=True, kw_only=True):
    """Whether a version that was trained answers by itself, and why: judged by what its training held out.

    answers: Whether it answered once it was trained; else it waits under alias `candidate`
    passed: Whether its error is below that of the mean torque on every joint, its intervals hold 90 %, and it is not
        worse than the version that serves; null where that cannot be told
    serving: The version that answered until then; null where none did
    """

    answers: bool
    passed: bool | None
    serving: int | None
    reason: str


class VersionSummary(Record, frozen=True, kw_only=True):
    """A version in the list of its model.

    quality: On what its training held out; null where that was nothing
    promotion: Whether it answers by itself, and why; null for one that was refreshed or shipped
    """

    version: int
    created_at: str
    estimator: str
    quality: HeldOutQuality | None = None
    promotion: Promotion | None = None


class Model(Record, frozen=True, kw_only=True):
    """A named model. Queries are answered by the version that serves unless they name another.

    latest_version: The newest version
    serving_version: The version that answers where none is named; null where all wait as candidates
    aliases: Names that were given to versions, `serving` aside
    """

    name: str
    created_at: str
    latest_version: int
    serving_version: int | None
    aliases: dict[str, int]
    versions: list[VersionSummary]


class SelectionHeldOut(Record, frozen=True, kw_only=True):
    """What `auto` held out to choose by; the chosen estimator has learnt it afterwards.

    blocks: Contiguous stretches that these rows are
    repeats: All motion of the recording repeats other motion of it: figures flatter, except at the edge
    edge_rows: Rows at the edge of the data: their states are the furthest from all others
    edge_blocks: Contiguous stretches that the rows at the edge are
    """

    rows: int
    blocks: int
    repeats: bool
    edge_rows: int = 0
    edge_blocks: int = 0


class SelectionCandidate(Record, frozen=True, kw_only=True):
    """How an estimator did on what was held out to choose by; null where it was not judged.

    log_density: Log predictive density, summed over the joints, nats a sample
    difference: Of the log density from that of the best
    standard_error: Of that difference
    nmse: Of each joint; null where its torque does not vary
    edge_nmse: Of each joint, squared error at the edge of the data over the torque's variance in all rows that were
        held out; null if none of them are at the edge, and for versions of earlier releases
    coverage: Share within the 95 % interval, of each joint
    error: Why it could not be trained
    """

    estimator: str
    log_density: float | None
    difference: float | None
    standard_error: float | None
    nmse: list[float | None] | None
    edge_nmse: list[float | None] | None = None
    coverage: list[float | None] | None
    seconds: float
    error: str | None


class Selection(Record, frozen=True, kw_only=True):
    """How `auto` has chosen the estimator.

    table: The estimators that were trained, the simplest first
    """

    asked: str
    chosen: str
    reason: str
    held_out: SelectionHeldOut
    table: list[SelectionCandidate]


class Version(Record, frozen=True, kw_only=True):
    """An immutable trained version.

    job: The job that made it; null for one that was imported or came with LIPServe
    noise_std: Standard deviation of the measured torque, N·m
    training_range: Where the samples lie that it stands on
    fit: What the fit reported
    compact: Size of the served posterior, and how far it deviates from the exact one: `mean_rms`, `mean_max`, `std_max`
        in standard deviations of the function, at `queries` motions
    calibration: `function_std_factor`: what `tau_std` was multiplied by so that intervals hold on unseen motion
    conformal: What `blocks` of the training, left out in turn, say of its intervals: `scale`, the factor on the half
        width of each joint's, and `guaranteed`, the share of measurements that they hold then, at least; null for the
        shipped model
    hyperparameters: Hyperparameters by name, mostly logarithms
    warnings: What to be careful with: what the recording leaves open of a learnt arm, and how its fit ended
    lineage: Data sets with their hashes, when and with which `software` it was trained, and how well it fits them
        (`training_metrics`); also the version of another unit that it started from (`base`), and of an imported version
        where it comes from (`imported`)
    promotion: Whether it answers by itself; null for one that was refreshed or shipped
    selection: How the estimator was chosen; null where it was named when the training was asked for
    robot: The URDF of an estimator with rigid bodies, and its prior
    parameters: `friction`; of rigid bodies also `inertia`, `rotor` and `geometry`, with standard deviations and with
        what torque does not tell (`undetermined`). `geometry.joints` run from base to tip, `geometry.order` names the
        model's joint at each place; all else is in the order of the model's joints
    """

    model: str
    version: int
    created_at: str
    job: str | None
    estimator: str
    joint_names: list[str]
    joint_types: list[Literal["revolute", "prismatic"]]
    torque_convention: Literal["gravity_included", "gravity_compensated"]
    noise_std: list[float]
    training_range: dict[str, dict[str, list[float]]]
    options: dict[str, Any]
    fit: dict[str, Any]
    compact: dict[str, Any]
    calibration: dict[str, Any]
    conformal: dict[str, Any] | None = None
    hyperparameters: dict[str, Any]
    warnings: list[str]
    lineage: dict[str, Any]
    promotion: Promotion | None = None
    selection: Selection | None = None
    robot: dict[str, Any] | None = None
    parameters: dict[str, Any]


class AliasMove(Record, frozen=True, kw_only=True):
    """One move of an alias.

    version: Where to; null where the alias was removed
    before: Where from; null where the alias was new
    rollback: Whether it took back an earlier move
    """

    version: int | None
    before: int | None
    at: str
    rollback: bool


class Alias(Record, frozen=True, kw_only=True):
    """A name of a version, which can be moved to another one.

    previous: Where a rollback would lead; null where there is nothing to go back to
    history: The last moves, newest first
    """

    alias: str
    version: int
    changed_at: str
    previous: int | None
    history: list[AliasMove]
