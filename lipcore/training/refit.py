"""The last fit: a model whose quality was judged on rows that it had not learnt learns these rows, too."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

from lipcore.arm.learning import learn
from lipcore.data.independence import motion_dimensions
from lipcore.data.samples import Samples
from lipcore.estimators.hyperparameters import FitCancelledError, FitProgress
from lipcore.estimators.task import Task
from lipcore.model.selection import Selection, shortened
from lipcore.model.torque_model import TorqueModel, training_range, training_torque
from lipcore.posterior.selection import spread_out
from lipcore.training.correction import corrected_joints
from lipcore.training.fit import compact, fit_estimator
from lipcore.vocabulary import LOCAL, RIGID

WIDENED = "widened_"
"""Prefix of entries of a fit's report, one a joint: factor on its intervals that held-out rows have proved."""


def widened(model: TorqueModel, samples: Samples) -> TorqueModel:
    """Return the model with intervals widened until they hold 95 % of the torques of samples that it has not learnt."""
    factors = model.predict(samples.q, samples.dq, samples.ddq).interval.shortfall(samples.tau)
    known = {joint: float(model.fit.get(f"{WIDENED}{joint + 1}", 1.0)) * each for joint, each in enumerate(factors)}
    report = {f"{WIDENED}{joint + 1}": round(each, 3) for joint, each in known.items() if each > 1}
    return _wider(replace(model, fit={**model.fit, **report}), factors.tolist())


def _wider(model: TorqueModel, factors: Sequence[float]) -> TorqueModel:
    return model if model.conformal is None else replace(model, conformal=model.conformal.widened(factors))


def refit(model: TorqueModel, task: Task) -> TorqueModel:
    """Return the model trained on the samples of a task, from where its own training ended.

    An arm follows the geometries of the model without a search; what is corrected beside it stays so. If `auto` has
    chosen an arm alone, it is corrected where only all rows tell that motion repeats. The other estimators keep their
    arm and hyperparameters; their basis and posterior are made anew. `selection`, the report of the search and
    the factors of `widened` are kept.

    task: of the model's robot, with its joints, torque convention and options.
    Raise FitCancelledError, ValueError as `learn` does, or NotPositiveDefiniteError.
    """
    began, name = time.monotonic(), model.estimator.name
    if name in (RIGID, LOCAL):
        assert model.arm is not None  # it is what the estimator is made of
        learnt = learn(task, begin=model.arm.geometries)
        searched = {key: value for key, value in model.fit.items() if key.startswith("search_")}
        learnt = replace(learnt, report={**learnt.report, **searched})
        again = fit_estimator(task, name, learnt, corrected=corrected_joints(model.fit))
        again = replace(again, selection=model.selection)
        if name == RIGID and model.selection is not None:
            again = _corrected(again, model.selection, fit_estimator(task, LOCAL, learnt))
    else:
        again = _with_posterior_of(model, task)
    kept = {key: value for key, value in model.fit.items() if key.startswith(WIDENED)}
    kept["seconds"] = float(model.fit["seconds"]) + time.monotonic() - began
    again = replace(again, fit={**again.fit, **kept})
    return _wider(again, [float(kept.get(f"{WIDENED}{joint + 1}", 1.0)) for joint in range(model.n_joints)])


def _corrected(arm: TorqueModel, before: Selection, local: TorqueModel) -> TorqueModel:
    """Return an arm that `auto` has chosen before, or its corrected twin if all rows show that a correction gains."""
    if not corrected_joints(local.fit):
        return arm
    reason = shortened(f"{LOCAL} replaces {RIGID}: of all rows it gains; before: {before['reason']}")
    return replace(local, selection={**before, "chosen": LOCAL, "reason": reason})


def _with_posterior_of(model: TorqueModel, task: Task) -> TorqueModel:
    """The model with a basis and a posterior of the samples of a task."""
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
