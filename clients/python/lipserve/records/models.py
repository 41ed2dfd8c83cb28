"""Models, their versions and aliases. Written by `python clients/python/records.py`."""

from __future__ import annotations

from typing import Any, Literal

from msgspec import field

from lipserve.records import Record
from lipserve.records.verdicts import Thresholds, Verdict


class Promotion(Record, frozen=True, kw_only=True):
    """Whether a new version became the serving version, and why.

    answers: Whether it started to serve after training; else it got the alias `candidate`
    serving: Serving version until then; null if there was none
    """

    answers: bool
    serving: int | None
    reason: str


class VersionSummary(Record, frozen=True, kw_only=True):
    """A version in the list of its model.

    note: Note on the version, as set by a user
    tags: Tags of the version, as set by a user
    promotion: Whether it became the serving version, and why; null for a refreshed or shipped version
    """

    version: int
    created_at: str
    note: str | None = None
    tags: list[str] = field(default_factory=list)
    estimator: str
    verdict: Verdict
    promotion: Promotion | None = None


class Model(Record, frozen=True, kw_only=True):
    """A named model. Queries go to its serving version unless they name another one.

    latest_version: Newest version
    serving_version: Version that serves queries without a version; null if all versions are candidates
    aliases: Versions by alias, without `serving`
    thresholds: Thresholds of the verdicts
    """

    name: str
    created_at: str
    latest_version: int
    serving_version: int | None
    aliases: dict[str, int]
    thresholds: Thresholds
    versions: list[VersionSummary]


class SelectionHeldOut(Record, frozen=True, kw_only=True):
    """Part that `auto` held out for the choice; the chosen estimator was then trained on it too.

    blocks: Number of contiguous ranges of these rows
    repeats: Whether all motion of the recording repeats itself, so that figures are too good, except at the edge
    edge_rows: Rows at the edge of the data: their states are furthest from all others
    edge_blocks: Number of contiguous ranges of the rows at the edge
    """

    rows: int
    blocks: int
    repeats: bool
    edge_rows: int = 0
    edge_blocks: int = 0


class SelectionCandidate(Record, frozen=True, kw_only=True):
    """Quality of an estimator on the part held out for the choice; null if it was not evaluated.

    log_density: Log predictive density, summed over the joints, nats a sample
    difference: Log density less that of the best estimator
    standard_error: Standard error of the difference
    nmse: nMSE per joint; null if its torque is constant
    edge_nmse: Per joint, mean squared error at the edge of the data / variance of the torque in all held-out rows; null
        without rows at the edge, and for versions of earlier releases
    coverage: Coverage of the 95 % interval per joint
    error: Why it could not be trained; null if it was
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
    """Choice of the estimator by `auto`.

    table: Trained estimators, simplest first
    """

    asked: str
    chosen: str
    reason: str
    held_out: SelectionHeldOut
    table: list[SelectionCandidate]


class Version(Record, frozen=True, kw_only=True):
    """An immutable, trained version.

    job: Job that trained it; null for an imported or shipped version
    note: Note on the version, as set by a user
    tags: Tags of the version, as set by a user
    components: Components of the torque that it offers
    noise_std: Standard deviation of the measured torque, N·m
    training_range: Range of the training samples by quantity and joint
    fit: Report of the fit
    compact: Size of the served posterior and its deviation from the exact one at `queries` motions: `mean_rms`,
        `mean_max` and `std_max`, in standard deviations of the function
    calibration: `function_std_factor`: factor on `tau_std` that calibrates intervals on unseen motion
    conformal: Calibration of intervals on `blocks` of the training data, held out in turn: `scale`, the factor on the
        half width per joint, and `guaranteed`, the min share of measurements inside; null for the shipped model
    hyperparameters: Hyperparameters by name, mostly logarithms
    warnings: Limits of the version, such as unidentifiable parameters of a learnt arm or a fit that did not converge
    lineage: Data sets with their hashes, time and `software` of the training, and `training_metrics`; also the version
        it started from (`base`) and the origin of an imported version (`imported`)
    promotion: Whether it became the serving version; null for a refreshed or shipped version
    selection: Choice of the estimator; null if the request named it
    robot: URDF and prior of an estimator with rigid bodies
    parameters: `friction`; for rigid bodies also `inertia`, `rotor` and `geometry`, with standard deviations and
        unidentifiable parameters (`undetermined`). `geometry.joints` run from base to tip, and `geometry.order` has the
        model's joint at each place. All else is in the order of the model's joints
    """

    model: str
    version: int
    created_at: str
    job: str | None
    note: str | None = None
    tags: list[str] = field(default_factory=list)
    estimator: str
    components: list[
        Literal[
            "inertia_matrix",
            "coriolis",
            "gravity",
            "inertial",
            "friction",
            "without_gravity",
            "kinetic_energy",
            "potential_energy",
            "forward_dynamics",
        ]
    ]
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
    verdict: Verdict
    promotion: Promotion | None = None
    selection: Selection | None = None
    robot: dict[str, Any] | None = None
    parameters: dict[str, Any]


class AliasMove(Record, frozen=True, kw_only=True):
    """One move of an alias.

    version: New target; null if the alias was removed
    before: Old target; null if the alias was new
    rollback: Whether it undid an earlier move
    """

    version: int | None
    before: int | None
    at: str
    rollback: bool


class Alias(Record, frozen=True, kw_only=True):
    """A movable name of a version.

    previous: Version after a rollback; null if no rollback is possible
    history: Latest moves, newest first
    """

    alias: str
    version: int
    changed_at: str
    previous: int | None
    history: list[AliasMove]
