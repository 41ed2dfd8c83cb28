"""The estimator `auto`: several are trained, and the one is taken that predicts best what it has not seen.

The measure is the log predictive density of held-out torque, noise included, summed over the joints, per sample. The
best is chosen, unless one that knows more of the arm is within one standard error of it, or errs no more. It then
learns all samples.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from lipcore.arm.learning import Learnt, learn
from lipcore.arm.posing import mode_of
from lipcore.arm.search import known_geometries
from lipcore.data.metrics import Answer, compare, evaluate
from lipcore.data.samples import Samples
from lipcore.data.splits import SplitError, taken
from lipcore.fitting.hyperparameters import FitCancelledError, FitProgress, Progress
from lipcore.fitting.task import Task
from lipcore.model.selection import Candidate, plain, selection, unjudged
from lipcore.model.torque_model import TorqueModel, training_range, training_torque
from lipcore.posterior.selection import spread_out
from lipcore.training.fit import compact, fit_estimator
from lipcore.training.held_out import hold_out
from lipcore.vocabulary import ROBOT_ESTIMATORS

RIGID, CHAIN, BOTH = "rigid-body", "lip-chain", "rigid-body+lip-chain"
MOST_PHYSICS_FIRST = (RIGID, BOTH, CHAIN)
"""Where two do as well, the earlier one is taken: what knows the arm errs less where nothing was measured."""
AGAIN, ALL, FEW = "again", "all", "few"
PLACES = {RIGID: (0, 0.25), BOTH: (0.25, 0.55), CHAIN: (0.55, 0.92), AGAIN: (0.92, 0.97), ALL: (0.97, 1), FEW: (0, 1)}
"""Which share of all the work each fit is, from and to."""
JUDGED = 2000
"""Held-out samples at most that are predicted."""
FAILURES = (ArithmeticError, ValueError)
"""What an estimator may fail with on samples that do not suit it."""


def choose(task: Task) -> TorqueModel:
    """Train the estimator that suits the samples of a task.

    Raise FitCancelledError, or what the first estimator has failed with where all have failed.
    """
    work = Fits(task, Overall(task.on_progress))
    try:
        unseen = hold_out(task.samples, task.joint_types)
    except SplitError as error:
        return _unjudged(work, f"too little to hold some out and judge by: {error}")
    parts = unseen.parts
    contest = Contest(work, taken(task.samples, parts.train), taken(task.samples, parts.held_out))
    contest.run()
    chosen, reason = contest.verdict()
    model, rows = _of_all(work, contest, chosen), int(parts.held_out.sum())
    return replace(
        model,
        fit={**model.fit, "seconds": work.overall.elapsed},
        selection=selection(chosen, reason, contest.table(), rows, unseen.blocks, unseen.repeats),
    )


def _of_all(work: Fits, contest: Contest, chosen: str) -> TorqueModel:
    """The chosen model as it is when it has learnt all samples.

    An arm is followed from where it was learnt. Of the others hyperparameters stay; basis and posterior are made anew.
    """
    model, task = contest.entries[chosen].model, work.task
    assert model is not None  # what is chosen was trained
    if chosen == RIGID:
        learnt = work.learn(task.samples, ALL, contest.learnt, search=False)
        searched = {name: value for name, value in model.fit.items() if name.startswith("search_")}
        return work.fit(task.samples, chosen, ALL, replace(learnt, report={**learnt.report, **searched}))
    objective = float(model.fit["objective"])
    work.overall.of(chosen, ALL)(FitProgress("posterior", 0, 0, objective, 0.0, 0.0))
    used = task.samples.rows(spread_out(task.samples.motion(), task.options.posterior_samples))
    rigid = None if contest.learnt is None else contest.learnt.misfit
    compression, stands_on, conformal = compact(task, model.estimator, model.posterior.params, used, rigid)
    counts = {"samples_given": len(task.samples), "samples_posterior": len(used), **stands_on}
    return replace(
        model,
        posterior=compression.posterior,
        training_range=training_range(used.motion()),
        training_torque=training_torque(task.samples.tau),
        compact=compression.report(),
        fit={**model.fit, **counts},
        conformal=conformal,
    )


def _unjudged(work: Fits, reason: str) -> TorqueModel:
    """Of few samples the simplest estimator that can be trained learns all."""
    table: list[Candidate] = []
    errors: list[Exception] = []
    for name in (RIGID, CHAIN):
        began = time.monotonic()
        try:
            model = work.fit(work.task.samples, name, FEW)
        except FAILURES as error:
            errors.append(error)
            table.append(unjudged(name, time.monotonic() - began, error))
            continue
        table.append(unjudged(name, time.monotonic() - began))
        return replace(model, selection=selection(name, reason, table))
    raise errors[0]


class Overall:
    """The progress of all fits as one: its fraction never falls."""

    def __init__(self, on_progress: Progress | None) -> None:
        self.on_progress, self.began, self.highest = on_progress, time.monotonic(), 0.0

    @property
    def elapsed(self) -> float:
        """Seconds since the first fit began."""
        return time.monotonic() - self.began

    def of(self, estimator: str, place: str) -> Progress:
        """What the fit of an estimator reports to; place: one of PLACES."""
        low, high = PLACES[place]

        def report(at: FitProgress) -> None:
            self.highest = max(self.highest, low + (high - low) * at.fraction)
            if self.on_progress is not None:
                self.on_progress(replace(at, fraction=self.highest, elapsed=self.elapsed, estimator=estimator))

        return report


@dataclass(frozen=True)
class Fits:
    """What all fits share: what the training is given, and its progress."""

    task: Task
    overall: Overall

    def learn(self, samples: Samples, place: str, before: Learnt | None = None, search: bool = True) -> Learnt:
        """The arm of some samples. place: one of PLACES; before: what other samples have led to, where a search begins,
        too, or, without `search`, what replaces one."""
        task = replace(self.task.on(samples), on_progress=self.overall.of(RIGID, place))
        shapes = () if before is None else before.arm.geometries
        if before is None and task.robot is None and task.sibling is None:
            shapes = known_geometries(task.joint_types, task.gravity)
        known, begin, seed = (shapes, (), int(before is not None)) if search else ((), shapes, 0)
        return learn(task, known, begin, seed)

    def fit(self, samples: Samples, name: str, place: str, learnt: Learnt | None = None) -> TorqueModel:
        """A model of one estimator, which makes of an arm that is learnt already what `fit_estimator` says.

        samples: of the task's recordings; name: of the estimator; place: one of PLACES.
        """
        task = replace(self.task, samples=samples, on_progress=self.overall.of(name, place))
        if name not in ROBOT_ESTIMATORS:
            task = replace(task, robot=None, sibling=None)
        return fit_estimator(task, name, learnt)


@dataclass(frozen=True)
class Contestant:
    """What became of an estimator: its model, what that answers of the held-out samples and the log density of these,
    nats a sample; or the error that it failed with. seconds: that it took."""

    seconds: float
    model: TorqueModel | None = None
    answer: Answer | None = None
    density: float = -np.inf
    error: Exception | None = None


class Contest:
    """One contest; training, held: the samples of both sides."""

    def __init__(self, work: Fits, training: Samples, held: Samples) -> None:
        self.work, self.training = work, training
        self.held = held.rows(np.unique(np.linspace(0, len(held) - 1, JUDGED).round().astype(np.int64)))
        self.entries: dict[str, Contestant] = {}
        self.learnt: Learnt | None = None

    def run(self) -> None:
        """Train and judge all; raise what the first has failed with where all have.

        Where the chain predicts most joints better than the arm, the search for the arm may have missed it: it is taken
        up again, once, for as long.
        """
        self.entries[RIGID], self.learnt = self._rigid(RIGID)
        self.entries[BOTH] = self._enter(BOTH, BOTH, self.learnt) if self.learnt else self.entries[RIGID]
        self.entries[CHAIN] = self._enter(CHAIN, CHAIN, self.learnt)
        if self.learnt and mode_of(self.work.task) == "learn" and self._chain_leads():
            entry, learnt = self._rigid(AGAIN, self.learnt)
            if learnt and entry.density > self.entries[RIGID].density:
                self.entries[RIGID], self.learnt = entry, learnt
                self.entries[BOTH] = self._enter(BOTH, AGAIN, learnt)
        errors = [each.error for each in self.entries.values() if each.error is not None]
        if len(errors) == len(self.entries):
            raise errors[0]

    def verdict(self) -> tuple[str, str]:
        """The estimator that is chosen, and why."""
        best = self._best()
        trained = [name for name in MOST_PHYSICS_FIRST if self.entries[name].model is not None]
        for name in trained[: trained.index(best)]:
            if self._ties(name, best):
                return (
                    name,
                    f"{best} is within one standard error or errs no less: what knows more of the arm is taken",
                )
        if len(trained) == 1:
            return best, "no other could be trained"
        return best, "it predicts best what the training did not see"

    def table(self) -> list[Candidate]:
        """How each did, what knows most of the arm first."""
        best = self.entries[self._best()]
        rows = []
        for name in MOST_PHYSICS_FIRST:
            entry = self.entries[name]
            row = unjudged(name, entry.seconds, entry.error)
            if entry.answer is not None and best.answer is not None:
                metrics = evaluate(self.held.tau, *entry.answer)
                row["log_density"], row["difference"] = entry.density, entry.density - best.density
                row["nmse"], row["coverage"] = plain(metrics.nmse), plain(metrics.coverage)
                if entry is not best:
                    total = compare(self.held, best.answer, entry.answer).total
                    row["standard_error"] = plain(total.standard_error)[0]
            rows.append(row)
        return rows

    def _rigid(self, place: str, before: Learnt | None = None) -> tuple[Contestant, Learnt | None]:
        """Learn the arm and judge it alone."""
        began = time.monotonic()
        try:
            learnt = self.work.learn(self.training, place, before)
        except FAILURES as error:
            return Contestant(time.monotonic() - began, error=error), None
        entry = self._enter(RIGID, place, learnt)
        return replace(entry, seconds=time.monotonic() - began), learnt

    def _enter(self, name: str, place: str, learnt: Learnt | None = None) -> Contestant:
        """Train an estimator and judge it."""
        began = time.monotonic()
        if self.work.task.cancelled is not None and self.work.task.cancelled():
            raise FitCancelledError("the fit was cancelled")
        try:
            model = self.work.fit(self.training, name, place, learnt)
            torque = model.predict(self.held.q, self.held.dq, self.held.ddq)
            answer = torque.interval
            density = -float(evaluate(self.held.tau, *answer).nlpd.sum())
            if not np.isfinite(density):
                raise ValueError("what it predicts is not finite")
        except FAILURES as error:
            return Contestant(time.monotonic() - began, error=error)
        return Contestant(time.monotonic() - began, model, answer, density)

    def _chain_leads(self) -> bool:
        """Whether the chain predicts most joints better than the arm, by more than chance."""
        arm, chain = self.entries[RIGID].answer, self.entries[CHAIN].answer
        if arm is None or chain is None:
            return False
        nlpd = compare(self.held, arm, chain).nlpd
        return 2 * int(np.sum(nlpd.significant & (nlpd.mean < 0))) > self.held.n_joints

    def _best(self) -> str:
        return max(MOST_PHYSICS_FIRST, key=lambda name: self.entries[name].density)

    def _ties(self, name: str, best: str) -> bool:
        """Whether an estimator does as well as the best: its log density is within one standard error of it
        (the rule of Breiman et al. 1984), or its mean nMSE is no larger.

        Log density alone lets a few rows on which an arm was too sure decide for a black box that errs more.
        """
        first, second = self.entries[best].answer, self.entries[name].answer
        if first is None or second is None:
            return False
        total = compare(self.held, first, second).total
        return not bool(total.mean[0] > total.standard_error[0] and total.mean[1] > 0)
