"""Estimators trained on some samples of a recording and judged on others."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from lipcore.arm.known import known_geometries
from lipcore.arm.learning import Learnt, learn, mode_of
from lipcore.auto.table import Candidate, plain, unjudged
from lipcore.fit_options import FitOptions
from lipcore.fitting import Cancelled, FitCancelledError, FitProgress, Progress
from lipcore.metrics import evaluate
from lipcore.model import TorqueModel, fitted
from lipcore.paired import Answer, compare
from lipcore.samples import Samples
from lipcore.urdf import RigidBody
from lipcore.vocabulary import ROBOT_ESTIMATORS, JointType, TorqueConvention

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
class Work:
    """What all fits share; as the arguments of `lipcore.model.fitted`."""

    types: tuple[JointType, ...]
    options: FitOptions
    convention: TorqueConvention
    overall: Overall
    cancelled: Cancelled | None
    robot: RigidBody | None
    stretches: Samples | None

    def learn(self, samples: Samples, place: str, before: Learnt | None = None, search: bool = True) -> Learnt:
        """The arm. before: what other samples have told of it, where a search begins, too, or what replaces one."""
        gravity, stop, report = self.convention == "gravity_included", self.cancelled, self.overall.of(RIGID, place)
        shapes = () if before is None else before.arm.geometries
        if before is None and self.robot is None:
            shapes = known_geometries(self.types, gravity)
        known, begin, seed = (shapes, (), int(before is not None)) if search else ((), shapes, 0)
        how = (self.types, self.options, gravity, self.robot, known, report, stop, self.stretches, begin, seed)
        return learn(samples, *how)

    def fit(self, samples: Samples, name: str, place: str, learnt: Learnt | None = None) -> TorqueModel:
        """A model of one estimator, around an arm where that is learnt already."""
        robot, learnt = (self.robot, learnt) if name in ROBOT_ESTIMATORS else (None, None)
        report, stop = self.overall.of(name, place), self.cancelled
        how = (self.types, name, self.options, self.convention, report, stop, robot, self.stretches, learnt)
        return fitted(samples, *how)


@dataclass(frozen=True)
class Entry:
    """What became of an estimator: its model, what that answers of the held-out samples and the log density of these,
    nats a sample; or the error that it failed with. seconds: that it took."""

    seconds: float
    model: TorqueModel | None = None
    answer: Answer | None = None
    density: float = -np.inf
    error: Exception | None = None


class Contest:
    """One contest; training, held: the samples of both sides."""

    def __init__(self, work: Work, training: Samples, held: Samples) -> None:
        self.work, self.training = work, training
        self.held = held.rows(np.unique(np.linspace(0, len(held) - 1, JUDGED).round().astype(np.int64)))
        self.entries: dict[str, Entry] = {}
        self.learnt: Learnt | None = None

    def run(self) -> None:
        """Train and judge all; raise what the first has failed with where all have.

        Where the chain predicts most joints better than the arm, the search for the arm may have missed it: it is taken
        up again, once, for as long.
        """
        self.entries[RIGID], self.learnt = self._rigid(RIGID)
        self.entries[BOTH] = self._enter(BOTH, BOTH, self.learnt) if self.learnt else self.entries[RIGID]
        self.entries[CHAIN] = self._enter(CHAIN, CHAIN)
        if self.learnt and mode_of(self.work.options, self.work.robot) == "learn" and self._chain_leads():
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
                found = evaluate(self.held.tau, *entry.answer)
                row["log_density"], row["difference"] = entry.density, entry.density - best.density
                row["nmse"], row["coverage"] = plain(found.nmse), plain(found.coverage)
                if entry is not best:
                    total = compare(self.held, best.answer, entry.answer).total
                    row["standard_error"] = plain(total.standard_error)[0]
            rows.append(row)
        return rows

    def _rigid(self, place: str, before: Learnt | None = None) -> tuple[Entry, Learnt | None]:
        """Learn the arm and judge it alone."""
        began = time.monotonic()
        try:
            learnt = self.work.learn(self.training, place, before)
        except FAILURES as error:
            return Entry(time.monotonic() - began, error=error), None
        entry = self._enter(RIGID, place, learnt)
        return replace(entry, seconds=time.monotonic() - began), learnt

    def _enter(self, name: str, place: str, learnt: Learnt | None = None) -> Entry:
        """Train an estimator and judge it."""
        began = time.monotonic()
        if self.work.cancelled is not None and self.work.cancelled():
            raise FitCancelledError("the fit was cancelled")
        try:
            model = self.work.fit(self.training, name, place, learnt)
            found = model.predict(self.held.q, self.held.dq, self.held.ddq)
            answer = Answer(found.tau, found.tau_std, found.noise_std)
            density = -float(evaluate(self.held.tau, *answer).nlpd.sum())
            if not np.isfinite(density):
                raise ValueError("what it predicts is not finite")
        except FAILURES as error:
            return Entry(time.monotonic() - began, error=error)
        return Entry(time.monotonic() - began, model, answer, density)

    def _chain_leads(self) -> bool:
        """Whether the chain predicts most joints better than the arm, by more than chance."""
        arm, chain = self.entries[RIGID].answer, self.entries[CHAIN].answer
        if arm is None or chain is None:
            return False
        found = compare(self.held, arm, chain).nlpd
        return 2 * int(np.sum(found.significant & (found.mean < 0))) > self.held.n_joints

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
