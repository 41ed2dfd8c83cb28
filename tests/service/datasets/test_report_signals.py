"""Clock, parts, noise, limits, saturation and lag: against what plain counting says of recordings made for it."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import butter, lfilter, sosfiltfilt

from lipcore.data.signals import noise_level
from lipcore.preparation.recipe import Recipe
from service.contract.datasets import Excitation, Lag, Timing
from service.datasets.report.advice import collect_warnings
from service.datasets.report.fit import Fit
from service.datasets.report.lag import shifts
from service.datasets.report.signals import (
    analyse_times,
    bounds,
    compare_with_limits,
    detect_saturation,
    is_smoothed,
    limits_of,
    noise_or_default,
    number_parts,
    thin,
    white_noise,
)
from service.datasets.store import extremes
from tests.service.datasets.report_data import FakeProfile, recording, report_on, staged

PENDULUM = ("joint1", "joint2")
AS_IT_IS = Recipe(filtering="never")


def robot(**changed: np.ndarray) -> FakeProfile:
    limits = {"lower": np.array([-1.0, -1.0]), "upper": np.array([1.0, 1.0])}
    limits |= {"speed": np.array([2.0, np.inf]), "torque": np.array([np.nan, 5.0])}
    return FakeProfile("arm", PENDULUM, ("revolute", "revolute"), **limits | changed)


def test_jitter_is_a_share_of_the_usual_step(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    steps = 0.01 * (1 + np.where(rng.random(4000) < 0.02, 0.2, 0.0))
    t = np.concatenate([[5.0], 5.0 + np.cumsum(steps)])
    timing = analyse_times(staged(tmp_path, ("a",), {"t": t, "q": t[:, None]}), 1.5, 3).timing
    assert timing.rate_hz == pytest.approx(100)
    assert (timing.jitter_p50, timing.jitter_p99, timing.jitter_max) == pytest.approx((0, 0.2, 0.2), abs=1e-9)
    assert timing.duration_s == pytest.approx(t[-1] - t[0])
    assert (timing.gaps, timing.repeated_stamps, timing.missing_rows) == ([], 3, 0)


def test_gaps_are_listed_with_their_times(tmp_path: Path) -> None:
    t = np.arange(1000) / 100
    t[300:] += 2.0
    t[700:] += 0.5
    episode = np.repeat([1.0, 2.0], 500)
    q = np.sin(t)[:, None]
    q[[10, 11]] = np.nan
    clock = analyse_times(staged(tmp_path, ("a",), {"t": t, "episode": episode, "q": q}), 1.5, 0)
    assert [(gap.t, gap.seconds) for gap in clock.timing.gaps] == [
        (pytest.approx(2.99), pytest.approx(2.01)),
        (pytest.approx(8.99), pytest.approx(0.51)),
    ]
    assert clock.timing.missing_rows == 2
    # to 10, two missing rows alone, to 300, to 500 (another episode), to 700, to the end
    assert np.unique(clock.part, return_counts=True)[1].tolist() == [10, 1, 1, 288, 200, 200, 300]


def test_limits_are_compared_joint_by_joint() -> None:
    limits = limits_of(robot(), PENDULUM)
    q = np.linspace(-0.5, 1.5, 201)
    columns = {"q": q, "dq": 3 * q, "tau": 4 * q}
    first, second = (compare_with_limits(joint, PENDULUM[joint], columns, limits) for joint in (0, 1))
    assert (first.range_used, first.beyond_range) == pytest.approx((1.0, 50 / 201))
    assert (first.speed_used, first.beyond_speed) == pytest.approx((4.5 / 2, np.mean(np.abs(3 * q) > 2)))
    assert (first.torque_used, first.beyond_torque, second.speed_used, second.beyond_speed) == (None,) * 4
    assert second.torque_used == pytest.approx(6 / 5)
    unknown = compare_with_limits(0, "joint1", columns, None)
    assert set(unknown.model_dump(exclude={"joint"}).values()) == {None}


def test_limits_follow_the_names() -> None:
    profile = robot(upper=np.array([1.0, 2.0]))
    swapped, one = limits_of(profile, PENDULUM[::-1]), limits_of(profile, ("joint2", "gripper"))
    assert swapped.upper.tolist() == [2.0, 1.0]
    assert swapped.urdf_joints == PENDULUM[::-1]
    assert one.upper[0] == 2.0
    assert np.isnan(one.upper[1])
    assert one.urdf_joints is None
    by_order = limits_of(profile, ("x", "y"))
    assert by_order.by_order
    assert by_order.urdf_joints == PENDULUM
    assert limits_of(profile, ("x", "y", "z")) is None
    assert limits_of(None, PENDULUM) is None


def test_clipped_torque_is_reported() -> None:
    t = np.arange(2000) / 100
    full = 8 * np.sin(2 * t) + 2 * np.sin(7 * t)
    tau = np.clip(full, -6, 5)
    limits = limits_of(robot(), PENDULUM)
    result = detect_saturation(1, "joint2", np.cos(t), tau, limits)
    assert result.at_largest == pytest.approx(np.mean((full >= 5) | (full <= -6)))
    assert result.flat == pytest.approx(result.at_largest, rel=0.05)
    assert result.at_limit == pytest.approx(np.mean(np.abs(tau) >= 0.99 * 5))
    assert detect_saturation(0, "joint1", np.cos(t), full, limits).flat == 0
    assert detect_saturation(0, "joint1", np.cos(t), full, limits).at_limit is None


def test_defects_of_signals_are_described(tmp_path: Path) -> None:
    columns = dict(recording("double-pendulum", 30.0, 100.0, 5))
    most, q = np.abs(columns["tau"]).max(axis=0) / 2, columns["q"].copy()
    q[200:300, 0] = np.nan
    columns |= {"q": q, "ddq": np.gradient(columns["dq"], 0.01, axis=0), "tau": np.clip(columns["tau"], -most, most)}
    troubled = report_on(tmp_path, PENDULUM, columns, robot(upper=np.array([0.1, 1.0])), AS_IT_IS)
    reply = " ".join(troubled.warnings)
    for words in ("100 of 3000 rows lack a value", "Positions of joint1", "exceed the robot's limits", "was clipped"):
        assert words in reply
    assert troubled.robot == "arm"
    assert troubled.noise[0].velocity == pytest.approx(0, abs=1e-3)


@pytest.mark.parametrize(("rate", "late"), [(50.0, 0.02), (50.0, -0.015), (250.0, 0.0033)])
def test_known_lag_is_found(tmp_path: Path, rate: float, late: float) -> None:
    report = report_on(tmp_path, PENDULUM, recording("double-pendulum", 30.0, rate, 3, late))
    assert [each.joint for each in report.lag] == [None, *PENDULUM]
    for each in report.lag:
        assert each.seconds == pytest.approx(late, abs=2e-3)
        assert each.std_s < 5e-3
    assert all(each.improves == list(PENDULUM) for each in report.lag[:1]) == (abs(late) > 0.01)
    reply = " ".join(report.warnings)
    assert ("not synchronised" in reply) == (abs(late) > 0.01)
    assert ("torque lags motion" in reply) == (late > 0.01)
    assert ("torque leads motion" in reply) == (late < -0.01)


def test_held_out_errors_match_fits_without_one_eighth() -> None:
    rng = np.random.default_rng(2)
    features, y, penalty = rng.standard_normal((203, 6)), rng.standard_normal((203, 2)), 7.0
    features -= features.mean(axis=0)
    lower = np.linalg.cholesky(features.T @ features + penalty * np.eye(6))
    whitened = np.linalg.solve(lower, features.T)
    fit = Fit(np.arange(203), whitened, np.eye(6), np.zeros(6), np.ones(6), 203.0)
    both = np.column_stack([np.ones(203), features])
    shrink = np.diag([0.0, *[penalty] * 6])
    parts = np.split(np.arange(203), np.linspace(0, 203, 9).astype(int)[1:-1])
    for part, errors in zip(parts, fit.held_out(y), strict=True):
        rest = np.delete(both, part, axis=0)
        weights = np.linalg.solve(rest.T @ rest + shrink, rest.T @ np.delete(y, part, axis=0))
        assert errors == pytest.approx(((y[part] - both[part] @ weights) ** 2).sum(axis=0), rel=1e-5)


def test_lag_that_shifting_does_not_correct_gives_no_warning() -> None:
    certain = {"seconds": 0.03, "std_s": 0.003, "cost": 0.05}
    timing = Timing(**dict.fromkeys(Timing.model_fields, None) | {"gaps": [], "repeated_stamps": 0, "missing_rows": 0})

    def reply(common: Lag, *joints: list[str]) -> list[str]:
        each = [Lag(joint=f"j{k}", improves=improves, **certain) for k, improves in enumerate(joints)]
        moving = Excitation(friction_beside="any motion", joints=[], standstill=0.0, whole=None, text="")
        return collect_warnings(timing, [], [], [common, *each], 1000, moving)

    def shared(*improves: str) -> Lag:
        return Lag(joint=None, improves=list(improves), **certain)

    assert reply(shared(), [], [], []) == []
    assert "not synchronised: torque lags motion by 30.0 ms" in reply(shared("j0", "j1"), ["j0"], ["j1"], [])[0]
    (alone,) = reply(Lag(joint=None, seconds=0.0, std_s=0.001), [], ["j1"], [])
    assert alone.startswith("The torque of j1 lags its motion by 30 ms")
    assert reply(shared("j1"), [], ["j1"], []) == []  # others have that lag, too
    assert reply(Lag(joint=None, seconds=0.0, std_s=0.001), ["j0"], ["j1"], []) == []


@pytest.mark.parametrize("rate", [30.0, 125.0, 1000.0])
def test_only_smoothed_torque_is_recognised_as_smoothed(rate: float) -> None:
    t = np.arange(4000) / rate
    part = np.zeros(4000, np.int64)
    signal = 10 * np.sin(0.05 * rate * t) + 3 * np.tanh(50 * np.cos(0.02 * rate * t))
    noisy = signal + 0.05 * np.random.default_rng(3).standard_normal(4000)
    smooth = sosfiltfilt(butter(2, 0.1 * rate, fs=rate, output="sos"), noisy)
    assert is_smoothed(smooth, part, white_noise(smooth, part))
    coloured = lfilter([0.4], [1, -0.6], noisy)  # one pole, as of a current sensor
    for values in (noisy, coloured, np.round(noisy, 1)):
        assert not is_smoothed(values, part, white_noise(values, part))
    exact = 10 * np.sin(0.05 * rate * t)
    assert is_smoothed(exact, part, white_noise(exact, part))


def test_unexplained_torque_and_slow_motion_have_no_lag(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    columns = recording("double-pendulum", 20.0, 100.0, 4)
    report = report_on(tmp_path, PENDULUM, columns | {"tau": rng.standard_normal(columns["tau"].shape)})
    assert all(each.seconds is None and each.reason for each in report.lag)
    assert "explains only" in (report.lag[1].reason or "")
    t = np.arange(3000) / 100
    q = np.column_stack([0.5 * np.sin(0.3 * t), 0.4 * np.sin(0.2 * t)])
    slow = report_on(tmp_path, PENDULUM, {"t": t, "q": q, "tau": 3 * q + 0.02 * rng.standard_normal(q.shape)})
    assert slow.lag[0].seconds is None
    assert "record faster motion" in (slow.lag[1].reason or "")


@pytest.mark.parametrize(("rate", "longest"), [(30.0, 10_000), (250.0, 10_000), (1000.0, 400), (5000.0, 10**6)])
def test_shifts_lie_within_a_quarter_of_a_second(rate: float, longest: int) -> None:
    steps = shifts(rate, longest)
    assert (steps == -steps[::-1]).all()
    assert len(steps) <= 130
    assert steps[-1] <= min(rate / 4, longest / 8)
    assert shifts(rate, 15) is None


LENGTHS = st.lists(st.integers(1, 40), min_size=1, max_size=12)


def parts_of(lengths: list[int]) -> np.ndarray:
    return np.repeat(np.arange(len(lengths)), lengths)


@given(LENGTHS)
def test_parts_are_numbered_by_their_breaks(lengths: list[int]) -> None:
    part = parts_of(lengths)
    assert (number_parts(len(part), [np.diff(part) != 0]) == part).all()
    starts, ends = bounds(part)
    assert (ends - starts).tolist() == lengths


@given(LENGTHS, st.integers(1, 60), st.integers(0, 6))
def test_thinned_rows_keep_their_distance_from_the_ends(lengths: list[int], most: int, margin: int) -> None:
    part = parts_of(lengths)
    rows = thin(part, most, margin)
    allowed = {row for row, k in enumerate(part) if margin <= row - (part < k).sum() < lengths[k] - margin}
    assert len(rows) == min(most, len(allowed))
    assert (np.diff(rows) > 0).all()
    assert set(rows.tolist()) <= allowed


def test_noise_is_that_of_noise_level() -> None:
    rng = np.random.default_rng(1)
    part = parts_of([200, 5, 90, 1, 300])
    values = np.sin(np.arange(len(part)) / 50) + 0.02 * rng.standard_normal(len(part))
    short = parts_of([2, 2, 2])
    for noise, of in ((white_noise, part), (noise_or_default, short)):
        episodes = [values[: len(of)][of == k][:, None] for k in np.unique(of)]
        assert noise(values[: len(of)], of) == pytest.approx(noise_level(episodes)[0], rel=1e-12)
    assert white_noise(values[:6], short) is None


@given(st.integers(1, 300), st.integers(2, 80), st.integers(0, 5))
def test_preview_keeps_the_extremes(count: int, points: int, seed: int) -> None:
    table = np.random.default_rng(seed).integers(0, 20, (count, 2)).astype(float)
    for joint, (rows, values) in enumerate(extremes(count, "q", lambda _, first, last: table[first:last], points)):
        assert len(rows) <= points
        assert (np.diff(rows) > 0).all()
        assert (table[rows, joint] == values).all()
        assert values.max() == table[:, joint].max()
        assert values.min() == table[:, joint].min()
