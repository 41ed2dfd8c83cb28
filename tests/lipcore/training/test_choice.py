"""Tests of the rule that chooses between estimators by their held-out predictions."""

from dataclasses import replace

import numpy as np
import pytest

from lipcore.data.metrics import TorqueDistribution
from lipcore.data.samples import Samples
from lipcore.training.choice import HeldOutSamples, choose_estimator

ARM, LOCAL, CHAIN = "rigid-body", "rigid-body+local", "lip-chain"
ROWS, JOINTS, RATE = 1200, 2, 20.0
TIME = np.arange(ROWS) / RATE
EDGE = np.mod(TIME, 10.0) >= 8.0
TAU = np.stack([np.sin(TIME), 3 * np.cos(TIME)], axis=1)


def held_out(edge=EDGE, seconds=TIME[-1] + 1) -> HeldOutSamples:
    rest = np.zeros((3, ROWS, JOINTS))
    samples, rows = Samples(("a", "b"), TIME, np.zeros(ROWS, np.int64), *rest, TAU), seconds > TIME
    return HeldOutSamples(samples.rows(rows), edge[rows])


def predict_with_errors(inside, edge, stated=None, seconds=TIME[-1] + 1, seed=0) -> TorqueDistribution:
    """Return a prediction with these relative errors inside and at the edge; it states the first, or `stated`."""
    scale = np.random.default_rng(seed).normal(size=(ROWS, 1)) * TAU.std(axis=0)
    mean = (TAU + np.where(EDGE, edge, inside)[:, None] * scale)[seconds > TIME]
    return TorqueDistribution(mean, np.zeros_like(mean), (inside if stated is None else stated) * TAU.std(axis=0))


CASES = {
    "equal": ({ARM: (0.1, 0.1), CHAIN: (0.1, 0.1)}, ARM, "not significantly higher"),
    "a little better": ({ARM: (0.1, 0.1), CHAIN: (0.0999, 0.0999)}, ARM, "not significantly higher"),
    "better everywhere": ({ARM: (0.3, 0.3), CHAIN: (0.1, 0.1)}, CHAIN, "replaces rigid-body: it is better"),
    "a correction": ({ARM: (0.3, 0.3), LOCAL: (0.2, 0.2)}, LOCAL, "replaces rigid-body: it is no worse"),
    "a correction that is worse": ({ARM: (0.1, 0.1), LOCAL: (0.3, 0.3)}, ARM, "lower by more than one standard error"),
    "a correction that errs more": ({ARM: (0.1, 0.1, 0.02), LOCAL: (0.15, 0.1)}, ARM, "its error is larger"),
    "better than an arm and its correction": (
        {ARM: (0.3, 0.3), LOCAL: (0.2, 0.2), CHAIN: (0.1, 0.1)},
        CHAIN,
        "lip-chain replaces rigid-body+local",
    ),
    "as good as an arm and its correction": (
        {ARM: (0.3, 0.3), LOCAL: (0.1, 0.1), CHAIN: (0.1, 0.1)},
        LOCAL,
        "lip-chain does not replace rigid-body+local: its log density is not significantly higher",
    ),
    "bends at the edge": (
        {ARM: (0.3, 0.3), CHAIN: (0.05, 0.32, 0.3)},
        ARM,
        "its error is larger at the edge of the data",
    ),
    "errs more": ({ARM: (0.1, 0.1, 0.02), CHAIN: (0.2, 0.1)}, ARM, "its error is larger"),
    "one alone": ({CHAIN: (0.3, 0.3)}, CHAIN, "no other estimator was trained"),
}


@pytest.mark.parametrize("case", CASES)
def test_simplest_is_chosen_unless_another_is_surely_better(case):
    given, expected, why = CASES[case]
    answers = {name: predict_with_errors(*each, seed=seed) for seed, (name, each) in enumerate(given.items())}
    chosen, reason = choose_estimator(held_out(), answers)
    assert chosen == expected, reason
    assert why in reason
    assert len(reason) < 300


def test_simplest_is_chosen_without_evidence_at_the_edge():
    answers = {ARM: predict_with_errors(0.3, 0.3), CHAIN: predict_with_errors(0.1, 0.1)}
    assert choose_estimator(held_out(), answers)[0] == CHAIN
    no_edge = held_out(edge=np.zeros(ROWS, dtype=bool))
    chosen, reason = choose_estimator(no_edge, answers)
    assert chosen == ARM
    assert reason.endswith("no rows at the edge of the data could be held out")
    assert choose_estimator(no_edge, {ARM: answers[ARM], LOCAL: answers[ARM]})[0] == LOCAL
    one_block = {ARM: predict_with_errors(0.3, 0.3, None, 0.9), CHAIN: predict_with_errors(0.1, 0.1, None, 0.9)}
    assert choose_estimator(held_out(np.ones(ROWS, dtype=bool), 0.9), one_block)[0] == ARM


def test_edge_error_is_relative_to_all_rows():
    held, given = held_out(), predict_with_errors(0.1, 0.5)
    error, variance = np.square(TAU - given.mean), TAU.var(axis=0)
    assert held.edge_nmse(given) == pytest.approx(np.mean(error[EDGE], axis=0) / variance)
    assert held.nmse(given) == pytest.approx(np.mean(error, axis=0) / variance)
    assert np.isnan(held_out(np.zeros(ROWS, dtype=bool)).edge_nmse(given)).all()


def test_joint_without_torque_has_no_error():
    held = held_out()
    held = replace(held, samples=replace(held.samples, tau=np.where([True, False], TAU, 0.1)))
    assert np.isfinite(held.nmse(predict_with_errors(0.1, 0.1))).tolist() == [True, False]
    answers = {ARM: predict_with_errors(0.3, 0.3), CHAIN: predict_with_errors(0.1, 0.1)}
    assert choose_estimator(held, answers)[0] in {ARM, CHAIN}
