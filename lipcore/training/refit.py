"""The last fit: a model whose quality was judged on rows that it had not learnt learns these rows, too."""

from __future__ import annotations

import time
from dataclasses import replace

from lipcore.arm.learning import learn
from lipcore.data.independence import motion_dimensions
from lipcore.fitting.hyperparameters import FitCancelledError, FitProgress
from lipcore.fitting.task import Task
from lipcore.model.torque_model import TorqueModel, training_range
from lipcore.posterior.selection import spread_out
from lipcore.training.fit import compact, fit_estimator


def refit(model: TorqueModel, task: Task) -> TorqueModel:
    """Return the model trained on the samples of a task, from where its own training ended.

    `rigid-body` follows the geometries of the model without a search. The other estimators keep their arm and
    hyperparameters; their basis and posterior are made anew. `selection` and the report of the search are kept.

    task: of the model's robot, with its joints, torque convention and options.
    Raise FitCancelledError, ValueError as `learn` does, or NotPositiveDefiniteError.
    """
    began, name = time.monotonic(), model.estimator.name
    if name == "rigid-body":
        assert model.arm is not None  # it is what the estimator is made of
        learnt = learn(task, begin=model.arm.geometries)
        searched = {key: value for key, value in model.fit.items() if key.startswith("search_")}
        again = fit_estimator(task, name, replace(learnt, report={**learnt.report, **searched}))
        again = replace(again, selection=model.selection)
    else:
        again = _with_posterior_of(model, task)
    seconds = float(model.fit["seconds"]) + time.monotonic() - began
    return replace(again, fit={**again.fit, "seconds": seconds})


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
        compact=compression.report(),
        fit={**model.fit, **counts, **stands_on},
        conformal=conformal,
    )
