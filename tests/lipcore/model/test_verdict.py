"""Tests of the verdict: a model is usable only if its figures show that."""

from dataclasses import replace

import numpy as np
import pytest

from lipcore.data.metrics import quantile
from lipcore.data.motion import Motion
from lipcore.data.signals import noise_level
from lipcore.model import texts
from lipcore.model.judging import judge, judge_recording
from lipcore.model.torque_model import training_range
from lipcore.model.verdict import LEVELS, OPTIONS, Fault, JudgedFigures, OutsideFigures, is_outside

OUTSIDE = OutsideFigures(share=0.4, squared=np.array([0.02, 1.5]), coverage=np.array([0.95, 0.93]))
GOOD = JudgedFigures(
    joint_names=("hip", "knee"),
    joint_types=("revolute", "prismatic"),
    nmse=np.array([0.01, 0.2]),
    rmse=np.array([0.1, 1.0]),
    torque_noise=np.full(2, 0.05),
    coverage=np.array([0.95, 0.96]),
    coverage_low=np.array([0.9, 0.91]),
    coverage_high=np.array([0.97, 0.98]),
    independent=np.full(2, 60.0),
    interval_width=np.array([0.5, 5.0]),
    torque_range=np.array([4.0, 8.0]),
    torque_limit=np.array([20.0, np.nan]),
    serving_rmse=np.array([0.2, np.nan]),
    outside=OUTSIDE,
    moving=1.0,
    seconds=30.0,
)


def figures_with(**fields):
    return replace(GOOD, **{name: np.array(value) for name, value in fields.items()})


CASES = {
    "good": (GOOD, "usable", "RMSE is at most 12 % of the torque range and coverage at least 95 % on every joint"),
    "error of the mean": (figures_with(nmse=[0.01, 0.9]), "wrong", "no smaller than with the mean torque: knee 1 N "),
    "error above the mean": (
        figures_with(nmse=[4.0, 0.2], rmse=[2.0, 1.0]),
        "wrong",
        "hip 2 N·m RMSE (mean torque: 1 N·m)",
    ),
    "narrow": (
        figures_with(coverage=[0.95, 0.7], coverage_low=[0.9, 0.6], coverage_high=[0.97, 0.89]),
        "wrong",
        "too narrow: knee 70 % inside (95 % CI 60–89 %, 60 effective samples)",
    ),
    "narrow by chance": (figures_with(coverage=[0.95, 0.7]), "usable", "coverage at least 70 %"),
    "wide": (figures_with(interval_width=[0.5, 9.0]), "too_uncertain", "knee 9 N wide (mean torque: 8.8 N)"),
    "wider than needed": (figures_with(interval_width=[3.0, 5.0]), "usable", "coverage"),
    "few": (
        figures_with(independent=[60.0, 4.0]),
        "not_judged",
        "effective samples to judge the errors: knee 4",
    ),
    "enough": (figures_with(independent=[60.0, 25.0]), "usable", "coverage"),
    "noise": (figures_with(torque_noise=[1.0, 1.0]), "not_judged", "not larger than its noise"),
    "constant": (figures_with(nmse=[np.nan, np.nan]), "not_judged", "not larger than its noise"),
    "one of noise": (figures_with(nmse=[0.01, np.nan]), "usable", "coverage"),
    "inside": (
        replace(GOOD, outside=replace(OUTSIDE, share=0.01)),
        "usable_in_range",
        "1 % of the samples",
    ),
    "short": (replace(GOOD, seconds=2.9), "not_judged", "Only 2.9 s can be judged, at least 3 s are needed."),
    "at rest": (replace(GOOD, moving=0.09), "usable_in_range", "the samples stand still"),
    "earlier release": (replace(GOOD, moving=None, seconds=None), "usable", "coverage"),
    "unknown range": (replace(GOOD, outside=None), "usable_in_range", "outside the recorded range are unknown"),
    "large outside": (
        replace(GOOD, outside=replace(OUTSIDE, squared=np.array([0.02, 4.6]))),
        "usable_in_range",
        "Outside the recorded range its errors or intervals are wrong: knee.",
    ),
    "narrow outside": (
        replace(GOOD, outside=replace(OUTSIDE, coverage=np.array([0.5, 0.95]))),
        "usable_in_range",
        "wrong: hip.",
    ),
    "no outside": (
        replace(GOOD, outside=OutsideFigures(0.0, np.full(2, np.nan), np.full(2, np.nan))),
        "usable_in_range",
        "0 % of the samples",
    ),
}


@pytest.mark.parametrize(("figures", "level", "words"), CASES.values(), ids=CASES)
def test_figures_decide_the_level(figures, level, words):
    found = judge(figures, "held_out")
    assert found.level == level
    assert words in found.reason
    assert found.reason.endswith(".")
    assert found.action.endswith(".")
    assert found.serves == level.startswith("usable")


def test_each_joint_has_its_own_level():
    found = judge(figures_with(nmse=[0.01, 0.95], interval_width=[5.0, 5.0]), "held_out")
    assert [each.level for each in found.joints] == ["too_uncertain", "wrong"]
    assert found.level == min((each.level for each in found.joints), key=LEVELS.index)


def test_joints_have_figures_with_units():
    hip, knee = judge(GOOD, "held_out", repeats=0.1).joints
    assert (hip.unit, knee.unit) == ("N·m", "N")
    assert hip.range_share == pytest.approx(0.1 / 4)
    assert (hip.limit_share, knee.limit_share) == (pytest.approx(0.1 / 20), None)
    assert (hip.serving_rmse, knee.serving_rmse) == (0.2, None)
    assert hip.mean_rmse == pytest.approx(1.0)
    assert knee.width_over_need == pytest.approx(5 / (2 * quantile(0.95)))


def test_origin_of_the_samples_counts():
    assert judge(None, "nothing").level == "not_judged"
    assert judge(None, "nothing").reason == texts.NOTHING_HELD_OUT
    assert judge(GOOD, "training").level == "not_judged"
    assert judge(figures_with(nmse=[4.0, 0.2], rmse=[2.0, 1.0]), "training").level == "wrong"
    assert judge(GOOD, "recording", repeats=0.6).reason == texts.describe_repeated(0.6)
    assert judge(GOOD, "recording", repeats=0.4).level == "usable"


def test_verdict_on_a_stream_holds_for_its_motion_only():
    found = judge(replace(GOOD, outside=None), "stream")
    assert (found.level, found.reason) == ("usable_in_range", texts.ONLY_PRESENT_MOTION)
    assert judge(GOOD, "stream").level == "usable"


@pytest.mark.parametrize(
    ("recording", "level", "words"),
    [
        ((60.0, 0.9, None), "usable", "does not repeat itself"),
        ((None, None, None), "usable", ""),
        ((9.9, 1.0, None), "not_judged", "Only 3 s can be judged, at least 3 s are needed"),
        ((60.0, 0.05, None), "usable_in_range", "stand still"),
        ((60.0, 1.0, 4.0), "usable_in_range", "repeats itself every 4 s"),
    ],
)
def test_recording_limits_the_verdict(recording, level, words):
    found = judge_recording(*recording)
    assert (found.level, found.judged_on, found.joints) == (level, "nothing", ())
    assert words in found.reason
    fault = Fault("The torque of hip has the opposite sign.", "Read it again.")
    wrong = judge_recording(*recording, faults=[fault])
    assert (wrong.level, wrong.reason, wrong.action) == ("wrong", fault.text, fault.action)


def test_fault_of_the_data_outranks_figures():
    fault = Fault("The torque of hip has the opposite sign.", "Read it again.")
    for figures in (GOOD, None):
        found = judge(figures, "held_out", faults=[fault])
        assert (found.level, found.reason, found.action) == ("wrong", fault.text, fault.action)
    assert judge(GOOD, "held_out", faults=[fault]).joints == judge(GOOD, "held_out").joints
    found = judge(figures_with(nmse=[4.0, 4.0], rmse=[2.0, 2.0]), "recording", faulty_samples=[fault])
    assert (found.level, found.reason) == ("not_judged", fault.text)


def test_thresholds_are_options():
    strict = replace(OPTIONS, max_error=0.1, max_width=0.1, min_coverage=0.99)
    assert [judge(GOOD, "held_out", options=replace(OPTIONS, **{name: getattr(strict, name)})).level for name in (
        "max_error", "max_width", "min_coverage")] == ["wrong", "too_uncertain", "wrong"]  # fmt: skip


def test_state_is_outside_beyond_a_tenth_of_the_range():
    rng = np.random.default_rng(0)
    motion = Motion(*rng.uniform(-1, 1, (3, 500, 2)))
    known = training_range(motion)
    assert not is_outside(motion, known).any()
    high = np.array(known["dq"]["max"])
    dq = np.stack([high + 0.19 * np.array([1, 0]), high + 0.21 * np.array([0, 1])])
    q = np.zeros_like(dq)
    assert is_outside(Motion(q, dq, q), known).tolist() == [False, True]


@pytest.mark.parametrize("seed", range(5))
def test_mean_and_shuffled_torque_are_never_usable(seed):
    """Test a model that predicts the mean, with few effective samples, and one trained on shuffled torque."""
    rng = np.random.default_rng(seed)
    t = np.arange(600) / 50
    tau = np.sin(np.outer(t, rng.uniform(1, 6, 3)) + rng.uniform(0, 6, 3)) * [5.0, 1.0, 30.0]
    tau += 0.02 * rng.standard_normal(tau.shape)
    error = tau - tau.mean(axis=0) + 0.1 * rng.standard_normal(3)
    for torque in (tau, tau[rng.permutation(len(tau))]):
        one, unknown = np.ones(3), np.full(3, np.nan)
        figures = JudgedFigures(
            joint_names=("a", "b", "c"),
            joint_types=("revolute",) * 3,
            nmse=np.mean(error**2, axis=0) / torque.var(axis=0),
            rmse=np.sqrt(np.mean(error**2, axis=0)),
            torque_noise=noise_level([torque]),
            **dict.fromkeys(("coverage", "coverage_low", "coverage_high"), one),
            independent=20 * one,
            interval_width=9 * one,
            **dict.fromkeys(("torque_range", "torque_limit", "serving_rmse"), unknown),
            outside=None,
            moving=1.0,
            seconds=60.0,
        )
        assert not judge(figures, "held_out").serves
