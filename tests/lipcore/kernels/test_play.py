"""Tests of play elements: their deflections along a motion, and given one instant of it."""

from dataclasses import replace

import numpy as np
import pytest

from lipcore.data.motion import Array
from lipcore.data.samples import Samples
from lipcore.kernels.drive.play import (
    ELEMENTS,
    MAX_GAP_S,
    PRISMATIC_SCALE,
    PlayState,
    deflections_at,
    element_widths,
    with_deflections,
)

TYPES = ("revolute", "prismatic")
WIDTHS = element_widths(TYPES)
COUNT = len(ELEMENTS)
STEP_S = 0.01


def random_motion(size: int, seed: int = 0) -> tuple[Array, Array, Array]:
    """Return t, q and dq of joints that turn back at all scales of the elements."""
    rng, t = np.random.default_rng(seed), STEP_S * np.arange(size)
    omega, phase = rng.uniform(0.5, 12, (2, 6)), rng.uniform(0, 6, (2, 6))
    height = np.array([0.5, 0.5 * PRISMATIC_SCALE])[:, None] * rng.uniform(0, 1, (2, 6)) / omega
    angle = t[:, None, None] * omega + phase
    return t, (height * np.sin(angle)).sum(axis=2), (height * omega * np.cos(angle)).sum(axis=2)


def deflect_slowly(q: Array, width: float, start: float) -> Array:
    """Return the deflection of one element along positions, (N,), by the position z of its slider."""
    z, out = q[0] - start * width, []
    for each in q:
        z = min(max(z, each - width), each + width)
        out.append((each - z) / width)
    return np.array(out)


@pytest.mark.parametrize("start", [None, -1.0, 0.3, 1.0])
def test_deflections_follow_the_motion(start: float | None) -> None:
    """Without a known start, the deflection lies between two that begin at both ends."""
    t, q, dq = random_motion(800)
    state = PlayState.unknown(2)
    if start is not None:
        state = PlayState.at(t[0], q[0], dq[0], np.repeat([[start, start], [0.0, 0.0]], COUNT, axis=0))
    found, after = state.follow(t, q, dq, WIDTHS)
    for k in range(COUNT):
        for j in range(2):
            starts = (-1.0, 1.0) if start is None else (start, start)
            low, high = (deflect_slowly(q[:, j], WIDTHS[k, j], each) for each in starts)
            np.testing.assert_allclose(found[:, k, j], 0.5 * (low + high), atol=1e-9)
            np.testing.assert_allclose(found[:, COUNT + k, j], 0.5 * (high - low), atol=1e-9)
            np.testing.assert_allclose(after.packed[5:].reshape(COUNT, 2, 2)[k, j], (low[-1], high[-1]), atol=1e-9)
    assert np.array_equal(after.packed[:5], [t[-1], *q[-1], *dq[-1]])


def test_parts_are_followed_like_the_whole() -> None:
    t, q, dq = random_motion(300)
    whole, end = PlayState.unknown(2).follow(t, q, dq, WIDTHS)
    state, parts = PlayState.unknown(2), []
    for part in (slice(0, 1), slice(1, 1), slice(1, 120), slice(120, 300)):
        found, state = state.follow(t[part], q[part], dq[part], WIDTHS)
        parts.append(found)
    assert np.array_equal(np.concatenate(parts), whole)
    assert np.array_equal(state.packed, end.packed)


def test_deflections_are_known_after_a_stroke_of_two_widths() -> None:
    width = WIDTHS[2, 0]
    stroke = width * np.array([0.0, 0.5, 1.0, 1.9, 2.0, 2.1])
    t, still = STEP_S * np.arange(len(stroke)), np.zeros((len(stroke), 2))
    for sign in (1.0, -1.0):
        q = sign * stroke[:, None] * np.ones(2)
        found = PlayState.unknown(2).follow(t, q, still, WIDTHS)[0][:, [2, COUNT + 2], 0]
        np.testing.assert_allclose(found[:, 0], sign * np.array([0, 0.25, 0.5, 0.95, 1, 1]), atol=1e-9)
        np.testing.assert_allclose(found[:, 1], [1, 0.75, 0.5, 0.05, 0, 0], atol=1e-9)


@pytest.mark.parametrize(
    ("change", "unknown"),
    [
        ("nothing", False),
        ("short gap", False),
        ("long gap", True),
        ("time that runs back", True),
        ("jump", True),
        ("fast motion", False),
        ("new episode", True),
    ],
)
def test_deflections_are_unknown_after_unknown_motion(change: str, unknown: bool) -> None:
    t, q, dq = random_motion(400)
    begins = np.zeros(400, np.bool_)
    if "gap" in change or "back" in change:
        t[200:] += {"short gap": 0.9 * MAX_GAP_S, "long gap": 1.1 * MAX_GAP_S}.get(change, -1.0)
        dq[:] = 0.0  # the joints move less than a width in the gap
    elif change in ("jump", "fast motion"):
        q[200:, 0] += 0.2
        dq[199:201, 0] += 0.2 / STEP_S if change == "fast motion" else 0.0
    begins[200] = change == "new episode"
    found = PlayState.unknown(2).follow(t, q, dq, WIDTHS, begins)[0]
    assert (found[199, COUNT:] == 0).all()
    if unknown:
        assert (found[200, :COUNT] == 0).all()
        assert (found[200, COUNT:] == 1).all()
    else:
        assert (found[200, COUNT:] == 0).all()


def test_each_episode_of_samples_begins_unknown() -> None:
    t, q, dq = random_motion(400)
    episode = np.repeat([4, 2, 4], [100, 150, 150])  # contiguous in time
    samples = Samples(("a", "b"), t, episode, q, dq, 0 * dq, 0 * dq)
    found = with_deflections(samples, TYPES).deflections
    assert found is not None
    for part in samples.episodes():
        alone = PlayState.unknown(2).follow(t[part], q[part], dq[part], WIDTHS)[0]
        assert np.array_equal(found[part], alone)
        assert (alone[0, COUNT:] == 1).all()
    nothing = with_deflections(samples.rows(slice(0, 0)), TYPES).deflections
    assert nothing is not None
    assert nothing.shape == (0, 2 * COUNT, 2)


def test_one_instant_has_the_deflection_of_a_reversal_at_constant_acceleration() -> None:
    acceleration = np.array([2.0, -0.3])
    t = np.linspace(-0.8, 0.8, 1601)
    dq = t[:, None] * acceleration
    q = 0.5 * t[:, None] ** 2 * acceleration
    followed = PlayState.unknown(2).follow(t, q, dq, WIDTHS)[0][:, :COUNT]
    # of an acceleration far beyond the usual one
    found = deflections_at(dq, np.broadcast_to(acceleration, dq.shape), WIDTHS, np.full(2, 1e-6))[:, :COUNT]
    known = np.abs(q[0] - q) > 2 * WIDTHS.max(axis=0)  # the stroke before it is long enough
    known[t > 0] = True
    for j in range(2):
        np.testing.assert_allclose(found[known[:, j], :, j], followed[known[:, j], :, j], atol=1e-6)
    assert (np.abs(found) < 0.9).any()


def test_deflection_of_one_instant_is_continuous_and_odd() -> None:
    rng, size = np.random.default_rng(1), 2000
    dq, ddq = rng.uniform(-1, 1, (2, size, 2)) * 10.0 ** rng.uniform(-4, 0, (2, size, 1))
    dq[:200], ddq[100:300] = 0.0, 0.0
    usual = np.array([1.5, 0.4])
    at = deflections_at(dq, ddq, WIDTHS, usual)
    expected, std = at[:, :COUNT], at[:, COUNT:]
    assert (np.abs(expected) <= 1).all()
    assert ((std >= 0) & (std <= 1)).all()
    assert (std[:200] == 1).all()
    other = deflections_at(-dq, -ddq, WIDTHS, usual)
    np.testing.assert_allclose(other[:, :COUNT], -expected, atol=1e-12)
    np.testing.assert_allclose(other[:, COUNT:], std, atol=1e-12)
    step = 1e-9 * rng.uniform(-1, 1, (2, size, 2))
    near = deflections_at(dq + step[0], ddq + step[1], WIDTHS, usual)
    assert np.abs(near - at).max() < 1e-3


def test_prismatic_elements_are_narrower() -> None:
    np.testing.assert_allclose(WIDTHS[:, 1], PRISMATIC_SCALE * WIDTHS[:, 0])
    assert element_widths(("revolute",)).shape == (COUNT, 1)


def test_deflections_of_other_samples_are_rejected() -> None:
    t, q, dq = random_motion(10)
    samples = with_deflections(Samples(("a", "b"), t, np.zeros(10, np.int64), q, dq, dq, dq), TYPES)
    assert samples.deflections is not None
    with pytest.raises(ValueError, match=r"deflections have shape \(9, 10, 2\), expected \(10, 2\) around elements"):
        replace(samples, deflections=samples.deflections[1:])
