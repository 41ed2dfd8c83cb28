"""Compiled cross covariances of the energy kernels, as a control loop asks for them."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import numpy as np
import pytest
import torch

from lipcore.data.motion import Motion
from lipcore.kernels.compiled.lanes import LANES
from tests.lipcore.oracles import instant, scale_of, torque_terms
from tests.lipcore.problems import KERNELS, Problem, random_problem

RELATIVE = 1e-10
ROBOTS = [
    ("revolute",),
    ("prismatic",),
    ("prismatic", "revolute", "revolute"),
    ("revolute",) * 7,
    ("revolute", "prismatic", "revolute", "revolute", "prismatic", "revolute", "revolute", "revolute"),
]

kernels = pytest.mark.parametrize("kernel", KERNELS)
robots = pytest.mark.parametrize("joint_types", ROBOTS, ids=lambda kinds: "".join(kind[0] for kind in kinds))


def queries(motion: Motion) -> np.ndarray:
    """As `Cross` takes them: (N, 3, n)."""
    return np.ascontiguousarray(torch.stack([motion.q, motion.dq, motion.ddq], dim=1).numpy())


def crossed(problem: Problem, size: int) -> np.ndarray:
    """Covariances of the first `size` samples, the inducing ones, with all others: (N, size + 1, n, n)."""
    asked, n = queries(problem.motion[size:]), problem.kernel.n_joints
    out = np.full((len(asked), size + 1, n, n), np.nan)  # where anything left out would show
    problem.kernel.cross(problem.params, problem.motion[:size]).fill_many(asked, out)
    return out


@robots
@kernels
# part of a block of columns, with and without room for the query, exactly one, and several
@pytest.mark.parametrize("size", [1, LANES - 1, LANES, 2 * LANES - 1, 8 * LANES + 5])
def test_cross_equals_the_gram_matrix(kernel: str, joint_types: tuple[str, ...], size: int) -> None:
    problem, n = random_problem(joint_types, size + 3, seed=size, kernel=kernel), len(joint_types)
    found, asked = crossed(problem, size), problem.motion[size:]
    gram = problem.kernel.gram(problem.params, problem.motion[:size], asked).numpy()
    expected = gram.reshape(size, n, 3, n).transpose(2, 0, 1, 3)
    np.testing.assert_allclose(found[:, :size], expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    prior = problem.kernel.variance(problem.params, asked).numpy()
    np.testing.assert_allclose(found[:, size], prior, rtol=0, atol=1e-12 * np.abs(prior).max())
    assert np.array_equal(found[:, size], found[:, size].transpose(0, 2, 1))


@kernels
@pytest.mark.parametrize("joint_types", [("revolute", "prismatic", "revolute"), ("prismatic", "revolute")])
def test_cross_equals_the_energies_differentiated_by_machine(kernel: str, joint_types: tuple[str, ...]) -> None:
    size = 3
    problem = random_problem(joint_types, size + 1, seed=5, kernel=kernel)
    found, energies = crossed(problem, size)[0], problem.energies()
    query = instant(problem.motion, size)
    for sample in range(size + 1):  # the last one is the query itself
        anchor = instant(problem.motion, sample)
        terms = torque_terms(energies, anchor, query)
        error = np.abs(found[sample] - terms.sum(0).numpy()).max()
        assert error < RELATIVE * scale_of(energies, anchor, query, terms)


@kernels
def test_one_query_at_a_time_in_many_threads_gives_the_same_bits(kernel: str) -> None:
    size, threads = 20, 4
    problem = random_problem(("revolute",) * 5, size + 40, seed=1, kernel=kernel)
    expected, asked = crossed(problem, size), queries(problem.motion[size:])
    kept = asked.copy()
    cross, start = problem.kernel.cross(problem.params, problem.motion[:size]), Barrier(threads)

    def work(_: int) -> np.ndarray:
        start.wait(timeout=60)
        out = np.full_like(expected, np.nan)
        for query, target in zip(asked, out, strict=True):
            cross.fill(query, target)
        return out

    with ThreadPoolExecutor(threads) as pool:
        for found in pool.map(work, range(threads)):
            assert np.array_equal(found, expected)
    assert np.array_equal(asked, kept)
