"""Tests of rows of a live stream: derived accelerations, and gates that reject invalid rows."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from lipcore.online.acceleration import RateError, derive, rate_of, window
from lipcore.online.gates import MAX_TORQUE, Patience, RowLimits, check_rows, is_contact, time_span
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Simulation, inverse_dynamics, simulate
from lipcore.vocabulary import CODES

LIMITS = RowLimits(12.6, 50.0, 2000.0, None, 1.0, 1e-3)
PANDA_TORQUE = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0])
N = 8
PANDA = load_robot("panda")


def batch(rows: int = N) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    motion = {name: rng.uniform(0.1, 1.0, (rows, 2)) for name in ("q", "dq", "ddq", "tau")}
    return {"t": 100.0 + np.arange(rows) / 10, **motion}


def names(codes: np.ndarray) -> list[str]:
    return [CODES[code] for code in codes]


def rejected_for_time(t: list[float], **bounds: float) -> list[int]:
    """Return the places of rows rejected for their time, and check that nothing else is rejected."""
    codes = names(check_rows(**batch(len(t)) | {"t": np.array(t)}, limits=LIMITS, **bounds))
    assert set(codes) <= {"learnt", "time_jump"}
    return [place for place, code in enumerate(codes) if code == "time_jump"]


@pytest.mark.parametrize(("field", "maximum"), [("q", 12.6), ("dq", 50.0), ("ddq", 2000.0), ("tau", MAX_TORQUE)])
def test_magnitude_beyond_its_limit_rejects_the_row(field: str, maximum: float) -> None:
    data = batch()
    data[field][2, 1], data[field][5, 0], data[field][6, 1] = -np.nextafter(maximum, np.inf), maximum, 1e300
    codes = names(check_rows(**data, limits=LIMITS))
    assert [place for place, code in enumerate(codes) if code == "limit"] == [2, 6]
    assert set(codes) == {"learnt", "limit"}


def test_panda_motion_is_learnt_unless_saturated() -> None:
    samples = simulate(PANDA, Simulation(n_samples=500, rate=50, speed=5, noise=0.05), seed=0)
    q, dq, ddq, tau = samples.q, samples.dq, samples.ddq, samples.tau
    for t, second in ((samples.t, ddq), (None, ddq), (samples.t, None)):
        codes = check_rows(t, q, dq, second, tau, replace(LIMITS, torque=PANDA_TORQUE))
        assert codes.dtype == np.uint8
        assert set(names(codes)) == {"learnt"}
    # a weaker drive than the motion needs
    strongest = 0.9 * np.abs(tau).max(axis=0)
    cut_off, below = (np.abs(tau) >= strongest).any(axis=1), (np.abs(tau) < 0.96 * strongest).all(axis=1)
    limits = replace(LIMITS, torque=strongest)
    codes = np.array(names(check_rows(samples.t, q, dq, ddq, np.clip(tau, -strongest, strongest), limits)))
    assert set(codes[cut_off]) == {"saturation"}
    assert set(codes[below]) == {"learnt"}


def test_robot_at_rest_is_not_learnt() -> None:
    q = np.tile((PANDA.lower + PANDA.upper) / 2, (20, 1))
    still = np.zeros_like(q)
    tau = inverse_dynamics(PANDA, q, still, still)
    dq = 5e-4 * np.random.default_rng(0).uniform(-1, 1, q.shape)
    assert set(names(check_rows(None, q, dq, still, tau, LIMITS))) == {"stationary"}
    assert set(names(check_rows(None, q, dq, still, tau, replace(LIMITS, stationary_speed=0.0)))) == {"learnt"}
    dq[:, 6] = 2e-3
    assert set(names(check_rows(None, q, dq, still, tau, LIMITS))) == {"learnt"}


def test_first_applicable_code_is_returned() -> None:
    data, limits = batch(), replace(LIMITS, torque=np.array([1.0, 1.0]))
    data["dq"][:] = 0.0  # all are stationary
    data["tau"][:4, 0] = 0.99  # and saturated
    data["t"][:3] = 0.0  # and out of time
    data["q"][:2, 0] = 99.0  # and beyond a limit
    data["ddq"][0, 1] = np.nan  # and not finite
    codes = names(check_rows(**data, limits=limits, after=50.0))
    assert codes[:4] == ["non_finite", "limit", "time_jump", "saturation"]
    assert codes[4:] == ["stationary"] * 4


@given(
    honest=st.lists(st.integers(0, 1000), min_size=1, max_size=30, unique=True).map(sorted),
    wrong=st.lists(st.tuples(st.integers(0, 30), st.integers(-2000, 2000)), max_size=5),
)
@settings(deadline=None)
def test_kept_times_increase_with_minimal_loss(honest: list[int], wrong: list[tuple[int, int]]) -> None:
    t = [float(each) for each in honest]
    for place, value in wrong:
        t[min(place, len(t) - 1)] = float(value)
    rejected = rejected_for_time(t)
    assert (np.diff(np.delete(t, rejected)) > 0).all()
    assert len(rejected) <= len(wrong)


def test_times_outside_their_bounds_are_rejected() -> None:
    assert rejected_for_time([1.0, 2.0, 2.0, 3.0]) == [2]
    assert rejected_for_time([1.0, 5.0, 2.0, 3.0, 4.0]) == [1]  # the one, not the three after it
    assert rejected_for_time([1.0, 2.0, 3.0, 4.0], after=2.0) == [0, 1]
    assert rejected_for_time([1.0, 2.0, 3.0, 4.0], before=3.0) == [2, 3]
    assert rejected_for_time([4.0, 5.0, 1e12], before=60.0) == [2]  # a jump into the future
    for pause in ([1.0, 1.1, 1.2, 5.0, 5.1], [-1e308, 1e308]):
        assert rejected_for_time(pause) == []


def reject_batches(batches: list[list[float]]) -> list[list[int]]:
    """Return the rejected rows of each batch, each checked against the span of the previous one."""
    rejected, after = [], None
    for t in batches:
        codes = check_rows(**batch(len(t)) | {"t": np.array(t)}, limits=LIMITS, after=after)
        rejected.append([place for place, code in enumerate(names(codes)) if code == "time_jump"])
        span = time_span(np.array(t), codes)
        after = span[1] if span else after
    return rejected


def test_wrong_clock_costs_at_most_one_batch() -> None:
    assert reject_batches([[1, 2, 3], [4, 5, 0], [6, 7, 8]]) == [[], [2], []]
    assert reject_batches([[1, 2, 3], [4, 5, 1e12], [6, 7, 8], [9, 10, 11]]) == [[], [], [0, 1, 2], []]
    assert reject_batches([[101, 102, 103], [1, 2, 3], [4, 5, 6]]) == [[], [0, 1, 2], []]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"q": np.zeros(N)}, r"q has shape \(8,\), expected \(N, n\)"),
        ({"dq": np.zeros((N, 3))}, r"dq has shape \(8, 3\), expected \(8, 2\), the shape of q"),
        ({"ddq": np.zeros((7, 2))}, "ddq has shape"),
        ({"tau": np.zeros((N, 1))}, "tau has shape"),
        ({"t": np.zeros(7)}, r"t has shape \(7,\), expected \(8,\)"),
        ({"limits": replace(LIMITS, torque=np.ones(3))}, r"limits.torque has shape \(3,\), expected \(2,\)"),
    ],
    ids=str,
)
def test_mismatched_shapes_are_named(change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        check_rows(**{**batch(), "limits": LIMITS} | change)


def test_contact_is_a_joint_far_outside_its_interval() -> None:
    mean, std, noise = np.zeros((4, 2)), np.full((4, 2), 3.0), np.array([4.0, 4.0])  # 5 together
    tau = np.array([[39.9, 0.0], [40.1, 0.0], [0.0, -40.1], [0.0, 0.0]])
    assert is_contact(tau, mean, std, noise, 8.0).tolist() == [False, True, True, False]


def exhaustion_time(time: np.ndarray, contact: np.ndarray, rows: int = 10) -> float | None:
    """Return when two seconds of patience were exhausted, in batches of `rows`."""
    patience = Patience(2.0)
    for k in range(0, len(time), rows):
        patience = patience.step(time[k : k + rows], contact[k : k + rows])
        if patience.exhausted:
            return float(time[min(k + rows, len(time)) - 1])
    return None


def test_patience_is_exhausted_by_lasting_contact() -> None:
    time = np.arange(0, 600, 0.02)
    for passing in (np.arange(len(time)) % 100 == 0, time % 60 < 0.5, time % 60 < 1.5, time % 0.1 < 0.04):
        assert exhaustion_time(time, passing) is None
    at = exhaustion_time(time, time >= 4.0, rows=1)
    assert at is not None
    assert 6.0 <= at < 6.2
    pause = np.concatenate([time[:25], 60 + time[:25]])  # a pause is not time in contact
    assert exhaustion_time(pause, np.ones(50, dtype=bool)) is None
    slow = 5.0 * np.arange(11)  # sparse rows need ten of them
    assert exhaustion_time(slow[:10], np.ones(10, dtype=bool)) is None
    assert exhaustion_time(slow, np.ones(11, dtype=bool), rows=11) == 50.0
    spent = Patience(1.0).step(time[:100], np.ones(100, dtype=bool))
    assert spent.step(time[100:], np.zeros(len(time) - 100, dtype=bool)).exhausted
    assert Patience(1.0).step(time[5::-1], np.ones(6, dtype=bool)).elapsed == 0.0  # backward time uses none


@given(
    seed=st.integers(0, 10_000),
    share=st.sampled_from([0.3, 0.55, 0.9]),
    rate=st.sampled_from([5.0, 50.0, 500.0]),
    cuts=st.lists(st.integers(0, 300), max_size=5),
)
@settings(deadline=None)
def test_patience_does_not_depend_on_batches(seed: int, share: float, rate: float, cuts: list[int]) -> None:
    time, contact = np.arange(300) / rate, np.random.default_rng(seed).random(300) < share
    whole, parts = Patience(1.0).step(time, contact), Patience(1.0)
    for a, b in zip([0, *sorted(cuts)], [*sorted(cuts), 300], strict=True):
        parts = parts.step(time[a:b], contact[a:b])
    assert parts == whole


EPOCH = 1.8e9
"""Unix time, whose floats have a resolution of 2.4e-7 s."""


def gain(frequency: float, rate: float) -> complex:
    """Return derived over true acceleration of a sinusoid, from whole periods."""
    half = window(rate)
    t = np.arange(round(10 * rate) + 2 * half) / rate
    derived = derive(t, np.sin(2 * np.pi * frequency * t)[:, None], half)
    wave = np.exp(-2j * np.pi * frequency * t[half:-half])
    return complex(2 * np.mean(derived.ddq[:, 0] * wave) / (2 * np.pi * frequency))


# 3 (sin x − x cos x)/x³ at T = 0.04 s, worked out by hand; the sum over few samples differs by less than 0.02
@pytest.mark.parametrize(("frequency", "expected"), [(1.0, 0.994), (2.0, 0.975), (4.0, 0.903), (9.9, 0.5)])
def test_gain_matches_theory_without_phase_shift(frequency: float, expected: float) -> None:
    assert abs(gain(frequency, 1000.0) - expected) < 0.01
    assert abs(np.angle(gain(frequency, 100.0))) < 1e-9


def test_noise_matches_theory() -> None:
    rng = np.random.default_rng(2)
    for rate, stated in ((1000.0, 4.8), (100.0, 13.0), (50.0, 16.0)):
        t = np.arange(20_000) / rate
        derived = derive(t, rng.standard_normal((20_000, 1)), window(rate))
        assert derived.ddq.std() == pytest.approx(stated, rel=0.05)


@given(
    coefficients=st.tuples(*[st.floats(-10, 10)] * 3),
    half=st.integers(1, 6),
    extra=st.integers(-1, 5),
    rate=st.integers(50, 1000),
)
@example(coefficients=(1.0, 1.0, 1.0), half=4, extra=-1, rate=100)
@settings(deadline=None)
def test_derivative_is_exact_on_quadratics_with_stated_delay(coefficients, half, extra, rate) -> None:
    a, b, c = coefficients
    t = np.arange(2 * half + 1 + extra) / rate
    derived = derive(t, (a + b * t + c * t**2)[:, None], half)
    assert derived.first == half
    assert derived.delay_s == pytest.approx(half / rate)
    assert derived.ddq.shape == (1 + extra, 1)
    assert np.allclose(derived.ddq[:, 0], (b + 2 * c * t)[half : half + 1 + extra], rtol=0, atol=1e-8)


@given(cut=st.integers(5, 55), half=st.integers(1, 4))
@settings(deadline=None)
def test_overlapping_batches_equal_the_whole(cut: int, half: int) -> None:
    t, dq = np.arange(60) / 100.0, np.random.default_rng(cut).standard_normal((60, 2))
    whole = derive(t, dq, half).ddq
    cut = max(cut, 2 * half + 1)
    first = derive(t[:cut], dq[:cut], half)
    second = derive(t[cut - 2 * half :], dq[cut - 2 * half :], half)
    assert np.allclose(np.concatenate([first.ddq, second.ddq]), whole, rtol=0, atol=1e-9)


@pytest.mark.parametrize("rate", [50.0, 100.0, 333.0, 1000.0])
def test_rate_is_found_from_jittered_times(rate: float) -> None:
    t = EPOCH + (np.arange(200) + np.random.default_rng(4).uniform(-0.09, 0.09, 200)) / rate
    assert rate_of(t) == pytest.approx(rate, rel=2e-3)


@pytest.mark.parametrize(
    ("t", "message"),
    [
        (np.delete(np.arange(20) / 100, 7), r"t\[7\] is 0.02 s after the time before it, expected steps of 0.01 s"),
        (np.zeros(5), "t has a median step of 0 s"),
        (np.zeros(1), "t has 1 times"),
        (np.arange(9) / 47.0, "the rate is 47 Hz, expected at least 50 Hz"),
    ],
)
def test_times_without_a_rate_are_rejected(t: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        rate_of(t)
    with pytest.raises(RateError, match="the rate is 10 Hz, expected at least 50 Hz"):
        window(10.0)


@pytest.mark.parametrize(
    ("shape", "half", "message"),
    [((9, 2), 0, "half is 0"), ((8, 2), 2, r"dq has shape \(8, 2\)"), ((9,), 2, r"dq has shape \(9,\)")],
)
def test_invalid_derivation_is_named(shape: tuple[int, ...], half: int, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        derive(np.arange(9) / 100.0, np.zeros(shape), half)
