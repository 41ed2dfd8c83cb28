"""Planned motions: what the formula says, rest at both ends, and limits that hold at every instant."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lipcore.excitation import Limits, Series
from lipcore.excitation.motions import Shape, overshoot

ROUNDING = 1e-9


def limits_of(rng: np.random.Generator, n: int) -> Limits:
    middle, half = rng.uniform(-2, 2, n), rng.uniform(0.01, 3, n)
    speed, acceleration = 10 ** rng.uniform(-2, 1.5, n), 10 ** rng.uniform(-2, 2, n)
    return Limits(
        tuple(f"j{k}" for k in range(n)), middle - half, middle + half, speed, acceleration, np.full(n, np.inf)
    )


@st.composite
def shapes(draw: st.DrawFn) -> tuple[Shape, np.ndarray]:
    """A shape of random limits, and a matrix of numbers of any size."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    limits = limits_of(rng, draw(st.integers(1, 4)))
    shape = Shape.build(limits, draw(st.floats(0.5, 100)), draw(st.integers(2, 12)))
    size = 10 ** draw(st.floats(-3, 6))
    x = size * rng.standard_normal(shape.size)
    x[rng.random(shape.size) < draw(st.floats(0, 0.9))] = 0.0
    return shape, x


@given(shapes())
def test_no_limit_is_overshot_between_instants(problem):
    shape, x = problem
    series, limits = shape.series(x), shape.limits
    # far denser than, and at other places than, whatever the code looks at
    t = (np.arange(20_000) + 0.37) / 20_000 * shape.seconds
    q, dq, ddq = series.at(t)
    room = ROUNDING * limits.half
    assert (q >= limits.lower - room).all()
    assert (q <= limits.upper + room).all()
    assert (np.abs(dq) <= limits.speed * (1 + ROUNDING)).all()
    assert (np.abs(ddq) <= limits.acceleration * (1 + ROUNDING)).all()
    used = series.used(limits)
    assert (used <= 1 + ROUNDING).all()
    peaks = np.array([np.abs(q - limits.middle).max(0), np.abs(dq).max(0), np.abs(ddq).max(0)])
    shares = peaks / np.array([limits.half, limits.speed, limits.acceleration])
    assert (shares <= used + ROUNDING).all()
    assert (used <= 1.01 * shares + ROUNDING).all()


@given(shapes())
def test_both_ends_are_at_rest_at_the_same_place(problem):
    shape, x = problem
    q, dq, ddq = shape.series(x).at(np.array([0.0, shape.seconds]))
    np.testing.assert_allclose(q[0], q[1], atol=1e-9 * (1 + np.abs(q[0]).max()))
    assert (np.abs(dq) <= 1e-9 * shape.limits.speed).all()
    assert (np.abs(ddq) <= 1e-9 * shape.limits.acceleration).all()


def test_large_numbers_use_the_limits_and_small_ones_do_not():
    shape = Shape.build(limits_of(np.random.default_rng(0), 3), 20.0, 8)
    x = np.random.default_rng(1).standard_normal(shape.size)
    assert (shape.series(100 * x).used(shape.limits).max(0) > 0.85).all()
    small = shape.series(1e-3 * x)
    np.testing.assert_allclose(small.sine * 2, shape.series(2e-3 * x).sine, rtol=1e-6)


def test_motion_of_a_shape_is_that_of_its_series():
    shape = Shape.build(limits_of(np.random.default_rng(2), 2), 7.0, 5)
    x = np.random.default_rng(3).standard_normal(shape.size)
    t = np.linspace(0, 7, 50)
    series = shape.series(x)
    found = shape.motion(torch.from_numpy(x), torch.from_numpy(t))
    # the strict bound may have shrunk the series a little more
    scale = np.abs(series.sine).sum() / np.abs(shape.coefficients(torch.from_numpy(x))[1].numpy()).sum()
    assert 0.95 < scale <= 1
    for one, other, middle in zip(found, series.at(t), (shape.limits.middle, 0.0, 0.0), strict=True):
        assert np.abs(one.numpy() - middle).max() >= np.abs(other - middle).max() * (1 - 1e-12)


def test_derivatives_of_a_series_are_those_of_its_positions():
    rng = np.random.default_rng(4)
    series = Series(3.0, rng.standard_normal(2), *rng.standard_normal((2, 6, 2)))
    t, h = np.linspace(0.1, 2.9, 40), 1e-5
    _, dq, ddq = series.at(t)
    before, after = series.at(t - h), series.at(t + h)
    np.testing.assert_allclose(dq, (after[0] - before[0]) / (2 * h), atol=1e-6)
    np.testing.assert_allclose(ddq, (after[1] - before[1]) / (2 * h), atol=1e-5)
    one = Series(2.0, np.array([0.5]), np.array([[0.0], [3.0]]), np.array([[1.0], [0.0]]))
    # by hand: q = 0.5 + 3 sin(2 π t) / (2 π) − cos(π t) / π
    np.testing.assert_allclose(
        one.at(t)[0][:, 0], 0.5 + 3 * np.sin(2 * np.pi * t) / (2 * np.pi) - np.cos(np.pi * t) / np.pi, atol=1e-14
    )


def test_a_polynomial_that_reaches_the_bound_of_ehlich_and_zeller():
    # cos(K t − π K / m) has its largest magnitudes just between m even instants
    for harmonics, instants in ((3, 12), (5, 40)):
        t = 2 * np.pi * np.arange(instants) / instants
        seen = np.abs(np.cos(harmonics * t + np.pi * harmonics / instants)).max()
        assert overshoot(harmonics, instants) * seen == pytest.approx(1.0, rel=1e-12)


def test_unknown_limits_have_usual_ones_standing_in():
    nan = np.array([np.nan, np.nan])
    found = Limits.known(("a", "b"), ("revolute", "prismatic"), nan, nan, np.array([2.0, np.inf]), nan, np.zeros(2))
    np.testing.assert_allclose(found.upper, [np.pi, 0.5])
    np.testing.assert_allclose(found.speed, [2.0, 0.2])
    np.testing.assert_allclose(found.acceleration, [8.0, 0.8])
    assert np.isinf(found.torque).all()


def test_a_share_of_limits():
    limits = limits_of(np.random.default_rng(5), 2)
    found = limits.within(0.5, 0.25)
    np.testing.assert_allclose(found.middle, limits.middle)
    np.testing.assert_allclose(found.half, limits.half / 2)
    np.testing.assert_allclose(found.acceleration, limits.acceleration / 4)
    np.testing.assert_allclose(limits.within(reach=0.005).half, 0.005)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda limits: limits.within(0.0), "share of position is 0.0, expected a number above 0"),
        (lambda limits: limits.within(1.0, 1.2), "share of motion is 1.2"),
        (lambda limits: limits.within(reach=-1.0), "reach is -1.0"),
        (lambda limits: Shape.build(limits, 1.0, 1), "harmonics is 1, expected at least 2"),
        (lambda limits: Limits(("a",), *(np.ones(1) for _ in range(5))), "joint 'a' may move from 1.0 to 1.0"),
        (lambda limits: Limits(("a",), *(np.ones(2) for _ in range(5))), "lower has shape"),
        (lambda limits: Limits(("a",), -np.ones(1), np.ones(1), -np.ones(1), np.ones(1), np.ones(1)), "speed is"),
    ],
)
def test_impossible_limits_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        change(limits_of(np.random.default_rng(6), 2))
