"""Training of one named estimator: hyperparameters or the arm, then the compact posterior."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, replace

import numpy as np

from lipcore.arm.learning import ArmFit, learn
from lipcore.arm.search import known_geometries
from lipcore.data.independence import motion_dimensions, thinned_weights
from lipcore.data.samples import Samples
from lipcore.estimators.catalogue import Estimator, calibrate, check_estimator, make_estimator
from lipcore.estimators.hyperparameters import FitProgress, fit
from lipcore.estimators.options import FitOptions
from lipcore.estimators.task import Task
from lipcore.kernels.base import Params
from lipcore.kernels.geometry import Geometry
from lipcore.model.parameters import passing_friction
from lipcore.model.torque_model import TorqueModel, training_range, training_torque
from lipcore.posterior.compact import CompactPosterior
from lipcore.posterior.compression import Compression, build_linear, compress_samples
from lipcore.posterior.conformal import Conformal, fit_conformal
from lipcore.posterior.misfit import Misfit, estimate_misfit, shared_rows
from lipcore.posterior.statistics import collect
from lipcore.training.conditioning import condition_arm, should_condition
from lipcore.training.correction import Correction, correct, corrected_joints
from lipcore.vocabulary import LOCAL, RIGID, ROBOT_ESTIMATORS


def fit_estimator(
    task: Task,
    name: str,
    learnt: ArmFit | None = None,
    geometries: Sequence[Geometry] = (),
    correct: Callable[[CompactPosterior, Samples], Correction] = correct,
) -> TorqueModel:
    """Train one estimator on the samples of a task.

    name: one of `lipcore.estimators.catalogue.ESTIMATORS`; learnt: rigid bodies learnt from these samples before.
    Estimators without rigid bodies read the uncertainty of friction at rest from them; geometries: first starts of a
    search, base to tip; correct: corrects an arm, given the samples. Raise ValueError like `check_estimator`,
    FitCancelledError, or NotPositiveDefiniteError.
    """
    samples, types, options = task.samples, task.joint_types, task.options
    if task.sibling is None:
        check_estimator(name, types, task.robot, options)
    if learnt is None and name in ROBOT_ESTIMATORS:
        anything = task.robot is None and task.sibling is None
        installed = known_geometries(types, task.gravity) if anything else ()
        learnt = learn(task, (*geometries, *installed))
    misfit = None if learnt is None else learnt.misfit
    learnt = learnt if name in ROBOT_ESTIMATORS else None
    plain = RIGID if name == LOCAL else name
    estimator = make_estimator(plain, types, options.tied, None if learnt is None else learnt.arm)
    calibration = calibrate(name)
    factor = calibration.function_std_factor
    if learnt is not None and plain == RIGID:
        report = {**learnt.report, "jitter": 0.0}
        used = samples.rows(learnt.rows)
        variance = np.exp(2 * learnt.params["noise.log_std"]) / learnt.counts
        compression = build_linear(
            estimator.kernel, learnt.params, used, variance, options.compact_tolerance, factor, learnt.misfit
        )
        conformal = fit_conformal(compression.posterior, used, variance)
        if name == LOCAL:
            if task.on_progress is not None:
                task.on_progress(FitProgress("posterior", 0, 0, float(learnt.report["objective"]), 0.0, 0.0))
            arm, weights = compression.posterior, thinned_weights(samples.t)
            if should_condition(options, len(samples), float(weights.sum())):
                arm = condition_arm(arm, samples, weights)  # the correction must not learn what the arm can
            correction = correct(arm, samples)
            report |= correction.report()
            estimator = estimator.corrected(correction.residual)
            posterior = arm.corrected(estimator.kernel, correction.noise, correction.a)
            compression = replace(compression, posterior=posterior)
            if correction.conformal is not None:
                conformal = conformal.replaced(corrected_joints(report), correction.conformal)
    else:
        # the start excludes the noise: what rigid bodies leave unexplained belongs to the other term
        params = {} if learnt is None else learnt.params
        start = {key: value for key, value in params.items() if key != "noise.log_std"}
        fewer = options if learnt is None else independent_samples(options, learnt)
        fitted = fit(
            estimator.kernel,
            samples,
            fewer,
            task.on_progress,
            task.cancelled,
            task.stretches,
            start,
            options.place(name),
        )
        used = samples.rows(fitted.rows)
        compression, stands_on, conformal = compact(task, estimator, fitted.params, used, misfit)
        report = {**asdict(fitted.report), **stands_on}
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
        posterior=compression.posterior,
        training_range=training_range(used.motion()),
        training_torque=training_torque(samples.tau),
        compact=compression.report(),
        robot=task.robot,
        calibration=calibration,
        conformal=conformal,
    )


def compact(
    task: Task, estimator: Estimator, params: Params, used: Samples, rigid: Misfit | None = None
) -> tuple[Compression, dict[str, float], Conformal]:
    """Return the compact posterior of an estimator, manifest entries, and conformal factors.

    The estimator has a nonlinear term. The entries are the jitter of the exact posterior, (N·m)², and the number of
    effective samples. used: samples of the task's recordings; rigid: misfit of the arm that was learnt from them. A
    torque has the variance of `Misfit.of_row`, estimated from contiguous samples. Its variance of
    friction at rest is that of the arm if that is larger: a nonlinear term fits its few samples there too closely.
    Raise NotPositiveDefiniteError if the exact posterior cannot be computed.
    """
    options, factor = task.options, calibrate(estimator.name).function_std_factor
    compression, jitter = compress_samples(
        estimator.kernel, params, used, options.compact_tolerance, options.max_inducing_outputs, factor
    )
    posterior = compression.posterior
    contiguous = task.contiguous(4000)
    residual = contiguous.tau - posterior.mean(contiguous.motion())
    noise = posterior.noise_variance
    moved = np.stack([contiguous.dq, contiguous.ddq])
    misfit, _ = estimate_misfit(residual, contiguous.tau, moved, contiguous.episodes(), noise)
    if rigid is not None and estimator.name in ROBOT_ESTIMATORS:
        misfit = replace(misfit, elements=rigid.elements)
    misfit = misfit.with_friction(passing_friction(posterior, estimator))
    misfit = misfit if rigid is None else misfit.with_rest(rigid)
    motion = used.motion()
    variance = misfit.of_row(noise, motion, shared_rows(task.samples, task.joint_types, len(used)))
    statistics = collect(posterior.basis, variance, motion, used.tau - estimator.kernel.mean(motion))
    counted = CompactPosterior.build(estimator.kernel, posterior.basis, statistics, noise, factor, misfit)
    independent = float((noise / variance).mean(axis=1).sum())
    stands_on = {"jitter": jitter, "independent_samples": independent}
    return replace(compression, posterior=counted), stands_on, fit_conformal(counted, used, variance)


def independent_samples(options: FitOptions, learnt: ArmFit) -> FitOptions:
    """Return options that limit the samples for hyperparameters to the recording's effective samples."""
    most = max(50, round(float(learnt.counts.mean(axis=1).sum())))
    return replace(
        options,
        hyperparameter_samples=min(options.hyperparameter_samples, most),
    )
