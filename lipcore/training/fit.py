"""Training one named estimator: hyperparameters or the arm, then the compact posterior."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace

import torch

from lipcore.arm.learning import Learnt, learn
from lipcore.arm.search import known_geometries
from lipcore.data.independence import motion_dimensions
from lipcore.fitting.estimators import calibrate, check_estimator, make_estimator
from lipcore.fitting.hyperparameters import fit
from lipcore.fitting.options import FitOptions
from lipcore.fitting.task import MIN_SAMPLES, Task
from lipcore.kernels.geometry import Geometry
from lipcore.model.torque_model import TorqueModel, training_range
from lipcore.posterior.compression import compressed, linear
from lipcore.vocabulary import ROBOT_ESTIMATORS


def fit_estimator(
    task: Task, name: str, learnt: Learnt | None = None, geometries: Sequence[Geometry] = ()
) -> TorqueModel:
    """Train one estimator on the samples of a task.

    name: one of `lipcore.fitting.estimators.ESTIMATORS`; learnt: what these samples have led to of the rigid bodies,
    where that is known already; geometries: base to tip, that a search for one looks at first.
    Raise ValueError as `check_estimator` does, FitCancelledError, or NotPositiveDefiniteError.
    """
    samples, types, options = task.samples, task.joint_types, task.options
    check_estimator(name, types, task.robot, options)
    if learnt is None and name in ROBOT_ESTIMATORS:
        installed = () if task.robot is not None else known_geometries(types, task.gravity)
        learnt = learn(task, (*geometries, *installed))
    estimator = make_estimator(name, types, options.tied, None if learnt is None else learnt.arm)
    calibration = calibrate(name)
    if learnt is not None and name == "rigid-body":
        report = {**learnt.report, "jitter": 0.0}
        used = samples.rows(learnt.rows)
        weights = torch.full((len(used),), learnt.weight, dtype=torch.float64)
        compression = linear(
            estimator.kernel, learnt.params, used.motion(), used.torque(), weights, options.compact_tolerance
        )
    else:
        # not the noise: what rigid bodies leave of the torque is what the other term is there for
        params = {} if learnt is None else learnt.params
        start = {key: value for key, value in params.items() if key != "noise.log_std"}
        fewer = options if learnt is None else independent_samples(options, learnt)
        fitted = fit(estimator.kernel, samples, fewer, task.on_progress, task.cancelled, task.stretches, start)
        used = samples.rows(fitted.rows)
        compression, jitter = compressed(
            estimator.kernel,
            fitted.params,
            used,
            options.compact_tolerance,
            options.max_inducing_outputs,
            calibration.function_std_factor,
        )
        report = {**asdict(fitted.report), "jitter": jitter}
        if learnt is not None:
            seconds = float(learnt.report["seconds"]) + fitted.report.seconds
            report = {**learnt.report, **report, "seconds": seconds}
    return TorqueModel(
        estimator=estimator,
        joint_names=samples.joint_names,
        joint_types=types,
        torque_convention=task.torque_convention,
        options=asdict(options),
        fit={**report, "motion_dimensions": motion_dimensions(samples.dq)},
        posterior=replace(compression.posterior, std_factor=calibration.function_std_factor),
        training_range=training_range(used.motion()),
        compact=compression.report(),
        robot=task.robot,
        calibration=calibration,
    )


def independent_samples(options: FitOptions, learnt: Learnt) -> FitOptions:
    """Options for no more samples than the recording holds independent ones, as the arm's residuals say."""
    most = max(MIN_SAMPLES, round(learnt.weight * len(learnt.rows)))
    return replace(
        options,
        hyperparameter_samples=min(options.hyperparameter_samples, most),
        posterior_samples=min(options.posterior_samples, most),
    )
