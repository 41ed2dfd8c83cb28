"""A trained torque model: train it, ask it, save it, load it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from lipcore.arm.known import known_geometries
from lipcore.arm.learning import Learnt, learn
from lipcore.arm.recording import motion_dimensions
from lipcore.calibration import NO_CALIBRATION, Calibration, calibrate
from lipcore.compact.basis import Basis
from lipcore.compact.compress import compressed, linear
from lipcore.compact.posterior import CompactPosterior
from lipcore.compact.statistics import Statistics
from lipcore.estimators import Estimator, check_estimator, make_estimator
from lipcore.evaluator import Evaluator
from lipcore.fit_options import FitOptions
from lipcore.fitting import Cancelled, Progress, fit
from lipcore.kernels.arm import ArmKernel
from lipcore.kernels.arm_prior import Arm
from lipcore.kernels.geometry import Geometry
from lipcore.motion import Motion, check_finite, check_joint_types, motion_arrays
from lipcore.samples import Array, Samples
from lipcore.urdf import JointMismatchError, RigidBody
from lipcore.vocabulary import (
    AUTO,
    DEFAULT_ESTIMATOR,
    ROBOT_ESTIMATORS,
    TORQUE_CONVENTIONS,
    JointType,
    TorqueConvention,
)

if TYPE_CHECKING:
    from lipcore.auto.table import Selection

MIN_SAMPLES = 10


@dataclass(frozen=True)
class TorquePrediction:
    """Answer for N queries of n joints, N·m.

    tau: (N, n) mean; tau_std: (N, n) standard deviation of the function; noise_std: (n,) of the measurement; an
    interval for measurements needs both. covariance: (N, n, n) of the function between joints, where asked for.
    """

    tau: Array
    tau_std: Array
    noise_std: Array
    covariance: Array | None = None


TrainingRange = dict[str, dict[str, list[float]]]
"""Smallest (`min`) and largest (`max`) q, dq and ddq of the samples behind a posterior, per joint."""


@dataclass(frozen=True)
class TorqueModel:
    """Fitted inverse dynamics of one robot: immutable, safe to share between threads.

    fit: what the fit reported, compact: how near the compact posterior comes to the exact one, both for the manifest;
    robot: the rigid bodies of an estimator that has them; calibration: how the posterior's deviations are corrected;
    selection: how `auto` has chosen the estimator, None where it was named.
    """

    estimator: Estimator
    joint_names: tuple[str, ...]
    joint_types: tuple[JointType, ...]
    torque_convention: TorqueConvention
    options: dict[str, int | float | bool | str]
    fit: dict[str, float | int | bool | str]
    posterior: CompactPosterior
    training_range: TrainingRange
    compact: dict[str, float | int | bool]
    robot: RigidBody | None = None
    calibration: Calibration = NO_CALIBRATION
    selection: Selection | None = None

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return len(self.joint_names)

    @property
    def arm(self) -> Arm | None:
        """What is known of the rigid bodies, of an estimator that has them."""
        term = self.estimator.terms.get("rigid_body")
        return term.arm if isinstance(term, ArmKernel) else None

    @property
    def noise_std(self) -> Array:
        """Standard deviation of the measured torque around the function, (n,) N·m, jitter included."""
        std: Array = self.posterior.noise_variance.sqrt().numpy()
        return std

    def predict(self, q: ArrayLike, dq: ArrayLike, ddq: ArrayLike, covariance: bool = False) -> TorquePrediction:
        """Torque with uncertainty for arrays of shape (n,) or (N, n).

        Raise ValueError for a wrong number of joints, differing shapes or a value that is not finite.
        """
        query = motion_arrays(q, dq, ddq)
        joints = query[0].shape[1]
        if joints != self.n_joints:
            raise ValueError(f"q has {joints} joints, expected {self.n_joints}: {', '.join(self.joint_names)}")
        tau, std, between = self.evaluator.many(*query, covariance)
        return TorquePrediction(tau, std, self.noise_std, between)

    def answer(self, motion: Array, std: bool = True) -> tuple[Array, Array | None]:
        """Torque at one instant, and its standard deviation where asked for: both (n,) N·m. For control loops.

        motion: q, dq and ddq as a float64 array (3, n). Neither shape nor finiteness is checked; what is not finite
        ends in what is not finite.
        """
        return self.evaluator.one(motion, std)

    def warm_up(self) -> None:
        """Do all that the first answer would otherwise wait for."""
        self.evaluator.warm_up()

    @cached_property
    def evaluator(self) -> Evaluator:
        """The compiled form of the posterior, which answers queries."""
        posterior, basis = self.posterior, self.posterior.basis
        return Evaluator(
            basis.term,
            posterior.params,
            None if basis.term is None else basis.inducing,
            basis.outputs.numpy(),
            basis.linear,
            posterior.weights.numpy(),
            posterior.root.numpy(),
            posterior.std_factor,
            posterior.floor.numpy(),
        )


def train(
    samples: Samples,
    joint_types: Sequence[str],
    estimator: str = DEFAULT_ESTIMATOR,
    options: FitOptions | None = None,
    torque_convention: TorqueConvention = "gravity_included",
    on_progress: Progress | None = None,
    cancelled: Cancelled | None = None,
    robot: RigidBody | None = None,
) -> TorqueModel:
    """Train a model on samples; see `lipcore.fitting.fit` for progress and cancellation.

    estimator: one of `lipcore.estimators.ESTIMATORS`, or `auto`, which chooses (`lipcore.auto`); robot: for estimators
    of rigid bodies, built for the joints of the samples.
    Raise ValueError for bad arguments, FitCancelledError, or NotPositiveDefiniteError.
    """
    from lipcore import conditioning  # noqa: PLC0415 - it imports this module
    from lipcore.online import spacing  # noqa: PLC0415

    options = options or FitOptions()
    model = fitted(samples, joint_types, estimator, options, torque_convention, on_progress, cancelled, robot)
    weights = spacing.recorded(samples.t, samples.episode)
    weights = np.minimum(weights, 1.0 / float(model.fit.get("row_correlation", 1.0)))  # errors that last count once
    if not conditioning.wanted(options, len(samples), float(weights.sum())):
        return model
    return conditioning.condition(model, samples, weights, cancelled)


def fitted(
    samples: Samples,
    joint_types: Sequence[str],
    estimator: str = DEFAULT_ESTIMATOR,
    options: FitOptions | None = None,
    torque_convention: TorqueConvention = "gravity_included",
    on_progress: Progress | None = None,
    cancelled: Cancelled | None = None,
    robot: RigidBody | None = None,
    stretches: Samples | None = None,
    learnt: Learnt | None = None,
    geometries: Sequence[Geometry] = (),
) -> TorqueModel:
    """Train as `train` does, on the chosen samples alone: where there are too many for memory, on a thinned table.

    stretches: contiguous samples of the same recordings, which tell the white noise of signals; the samples themselves
    where None; learnt: what these samples have told of the rigid bodies, where that is known already;
    geometries: base to tip, that the search for one looks at first, as of an earlier version.
    """
    options = options or FitOptions()
    types = check_joint_types(joint_types)
    if len(types) != samples.n_joints:
        raise ValueError(f"joint_types has {len(types)} entries, expected {samples.n_joints}, one a joint")
    if torque_convention not in TORQUE_CONVENTIONS:
        raise ValueError(f"torque_convention is {torque_convention!r}, expected one of {', '.join(TORQUE_CONVENTIONS)}")
    if len(samples) < MIN_SAMPLES:
        raise ValueError(f"samples has {len(samples)} rows, expected at least {MIN_SAMPLES}")
    check_finite("tau", samples.tau)
    if robot is not None and robot.joint_names != samples.joint_names:
        raise JointMismatchError(
            f"robot {robot.name!r} was built for the joints {', '.join(robot.joint_names)}; the data have "
            f"{', '.join(samples.joint_names)}"
        )
    gravity = torque_convention == "gravity_included"
    check_estimator(estimator, types, robot, options)
    if estimator == AUTO:
        from lipcore.auto.choosing import choose  # noqa: PLC0415 - it imports this module

        return choose(samples, types, options, torque_convention, on_progress, cancelled, robot, stretches)
    if learnt is None and estimator in ROBOT_ESTIMATORS:
        arms = (*geometries, *(() if robot is not None else known_geometries(types, gravity)))
        learnt = learn(samples, types, options, gravity, robot, arms, on_progress, cancelled, stretches)
    chosen = make_estimator(estimator, types, options.tied, None if learnt is None else learnt.arm)
    calibration = calibrate(estimator)
    if learnt is not None and estimator == "rigid-body":
        rows, report = learnt.rows, {**learnt.report, "jitter": 0.0}
        used = samples.rows(rows)
        weights = torch.full((len(rows),), learnt.weight, dtype=torch.float64)
        compression = linear(
            chosen.kernel, learnt.params, used.motion(), used.torque(), weights, options.compact_tolerance
        )
    else:
        # not the noise: what rigid bodies leave of the torque is what the other term is there for
        params = {} if learnt is None else learnt.params
        start = {name: value for name, value in params.items() if name != "noise.log_std"}
        fewer = options if learnt is None else independent(options, learnt)
        found = fit(chosen.kernel, samples, fewer, on_progress, cancelled, stretches, start)
        used = samples.rows(found.rows)
        compression, jitter = compressed(chosen.kernel, found.params, used, options, calibration)
        report = {**asdict(found.report), "jitter": jitter}
        if learnt is not None:
            seconds = float(learnt.report["seconds"]) + found.report.seconds
            report = {**learnt.report, **report, "seconds": seconds}
    return TorqueModel(
        chosen,
        samples.joint_names,
        types,
        torque_convention,
        asdict(options),
        {**report, "motion_dimensions": motion_dimensions(samples.dq)},
        replace(compression.posterior, std_factor=calibration.function_std_factor),
        training_range(used.motion()),
        compression.report(),
        robot,
        calibration,
    )


def independent(options: FitOptions, learnt: Learnt) -> FitOptions:
    """Options for no more samples than the recording holds independent ones, as the arm's residuals say."""
    most = max(MIN_SAMPLES, round(learnt.weight * len(learnt.rows)))
    return replace(
        options,
        hyperparameter_samples=min(options.hyperparameter_samples, most),
        posterior_samples=min(options.posterior_samples, most),
    )


def training_range(motion: Motion) -> TrainingRange:
    """Smallest and largest q, dq and ddq of N samples."""
    return {
        name: {"min": values.min(0).values.tolist(), "max": values.max(0).values.tolist()}
        for name, values in (("q", motion.q), ("dq", motion.dq), ("ddq", motion.ddq))
    }


def restore(
    estimator: str,
    joint_names: Sequence[str],
    joint_types: Sequence[str],
    torque_convention: TorqueConvention,
    options: dict[str, int | float | bool | str],
    fit_report: dict[str, float | int | bool | str],
    params: dict[str, Tensor],
    inducing: Motion,
    outputs: Tensor,
    statistics: Statistics,
    training_range: TrainingRange,
    compact: dict[str, float | int | bool],
    robot: RigidBody | None = None,
    calibration: Calibration = NO_CALIBRATION,
    arm: Arm | None = None,
    selection: Selection | None = None,
) -> TorqueModel:
    """Rebuild a model from its parts: hyperparameters, inducing outputs (see `Basis`) and statistics.

    Raise ValueError naming what is missing, unknown or of the wrong shape.
    """
    chosen = make_estimator(estimator, joint_types, bool(options.get("tied", True)), arm)
    kernel, n = chosen.kernel, len(joint_names)
    expected = {**kernel.shapes(), "noise.log_std": torch.Size([n])}
    for name in expected.keys() | params.keys():
        found = tuple(params[name].shape) if name in params else None
        wanted = tuple(expected[name]) if name in expected else None
        if found != wanted:
            raise ValueError(f"hyperparameter {name!r} has shape {found}, expected {wanted}")
    basis = Basis.build(kernel, params, inducing, outputs)
    size = len(basis)
    if statistics.a.shape != (size, size) or statistics.b.shape != (size,):
        raise ValueError(
            f"statistics have shapes {tuple(statistics.a.shape)} and {tuple(statistics.b.shape)}, "
            f"expected {(size, size)} and {(size,)}"
        )
    noise = torch.exp(2 * params["noise.log_std"]) + float(fit_report.get("jitter", 0.0))
    posterior = CompactPosterior.build(kernel, basis, statistics, noise, calibration.function_std_factor)
    return TorqueModel(
        chosen,
        tuple(joint_names),
        check_joint_types(joint_types),
        torque_convention,
        options,
        fit_report,
        posterior,
        training_range,
        compact,
        robot,
        calibration,
        selection,
    )
