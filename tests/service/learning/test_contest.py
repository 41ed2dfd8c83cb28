"""The contest between two versions: what it compares, what it concludes, and how often chance deceives it."""

import json
import time
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import norm

from lipcore.data.metrics import Answer, evaluate, surprise
from lipcore.model.torque_model import TorquePrediction
from lipcore.online.batch import Rows
from service.foundation.settings import Settings
from service.learning.learner.contest import (
    MIN_BLOCKS,
    REPEAT_EVERY_S,
    ROWS_PER_BATCH,
    Block,
    Contest,
    Duel,
    Duels,
    sample,
)
from tests.service.learning.batches import rows

ONE = np.ones(1)


@pytest.fixture(scope="module")
def settings(tmp_path_factory):
    return Settings(home=tmp_path_factory.mktemp("home"), promotion_rows=600, promotion_patience_s=600.0)


def answers(count: int, n: int, seed: int) -> tuple[np.ndarray, ...]:
    """Torques, and means, deviations and noise of two versions."""
    rng = np.random.default_rng(seed)
    tau, one, two = rng.normal(size=(3, count, n))
    return tau, one, rng.uniform(0.1, 1, (count, n)), two, rng.uniform(0.1, 1, (count, n)), rng.uniform(0.1, 1, n)


def compared(
    differences: np.ndarray, every_s: float = 0.05, settings: Settings | None = None, each: int = ROWS_PER_BATCH
) -> Any:
    """A contest fed with differences in nats, some at a time; with settings, judged until it is decided."""
    contest, verdict = Contest.start(1), None
    noise = np.sqrt(1 / (2 * np.pi))  # the density of no error is one
    for first in range(0, len(differences), each):
        part = differences[first : first + each, None]
        time = 1000.0 + every_s * np.arange(first, first + len(part))
        # one error explains the difference: that of the candidate where it is worse, else that of the other
        off = noise * np.sqrt(2 * np.abs(part))
        zero, std = np.zeros_like(part), np.zeros_like(part)
        serving = Answer(np.where(part > 0, off, 0.0), std, noise * ONE)
        candidate = Answer(np.where(part < 0, off, 0.0), std, noise * ONE)
        contest = contest.step(time, zero, serving, candidate, time[-1])
        if settings is not None:
            contest, verdict = contest.judge(settings, time[-1])
            if verdict is not None:
                break
    return contest if settings is None else (contest, verdict)


def correlated(count: int, seconds: float, seed: int, every_s: float = 0.05) -> np.ndarray:
    """Numbers of mean 0 and variance 1 that forget within some seconds."""
    fresh = np.random.default_rng(seed).normal(size=count)
    keep = np.exp(-every_s / seconds) if seconds else 0.0
    fresh[1:] *= np.sqrt(1 - keep**2)
    return lfilter([1.0], [1.0, -keep], fresh)


def test_gain_is_the_mean_difference_and_the_figures_are_those_of_the_rows():
    tau, one, std, two, other, noise = answers(300, 2, seed=2)
    contest = Contest.start(2)
    for first in range(0, 300, 20):
        part = slice(first, first + 20)
        old, new = Answer(one[part], std[part], noise), Answer(two[part], other[part], noise)
        contest = contest.step(np.arange(300.0)[part], tau[part], old, new, 0.0)
    expected = (surprise(tau, Answer(one, std, noise)) - surprise(tau, Answer(two, other, noise))).sum(axis=1)
    assert contest.rows == 300
    assert contest.gain == pytest.approx(expected.mean(), rel=1e-12)
    said = json.loads(json.dumps(contest.evidence()))
    for name, mean, deviation in (("serving", one, std), ("candidate", two, other)):
        metrics = evaluate(tau, mean, deviation, noise)
        np.testing.assert_allclose(said["figures"][name]["nmse"], metrics.nmse, rtol=1e-12)
        np.testing.assert_allclose(said["figures"][name]["coverage"], metrics.coverage, rtol=1e-12)


def test_the_first_look_asks_for_two_standard_errors_and_later_ones_for_more():
    many = {number: Block(1, 0.0) for number in range(10_000)}
    contest = Contest(Contest.start(1).serving, Contest.start(1).candidate, many)
    assert contest.bound() == pytest.approx(2.0, abs=1e-3)
    bounds = [Contest(contest.serving, contest.candidate, many, looks=looks).bound() for looks in range(6)]
    assert bounds == sorted(bounds)
    assert sum(norm.sf(bounds)) < 0.05
    few = Contest(contest.serving, contest.candidate, {number: Block(1, 0.0) for number in range(30)})
    assert few.bound() > 2.05


@pytest.mark.parametrize(
    ("better", "seed", "expected", "least", "most"),
    [
        pytest.param(0.3, 5, "promote", 600, 4800, id="better"),
        pytest.param(-0.5, 6, "dismiss", 1200, 1200, id="worse, on twice the rows"),
        pytest.param(0.0, 0, "dismiss", 11_900, 12_100, id="equal, once patience ends"),
    ],
)
def test_a_verdict_is_reached(settings, better, seed, expected, least, most):
    contest, verdict = compared(better + correlated(20_000, 0.5, seed), settings=settings)
    assert verdict == expected
    assert least <= contest.rows <= most
    assert (contest.gain > 2 * contest.standard_error) == (verdict == "promote")


def test_many_rows_of_a_short_time_decide_nothing(settings):
    every_s = 0.9 * MIN_BLOCKS / 10_000
    contest, verdict = compared(1.0 + 0.1 * correlated(10_000, 0.0, seed=8), every_s, settings)
    assert verdict is None
    assert contest.rows > 10 * settings.promotion_rows


@pytest.mark.slow
@pytest.mark.parametrize("seconds", [0.0, 1.0])
def test_chance_seldom_promotes_an_equal_candidate(settings, seconds):
    """All looks of a contest together: 2 · 2.3 % is the bound for independent blocks."""
    series = [correlated(12_000, seconds, seed) for seed in range(100)]
    verdicts = [compared(each, settings=settings, each=200)[1] for each in series]
    assert verdicts.count("promote") <= 0.07 * len(verdicts)


def test_few_rows_of_a_batch_are_compared_and_only_those_that_teach():
    given = rows(200, codes=("contact", "limit"))
    chosen = sample(given)
    assert len(chosen) == ROWS_PER_BATCH
    assert (chosen.time[0], chosen.time[-1]) == (given.time[2], given.time[-1])
    assert np.ptp(np.diff(chosen.time)) <= 0.0015
    assert len(sample(rows(5, codes=("contact",)))) == 4
    assert len(sample(rows(2, codes=("contact", "contact")))) == 0


@dataclass(frozen=True)
class Constant:
    """A model that predicts the same torque everywhere."""

    tau: float
    n_joints: int = 2

    def predict(self, q: np.ndarray, *_: np.ndarray) -> TorquePrediction:
        one = np.ones(q.shape[1])
        return TorquePrediction(np.full_like(q, self.tau), np.zeros_like(q), one, one)


@dataclass(eq=False)
class Pupil:
    """A follower whose version was trained to say -9 and now says something else."""

    version: int
    answering: Constant
    number: int = 0
    start: int = 0
    model: str = "arm"
    watchers: list[Any] = field(default_factory=list)
    base: Constant = Constant(-9.0)

    def learn(self, *numbers: int) -> None:
        """Hear of batches and learn them."""
        for watcher in list(self.watchers):
            watcher(self, [arrival(number) for number in numbers])
        self.number = numbers[-1]


def arrival(number: int, kind: str = "batch") -> Any:
    """A batch of 20 rows of a second of its own, whose torque is 1."""
    given = rows(20, seed=number)
    event = SimpleNamespace(number=number, kind=kind, received=1000.0 + number)
    return SimpleNamespace(
        event=event, rows=Rows(given.time, given.q, given.dq, given.ddq, np.ones((20, 2)), given.code)
    )


def test_followers_are_compared_on_what_both_predict_unseen(settings):
    serving, candidate = Pupil(1, Constant(0.0), number=3), Pupil(2, Constant(1.0))
    duel = Duel(serving, candidate, settings)
    candidate.learn(1, 2, 3, 4)  # the other has learnt the first three already
    assert duel.contest.rows == 0
    serving.learn(4)
    serving.learn(5, 6)
    candidate.learn(5)
    assert duel.contest.rows == 40
    assert duel.contest.gain == pytest.approx(2 * 0.5)  # half the squared error, of two joints
    candidate.learn(6)
    assert duel.contest.rows == 60
    duel.close()
    assert serving.watchers == candidate.watchers == []


def test_a_follower_that_is_not_solved_yet_is_not_compared(settings):
    serving, candidate = Pupil(1, Constant(0.0), number=3), Pupil(2, Pupil.base, number=3)
    duel = Duel(serving, candidate, settings)
    serving.learn(4)
    candidate.learn(4)
    assert duel.contest.rows == 0
    candidate.answering = Constant(1.0)
    serving.learn(5)
    candidate.learn(5)
    assert duel.contest.rows == 20


def test_a_log_that_goes_back_begins_the_contest_anew(settings):
    serving, candidate = Pupil(1, Constant(0.0)), Pupil(2, Constant(1.0))
    duel = Duel(serving, candidate, settings)
    for number in range(1, 6):
        serving.learn(number)
        candidate.learn(number)
    assert duel.contest.rows == 100
    serving.learn(3, 4)
    candidate.learn(3, 4)
    assert duel.contest.rows == 0
    serving.learn(5, 6)
    candidate.learn(5, 6)
    assert duel.contest.rows == 20


def test_a_verdict_is_told_until_its_roles_have_changed(settings, monkeypatch):
    serving, candidate = Pupil(1, Constant(0.0)), Pupil(2, Constant(1.0))
    duels = Duels(settings)
    duels.arrange("arm", serving, [candidate])
    for number in range(1, 41):
        serving.learn(number)
        candidate.learn(number)
        duels.arrange("arm", serving, [candidate])
    [told] = duels.outcomes()
    assert (told.model, told.serving, told.candidate, told.verdict) == ("arm", 1, 2, "promote")
    assert told.evidence["rows"] >= settings.promotion_rows
    assert list(duels.outcomes()) == []
    later = time.monotonic() + REPEAT_EVERY_S
    monkeypatch.setattr(time, "monotonic", lambda: later)
    assert list(duels.outcomes()) == [told]  # nothing has followed from it: the database may have been locked
    duels.arrange("arm", candidate, [])
    assert list(duels.outcomes()) == []
    assert serving.watchers == candidate.watchers == []
