"""The estimator `auto`: several estimators are trained, and one is chosen by its predictions of held-out samples.

The simplest is chosen unless another one is surely better (`lipcore.training.choice`). It then learns all samples.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from lipcore.arm import search
from lipcore.arm.learning import ArmFit, learn
from lipcore.arm.posing import mode_of
from lipcore.arm.search import known_geometries
from lipcore.data.metrics import TorqueDistribution, compare, evaluate
from lipcore.data.motion import spaced_rows
from lipcore.data.samples import Samples
from lipcore.data.signals import noise_level
from lipcore.data.splits import SplitError, select_rows
from lipcore.estimators.hyperparameters import FitCancelledError, FitProgress, Progress
from lipcore.estimators.task import Task
from lipcore.model.selection import Candidate, HeldOut, plain, selection, unevaluated_candidate
from lipcore.model.torque_model import TorqueModel
from lipcore.training.choice import HeldOutSamples, choose_estimator
from lipcore.training.correction import correct, corrected_joints
from lipcore.training.fit import fit_estimator
from lipcore.training.held_out import HoldOut, hold_out
from lipcore.training.refit import refit, widen_intervals
from lipcore.vocabulary import LOCAL, RIGID, ROBOT_ESTIMATORS

CHAIN = "lip-chain"
PLACES = {
    RIGID: (0, 0.25),
    LOCAL: (0.25, 0.3),
    CHAIN: (0.3, 0.92),
    "again": (0.92, 0.97),
    "all": (0.97, 1),
    "few": (0, 1),
}
"""Range of each fit within the whole work, as fractions."""
COMPARED_ROWS = 10_000
"""Max rows of a correction that is compared with other estimators. The chosen estimator learns all."""
FAILURES = (ArithmeticError, ValueError)
"""Errors of an estimator on unsuitable samples."""


def train_auto(task: Task) -> TorqueModel:
    """Train the estimator that suits the samples of a task.

    Raise FitCancelledError, or the error of the first estimator if all have failed.
    """
    work = FitContext(task, OverallProgress(task.on_progress))
    try:
        held = hold_out(task.samples, task.joint_types)
    except SplitError as error:
        return _train_simplest(work, f"no other estimator was trained, as too few samples can be held out: {error}")
    contest = EstimatorComparison(work, held)
    contest.run()
    chosen, reason = contest.verdict()
    rows, edge_rows = int(held.parts.held_out.sum()), int(held.edge.sum())
    held_out = HeldOut(
        rows=rows, blocks=held.blocks, repeats=held.repeats, edge_rows=edge_rows, edge_blocks=held.edge_blocks
    )
    model = contest.entries[chosen].model
    assert model is not None  # a chosen estimator was trained
    model = replace(
        widen_intervals(model, contest.held.samples), selection=selection(chosen, reason, contest.table(), held_out)
    )
    model = refit(model, replace(task, on_progress=work.overall.of(chosen, "all")))
    return replace(model, fit={**model.fit, "seconds": work.overall.elapsed})


def _train_simplest(work: FitContext, reason: str) -> TorqueModel:
    """Train the simplest possible estimator on all samples, because they are too few to hold some out."""
    table: list[Candidate] = []
    errors: list[Exception] = []
    for name in (RIGID, CHAIN):
        began = time.monotonic()
        try:
            model = work.fit(work.task.samples, name, "few")
        except FAILURES as error:
            errors.append(error)
            table.append(unevaluated_candidate(name, time.monotonic() - began, error))
            continue
        table.append(unevaluated_candidate(name, time.monotonic() - began))
        return replace(model, selection=selection(name, reason, table))
    raise errors[0]


class OverallProgress:
    """Progress of all fits together. Its fraction never decreases."""

    def __init__(self, on_progress: Progress | None) -> None:
        self.on_progress, self.began, self.highest = on_progress, time.monotonic(), 0.0

    @property
    def elapsed(self) -> float:
        """Seconds since the start of the first fit."""
        return time.monotonic() - self.began

    def of(self, estimator: str, place: str) -> Progress:
        """Return the progress callback for the fit of an estimator. place: one of PLACES."""
        low, high = PLACES[place]

        def report(at: FitProgress) -> None:
            self.highest = max(self.highest, low + (high - low) * at.fraction)
            if self.on_progress is not None:
                self.on_progress(replace(at, fraction=self.highest, elapsed=self.elapsed, estimator=estimator))

        return report


@dataclass(frozen=True)
class FitContext:
    """Input and progress that all fits share."""

    task: Task
    overall: OverallProgress

    def learn(self, samples: Samples, place: str, before: ArmFit | None = None) -> ArmFit:
        """Learn the arm of some samples.

        place: one of PLACES; before: an earlier result, an additional start of this search.
        """
        task = replace(self.task.on(samples), on_progress=self.overall.of(RIGID, place))
        shapes = () if before is None else before.arm.geometries
        if before is None and task.robot is None and task.sibling is None:
            shapes = known_geometries(task.joint_types, task.gravity)
        return learn(task, shapes, (), int(before is not None))

    def fit(self, samples: Samples, name: str, place: str, learnt: ArmFit | None = None) -> TorqueModel:
        """Train one estimator; see `fit_estimator` for its use of a learnt arm.

        samples: of the task's recordings; name: of the estimator; place: one of PLACES.
        """
        task = replace(self.task, samples=samples, on_progress=self.overall.of(name, place))
        if name not in ROBOT_ESTIMATORS:
            task = replace(task, robot=None, sibling=None)
        return fit_estimator(task, name, learnt, correct=partial(correct, max_rows=COMPARED_ROWS))


@dataclass(frozen=True)
class EstimatorResult:
    """Result of the training of one estimator."""

    seconds: float
    """Duration, s."""
    model: TorqueModel | None = None
    """The model, None if the training failed."""
    answer: TorqueDistribution | None = None
    """Its prediction of the held-out samples."""
    density: float = -np.inf
    """Their log density, nats per sample."""
    error: Exception | None = None
    """Error of the training."""


class EstimatorComparison:
    """Comparison of estimators on the samples of a task."""

    def __init__(self, work: FitContext, hold: HoldOut) -> None:
        self.work, parts = work, hold.parts
        self.training, held = (
            select_rows(work.task.samples, parts.train),
            select_rows(work.task.samples, parts.held_out),
        )
        rows = spaced_rows(len(held), 2000)
        self.held = HeldOutSamples(held.rows(rows), hold.edge[parts.held_out][rows])
        self.entries: dict[str, EstimatorResult] = {}
        self.learnt: ArmFit | None = None

    def run(self) -> None:
        """Train and evaluate the estimators. Raise the error of the first if all have failed.

        The others are not trained if the arm's residuals are at the level of the sensor's noise. If the chain predicts
        most joints better than the arm, the search may have missed the arm: it is repeated once, with the same time
        limit.
        """
        self.entries[RIGID], self.learnt = self._rigid(RIGID)
        if self._is_explained():
            return
        self.entries[LOCAL] = self._enter(LOCAL, LOCAL, self.learnt) if self.learnt else self.entries[RIGID]
        if self.learnt is None or len(self.learnt.arm.geometry.roots) == 1:  # several arms are no serial chain
            self.entries[CHAIN] = self._enter(CHAIN, CHAIN, self.learnt)
        if self.learnt and mode_of(self.work.task) == "learn" and self._chain_leads():
            entry, learnt = self._rigid("again", self.learnt)
            if learnt and entry.density > self.entries[RIGID].density:
                self.entries[RIGID], self.learnt = entry, learnt
                self.entries[LOCAL] = self._enter(LOCAL, "again", learnt)
        errors = [each.error for each in self.entries.values() if each.error is not None]
        if len(errors) == len(self.entries):
            raise errors[0]

    def verdict(self) -> tuple[str, str]:
        """Return the chosen estimator, and the reason."""
        if len(self.entries) == 1:
            return RIGID, "it explains the held-out torque within the sensor noise, so no other estimator was trained"
        # the simplest first: an estimator with an arm has smaller errors away from the data
        answers = {name: self.entries[name].answer for name in (RIGID, LOCAL, CHAIN) if name in self.entries}
        local = self.entries[LOCAL].model
        if local is None or not corrected_joints(local.fit):
            del answers[LOCAL]
        return choose_estimator(self.held, {name: each for name, each in answers.items() if each is not None})

    def table(self) -> list[Candidate]:
        """Return the figures of all estimators, the simplest first."""
        best = max(self.entries.values(), key=lambda entry: entry.density)
        rows = []
        for name, entry in self.entries.items():
            row = unevaluated_candidate(name, entry.seconds, entry.error)
            if entry.answer is not None and best.answer is not None:
                row["log_density"], row["difference"] = entry.density, entry.density - best.density
                row["nmse"] = plain(self.held.nmse(entry.answer))
                row["edge_nmse"] = plain(self.held.edge_nmse(entry.answer))
                row["coverage"] = plain(entry.answer.contains(self.held.samples.tau).mean(axis=0))
                if entry is not best:
                    total = compare(self.held.samples, best.answer, entry.answer).total
                    row["standard_error"] = plain(total.standard_error)[0]
            rows.append(row)
        return rows

    def _rigid(self, place: str, before: ArmFit | None = None) -> tuple[EstimatorResult, ArmFit | None]:
        """Learn the arm and evaluate it alone."""
        began = time.monotonic()
        try:
            learnt = self.work.learn(self.training, place, before)
        except FAILURES as error:
            return EstimatorResult(time.monotonic() - began, error=error), None
        entry = self._enter(RIGID, place, learnt)
        return replace(entry, seconds=time.monotonic() - began), learnt

    def _enter(self, name: str, place: str, learnt: ArmFit | None = None) -> EstimatorResult:
        """Train an estimator and evaluate it."""
        began = time.monotonic()
        if self.work.task.cancelled is not None and self.work.task.cancelled():
            raise FitCancelledError("the fit was cancelled")
        try:
            model = self.work.fit(self.training, name, place, learnt)
            samples = self.held.samples
            torque = model.predict_along(samples)
            answer = torque.interval
            density = -float(evaluate(samples.tau, *answer).nlpd.sum())
            if not np.isfinite(density):
                raise ValueError("its predictions are not finite")
        except FAILURES as error:
            return EstimatorResult(time.monotonic() - began, error=error)
        return EstimatorResult(time.monotonic() - began, model, answer, density)

    def _is_explained(self) -> bool:
        """Return whether the arm predicts all joints to the sensor's noise.

        This needs signals in order of time, with a noise of positions below 1 % of their spread.
        """
        answer, signals = self.entries[RIGID].answer, self.work.task.signals
        if answer is None:
            return False
        q, tau = (noise_level([array[part] for part in signals.episodes()]) for array in (signals.q, signals.tau))
        error = np.sqrt(np.square(self.held.samples.tau - answer.mean).mean(axis=0))
        return bool((q < 0.01 * signals.q.std(axis=0)).all() and (error <= search.OPTIONS.explained_ratio * tau).all())

    def _chain_leads(self) -> bool:
        """Return whether the chain predicts most joints better than the arm, beyond chance."""
        arm, chain = self.entries[RIGID].answer, self.entries[CHAIN].answer if CHAIN in self.entries else None
        if arm is None or chain is None:
            return False
        nlpd = compare(self.held.samples, arm, chain).nlpd
        return 2 * int(np.sum(nlpd.significant & (nlpd.mean < 0))) > self.held.samples.n_joints
