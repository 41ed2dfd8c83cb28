"""The last fit: a model that was evaluated on held-out rows learns these rows too."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from lipcore.arm.learning import ArmFit, learn
from lipcore.data.independence import motion_dimensions
from lipcore.data.samples import Samples
from lipcore.estimators.hyperparameters import FitCancelledError, FitProgress
from lipcore.estimators.task import Task
from lipcore.model.selection import Selection, shortened
from lipcore.model.torque_model import TorqueModel, training_range, training_torque
from lipcore.posterior.misfit import shared_rows
from lipcore.posterior.selection import spread_out
from lipcore.training.correction import correct, corrected_joints, relearn_correction
from lipcore.training.fit import compact, fit_estimator
from lipcore.vocabulary import LOCAL, RIGID

WIDENED_PREFIX = "widened_"
"""Prefix of entries of a fit's report, one for each joint: factor on its intervals from held-out rows."""


def widen_intervals(model: TorqueModel, samples: Samples) -> TorqueModel:
    """Return the model with intervals widened to a coverage of 95 % of the torques of held-out samples."""
    factors = model.predict_along(samples).interval.width_factor(samples.tau)
    known = {
        joint: float(model.fit.get(f"{WIDENED_PREFIX}{joint + 1}", 1.0)) * each for joint, each in enumerate(factors)
    }
    report = {f"{WIDENED_PREFIX}{joint + 1}": round(each, 3) for joint, each in known.items() if each > 1}
    return _widen(replace(model, fit={**model.fit, **report}), factors.tolist())


def _widen(model: TorqueModel, factors: Sequence[float]) -> TorqueModel:
    return model if model.conformal is None else replace(model, conformal=model.conformal.widened(factors))


def refit(model: TorqueModel, task: Task) -> TorqueModel:
    """Return the model trained on the samples of a task, starting from the result of its own training.

    An arm starts at the geometries of the model, without a search. Its correction is kept. If `auto` chose an arm
    alone, it is corrected if only all rows together show that motion repeats. The other estimators keep their arm and
    hyperparameters, and their basis and posterior are computed again. `selection`, the report of the search and the
    factors of `widen_intervals` are kept.

    task: of the model's robot, with its joints, torque convention and options. Raise FitCancelledError, ValueError like
    `learn`, or NotPositiveDefiniteError.
    """
    began, name = time.monotonic(), model.estimator.name
    if name in (RIGID, LOCAL):
        assert model.arm is not None  # these estimators have an arm
        learnt = learn(task, begin=model.arm.geometries)
        searched = {key: value for key, value in model.fit.items() if key.startswith("search_")}
        learnt = replace(learnt, report={**learnt.report, **searched})
        again = fit_estimator(task, name, learnt, correct=partial(correct, before=model.posterior.basis.residual))
        again = replace(again, selection=model.selection)
        if name == RIGID and model.selection is not None:
            again = _choose_corrected(again, model.selection, fit_estimator(task, LOCAL, learnt))
    else:
        again = _with_posterior_of(model, task)
    kept = {key: value for key, value in model.fit.items() if key.startswith(WIDENED_PREFIX)}
    kept["seconds"] = float(model.fit["seconds"]) + time.monotonic() - began
    again = replace(again, fit={**again.fit, **kept})
    return _widen(again, [float(kept.get(f"{WIDENED_PREFIX}{joint + 1}", 1.0)) for joint in range(model.n_joints)])


def relearn(model: TorqueModel, task: Task) -> TorqueModel:
    """Return the model with weights learnt from the samples of a task; geometry, drive and hyperparameters stay.

    The centres of a correction stay, too, and its errors are not estimated. It takes less time than `refit`. Raise like
    `refit`.
    """
    name, before, samples = model.estimator.name, model.posterior, task.samples
    if name not in (RIGID, LOCAL):
        return _with_posterior_of(model, task)
    assert model.arm is not None  # these estimators have an arm
    rows = spread_out(samples.motion(), task.options.posterior_samples)
    shared = shared_rows(samples, task.joint_types, len(rows))
    variance = before.misfit.of_row(before.noise_variance, samples.rows(rows).motion(), shared)
    report = {"objective": model.fit["objective"]}
    learnt = ArmFit(model.arm, dict(before.params), rows, before.noise_variance / variance, before.misfit, report)
    if (residual := before.basis.residual) is None:
        return fit_estimator(task, name, learnt)
    again = partial(relearn_correction, before=residual, noise=before.noise_variance)
    return fit_estimator(task, name, learnt, correct=again)


def _choose_corrected(arm: TorqueModel, before: Selection, local: TorqueModel) -> TorqueModel:
    """Return an arm that `auto` chose before, or the corrected one if all rows show a gain."""
    if not corrected_joints(local.fit):
        return arm
    reason = shortened(f"{LOCAL} replaces {RIGID}: it is better on all rows; before: {before['reason']}")
    return replace(local, selection={**before, "chosen": LOCAL, "reason": reason})


def _with_posterior_of(model: TorqueModel, task: Task) -> TorqueModel:
    """Return the model with a new basis and posterior, from the samples of a task."""
    if task.cancelled is not None and task.cancelled():
        raise FitCancelledError("the fit was cancelled")
    if task.on_progress is not None:
        task.on_progress(FitProgress("posterior", 0, 0, float(model.fit["objective"]), 0.0, 0.0))
    rows, before = spread_out(task.samples.motion(), task.options.posterior_samples), model.posterior
    used = task.samples.rows(rows)
    compression, stands_on, conformal = compact(task, model.estimator, before.params, used, before.misfit)
    counts = {
        "samples_given": len(task.samples),
        "samples_posterior": len(used),
        "motion_dimensions": motion_dimensions(task.samples.dq),
    }
    return replace(
        model,
        posterior=compression.posterior,
        training_range=training_range(used.motion()),
        training_torque=training_torque(task.samples.tau),
        compact=compression.report(),
        fit={**model.fit, **counts, **stands_on},
        conformal=conformal,
    )
