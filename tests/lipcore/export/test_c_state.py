"""Tests of exported C that follows friction with a memory of the motion."""

import ctypes
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from lipcore import TorqueModel, load
from lipcore.export.c_writer import c_files
from lipcore.kernels.drive.play import ELEMENTS, MAX_GAP_S, PlayState, element_widths
from tests.choosing import few
from tests.lipcore.export.compiled import (
    c_array,
    compile_library,
    needs_compiler,
)
from tests.lipcore.export.models import (
    MODELS,
    ORIGIN,
    PANDA,
    draw_motions,
)


class CompiledState:
    """A state in a compiled library, and the torque that follows from it."""

    def __init__(self, path: Path, n: int) -> None:
        size = ctypes.c_double * (n * (2 * len(ELEMENTS) + 2))
        self._library = ctypes.CDLL(str(path))
        self._state = type("State", (ctypes.Structure,), {"_fields_": [("numbers", size), ("known", ctypes.c_int)]})()
        self._library.lipserve_start(ctypes.byref(self._state))

    @property
    def numbers(self) -> list[float]:
        return list(self._state.numbers)

    def update(self, q: np.ndarray, dq: np.ndarray, dt: float) -> None:
        self._library.lipserve_update(ctypes.byref(self._state), c_array(q), c_array(dq), ctypes.c_double(dt))

    def evaluate(self, motion: np.ndarray, is_used: bool = True) -> np.ndarray:
        """Return mean and standard deviation of a query, (2, n), and check the mean alone. motion: (3, n)."""
        query, state = [c_array(row) for row in motion], ctypes.byref(self._state) if is_used else None
        alone, out = np.empty_like(motion[0]), np.empty_like(motion[:2])
        self._library.lipserve_torque_state(*query, None, state, *map(c_array, out))
        self._library.lipserve_torque_state(*query, None, state, c_array(alone), None)
        np.testing.assert_array_equal(alone, out[0])
        return out


def turning_motion(model: TorqueModel, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return times (N,) and motions (3, N, n) with turns, stops, gaps, steps and a clock that is set back."""
    rng, n = np.random.default_rng(3), model.n_joints
    dt = rng.uniform(0.001, 0.02, count)
    dt[[50, 90, 130, 170]] = 1.01 * MAX_GAP_S, 0.99 * MAX_GAP_S, -0.1, 0.0
    time = np.cumsum(dt)
    dq = 0.3 * np.sin(np.cumsum(rng.uniform(0.0, 0.3, (count, n)), axis=0)) * (rng.random((count, n)) < 0.7)
    moved = 0.5 * (dq[1:] + dq[:-1]) * dt[1:, None] + 1e-4 * rng.standard_normal((count - 1, n))
    moved[[29, 69], n - 1] += 1.01 * element_widths(model.joint_types)[-1, -1], 0.9 * ELEMENTS[0]
    q = np.concatenate([np.zeros((1, n)), moved]).cumsum(axis=0)
    return time, np.stack([q, dq, 10 * rng.standard_normal((count, n))])


PLAY_MODELS = ("friction of all kinds, alternatives", "friction of all kinds", "play, from its tip")


@needs_compiler
@pytest.mark.parametrize("name", few(PLAY_MODELS, kept=lambda name: name == PLAY_MODELS[0]))
def test_state_follows_the_motion(name: str, tmp_path: Path) -> None:
    model = MODELS[name]()
    state = CompiledState(compile_library(c_files(model, ORIGIN), tmp_path), model.n_joints)
    time, motion = turning_motion(model, 400)
    widths = element_widths(model.joint_types)
    deflections, _ = PlayState.unknown(model.n_joints).follow(time, *motion[:2], widths)
    followed = np.empty((2, *motion.shape[1:]))
    for k, dt in enumerate(np.diff(time, prepend=time[0])):
        state.update(*motion[:2, k], dt)
        followed[:, k] = state.evaluate(np.ascontiguousarray(motion[:, k]))
    expected, tau_std, *_ = model.evaluator.many(*motion, deflections=deflections)
    np.testing.assert_allclose(followed[0], expected, rtol=1e-9, atol=1e-12 * np.abs(expected).max())
    np.testing.assert_allclose(followed[1], tau_std, rtol=1e-9)
    unaware, wider, *_ = model.evaluator.many(*motion)
    assert (np.abs(unaware - expected) > 1e-3).any()
    assert (wider > 1.1 * tau_std).any()


@needs_compiler
def test_state_is_unknown_after_a_number_that_is_not_finite(tmp_path: Path) -> None:
    model = MODELS["play, from its tip"]()
    state = CompiledState(compile_library(c_files(model, ORIGIN), tmp_path), 2)
    query = np.array([[0.1, 0.2], [1e-3, -1e-3], [0.0, 0.0]])
    without = state.evaluate(query, is_used=False)
    np.testing.assert_array_equal(state.evaluate(query), without)
    state.update(query[0], query[1], 0.001)
    first = state.evaluate(query)
    np.testing.assert_array_equal(first, without)  # the instant alone is more certain
    for place, wrong in product((0, 1), (np.nan, np.inf)):
        state.update(query[0] + 0.05, query[1], 0.001)
        assert (state.evaluate(query)[1] < first[1]).all()
        broken = query[:2].copy()
        broken[place, 1] = wrong
        state.update(*broken, 0.001)
        np.testing.assert_array_equal(state.evaluate(query), without)
        state.update(query[0], query[1], 0.001)
        np.testing.assert_array_equal(state.evaluate(query), first)


@needs_compiler
def test_models_without_play_ignore_the_state(tmp_path: Path) -> None:
    model = load(PANDA)
    state = CompiledState(compile_library(c_files(model, ORIGIN), tmp_path), 7)
    query = np.ascontiguousarray(draw_motions(model, 1, 1)[:, 0])
    for step in (0.0, 0.01):
        state.update(query[0] + step, query[1], 0.001)
        np.testing.assert_array_equal(state.evaluate(query), state.evaluate(query, is_used=False))
    assert not any(state.numbers)
