"""Choosing an estimator by what it predicts of motion that it has not seen.

The measure is the log predictive density of held-out torque, noise included, summed over the joints, per sample. The
best is chosen, unless one that knows more of the arm is within one standard error of it, or errs no more. It then
learns all samples.
"""

from __future__ import annotations

import time
from dataclasses import replace

from lipcore.auto.contest import ALL, CHAIN, FAILURES, FEW, RIGID, Contest, Overall, Work
from lipcore.auto.table import Candidate, selection, unjudged
from lipcore.auto.unseen import hold_out
from lipcore.compact.compress import compressed
from lipcore.fit_options import FitOptions
from lipcore.fitting import Cancelled, FitProgress, Progress
from lipcore.model import TorqueModel, independent, training_range
from lipcore.samples import Samples
from lipcore.selection import spread_out
from lipcore.splits import SplitError, taken
from lipcore.urdf import RigidBody
from lipcore.vocabulary import ROBOT_ESTIMATORS, JointType, TorqueConvention


def choose(
    samples: Samples,
    joint_types: tuple[JointType, ...],
    options: FitOptions,
    torque_convention: TorqueConvention,
    on_progress: Progress | None = None,
    cancelled: Cancelled | None = None,
    robot: RigidBody | None = None,
    stretches: Samples | None = None,
) -> TorqueModel:
    """Train the estimator that suits the samples; arguments are those of `lipcore.model.fitted`.

    Raise FitCancelledError, or what the first estimator has failed with where all have failed.
    """
    work = Work(joint_types, options, torque_convention, Overall(on_progress), cancelled, robot, stretches)
    try:
        unseen = hold_out(samples, joint_types)
    except SplitError as error:
        return _unjudged(work, samples, f"too little to hold some out and judge by: {error}")
    parts = unseen.parts
    contest = Contest(work, taken(samples, parts.train), taken(samples, parts.held_out))
    contest.run()
    chosen, reason = contest.verdict()
    model, rows = _of_all(work, samples, contest, chosen), int(parts.held_out.sum())
    return replace(
        model,
        fit={**model.fit, "seconds": work.overall.elapsed},
        selection=selection(chosen, reason, contest.table(), rows, unseen.blocks, unseen.repeats),
    )


def _of_all(work: Work, samples: Samples, contest: Contest, chosen: str) -> TorqueModel:
    """The chosen model as it is when it has learnt all samples.

    An arm is followed from where it was learnt. Of the others hyperparameters stay; basis and posterior are made anew.
    """
    model = contest.entries[chosen].model
    assert model is not None  # what is chosen was trained
    if chosen == RIGID:
        learnt = work.learn(samples, ALL, contest.learnt, search=False)
        searched = {name: value for name, value in model.fit.items() if name.startswith("search_")}
        return work.fit(samples, chosen, ALL, replace(learnt, report={**learnt.report, **searched}))
    objective = float(model.fit["objective"])
    work.overall.of(chosen, ALL)(FitProgress("posterior", 0, 0, objective, 0.0, 0.0))
    arm = contest.learnt if chosen in ROBOT_ESTIMATORS else None
    options = work.options if arm is None else independent(work.options, arm)
    used = samples.rows(spread_out(samples.motion(), options.posterior_samples).numpy())
    kernel, params = model.estimator.kernel, model.posterior.params
    compression, jitter = compressed(kernel, params, used, options, model.calibration)
    counts = {"samples_given": len(samples), "samples_posterior": len(used), "jitter": jitter}
    return replace(
        model,
        posterior=compression.posterior,
        training_range=training_range(used.motion()),
        compact=compression.report(),
        fit={**model.fit, **counts},
    )


def _unjudged(work: Work, samples: Samples, reason: str) -> TorqueModel:
    """Of few samples the first estimator that can be trained learns all."""
    table: list[Candidate] = []
    errors: list[Exception] = []
    for name in (RIGID, CHAIN):
        began = time.monotonic()
        try:
            model = work.fit(samples, name, FEW)
        except FAILURES as error:
            errors.append(error)
            table.append(unjudged(name, time.monotonic() - began, error))
            continue
        table.append(unjudged(name, time.monotonic() - began))
        return replace(model, selection=selection(name, reason, table))
    raise errors[0]
