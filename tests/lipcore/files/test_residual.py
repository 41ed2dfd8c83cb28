"""Tests of the tensors of a local correction: they are read back, and impossible ones are refused."""

import numpy as np
import pytest

from lipcore.data.motion import Motion
from lipcore.files.residual import (
    CENTRES,
    COUNTS,
    FAST_WEIGHTS,
    ROOTS,
    TAKEN,
    VARIANCE,
    WEIGHTS,
    check_shapes,
    read_residual,
    residual_tensors,
)
from lipcore.kernels.residual import JointResidual, ResidualKernel


@pytest.fixture
def kernel() -> ResidualKernel:
    rng = np.random.default_rng(0)
    root = 0.1 * np.tril(rng.normal(size=(4, 4)))
    some = JointResidual(
        rng.uniform(1, 2, 8), rng.normal(size=(6, 8)), rng.normal(size=6), root, 2.0, 0.5, rng.normal(size=5), 0.3
    )
    return ResidualKernel([JointResidual.none(2), some])


def test_correction_is_read_back(kernel: ResidualKernel) -> None:
    motion = Motion(*np.random.default_rng(1).normal(size=(3, 5, 2)))
    tensors = residual_tensors(kernel)
    assert check_shapes({name: value.shape for name, value in tensors.items()}, 2) is None
    again = read_residual(tensors)
    assert again is not None
    for before, after in ((kernel, again), (kernel.fast, again.fast)):
        for name in ("mean", "beyond", "features"):
            np.testing.assert_array_equal(getattr(before, name)(motion), getattr(after, name)(motion))
    assert read_residual({}) is None


@pytest.mark.parametrize(
    ("name", "shape", "message"),
    [
        (CENTRES, (6, 7), "has 'residual/centres' of shape"),
        (COUNTS, (2, 2), "has 'residual/counts' of shape"),
        (WEIGHTS, (6, 1), "has 'residual/centres' of shape"),
        (ROOTS, (10, 1), "with several dimensions"),
        (FAST_WEIGHTS, (5, 1), "with several dimensions"),
        (TAKEN, (3,), "has 'residual/taken' of shape"),
        (VARIANCE, None, "lacks the tensor 'residual/variance'"),
    ],
)
def test_wrong_shape_is_named(kernel: ResidualKernel, name: str, shape: tuple[int, ...] | None, message: str) -> None:
    shapes = {each: value.shape for each, value in residual_tensors(kernel).items() if each != name}
    if shape is not None:
        shapes[name] = shape
    assert message in str(check_shapes(shapes, 2))


@pytest.mark.parametrize(
    ("counts", "variance", "message"),
    [
        ([[0, 5], [0, 4], [0, 5]], 2.0, "expected those of residual/weights"),
        ([[0, 6], [0, 7], [0, 5]], 2.0, "expected those of residual/weights"),
        ([[7, -1], [0, 0], [5, 0]], 2.0, "expected those of residual/weights"),
        ([[0, 6], [0, 4], [0, 7]], 2.0, "expected those of residual/weights and residual/fast_weights"),
        ([[0, 6], [0, 3], [0, 5]], 2.0, "expected triangles"),
        ([[0, 6], [0, 4], [0, 5]], -2.0, "a number below zero"),
        ([[0, 6], [0, 4], [0, 5]], 2.0, "expected shares from 0 to 1"),
    ],
)
def test_impossible_numbers_are_refused(kernel: ResidualKernel, counts, variance: float, message: str) -> None:
    changes = {COUNTS: np.array(counts), VARIANCE: np.array([0.0, variance]), TAKEN: np.array([0.0, 1.1])}
    with pytest.raises(ValueError, match=message):
        read_residual({**residual_tensors(kernel), **changes})
