"""From blocks to Gram matrices: order of rows, symmetry, chunks, sums; and the kernel of friction."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given

from lipcore.data.motion import Motion
from lipcore.kernels.base import PAIRS_PER_CHUNK, SumKernel, row_chunks
from lipcore.kernels.friction import SIGN_WIDTH, STRIBECK_SPEED, FrictionKernel, friction_features
from lipcore.kernels.lip import LipKernel
from tests.lipcore.oracles import KERNELS, Problem, problems, random_problem

JOINTS = ("revolute", "prismatic", "revolute")


@given(problems(samples=6))
def test_gram_is_symmetric_and_positive_semidefinite(problem: Problem) -> None:
    gram = problem.kernel.gram(problem.params, problem.motion, problem.motion)
    symmetric = problem.kernel.symmetric_gram(problem.params, problem.motion)
    assert torch.equal(symmetric, symmetric.T)
    assert (symmetric - gram).abs().max() <= 1e-13 * gram.abs().max()
    values = torch.linalg.eigvalsh(0.5 * (gram + gram.T))
    assert values[0] >= -1e-10 * values[-1]


def test_chunks_cover_all_rows_once_and_stay_small() -> None:
    for rows, columns in ((1, 1), (1000, 10), (10, 100_000), (129, 64)):
        chunks = list(row_chunks(rows, columns))
        assert [row for chunk in chunks for row in range(chunk.start, chunk.stop)] == list(range(rows))
        assert all((c.stop - c.start) * columns <= max(PAIRS_PER_CHUNK, columns) for c in chunks)


@pytest.mark.parametrize("name", KERNELS)
def test_variance_is_the_diagonal_of_the_gram(name: str) -> None:
    problem = random_problem(JOINTS, samples=6, seed=2, kernel=name)
    kernel = SumKernel(problem.kernel, FrictionKernel(3))
    gram = kernel.gram(problem.params, problem.motion, problem.motion)
    blocks = torch.stack([gram[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(6)])
    assert (kernel.variance(problem.params, problem.motion) - blocks).abs().max() <= 1e-13 * gram.abs().max()


def test_sum_kernel_adds_its_terms() -> None:
    problem = random_problem(JOINTS, samples=4, seed=3)
    friction = FrictionKernel(3)
    total = SumKernel(problem.kernel, friction).gram(problem.params, problem.motion, problem.motion)
    parts = [k.gram(problem.params, problem.motion, problem.motion) for k in (problem.kernel, friction)]
    assert torch.allclose(total, parts[0] + parts[1], rtol=1e-14, atol=0)
    initial = SumKernel(problem.kernel, friction).initial(problem.motion, problem.motion.q)
    assert initial.keys() == problem.params.keys() - {"noise.log_std"}
    with pytest.raises(ValueError, match=r"\[2, 3\] joints"):
        SumKernel(LipKernel(JOINTS), FrictionKernel(2))


def features(speed: float) -> list[float]:
    sign = math.tanh(speed / SIGN_WIDTH)
    return [speed, sign, 1.0, sign * math.exp(-((speed / STRIBECK_SPEED) ** 2))]


@pytest.mark.parametrize("terms", [3, 4])
def test_block_is_the_covariance_of_independent_weights_on_the_features(terms: int) -> None:
    motion = random_problem(("revolute", "prismatic", "revolute"), samples=4, seed=1).motion
    std = torch.exp(torch.from_numpy(np.random.default_rng(1).normal(size=(3, terms))))
    motion = Motion(motion.q, 0.02 * motion.dq, motion.ddq)  # slow enough for the sign to turn over
    kernel = FrictionKernel(3, terms == 4)
    gram = kernel.gram({"friction.log_std": torch.log(std)}, motion, motion).reshape(4, 3, 4, 3)
    for x in range(4):
        for y in range(4):
            for i in range(3):
                for j in range(3):
                    one, two = features(float(motion.dq[x, i])), features(float(motion.dq[y, j]))
                    expected = sum(float(std[i, f]) ** 2 * one[f] * two[f] for f in range(terms)) if i == j else 0.0
                    assert math.isclose(float(gram[x, i, y, j]), expected, rel_tol=1e-12, abs_tol=1e-14)


def test_sign_is_smooth_at_standstill_and_full_beyond() -> None:
    sign = friction_features(torch.tensor([-1.0, -5 * SIGN_WIDTH, 0.0, 5 * SIGN_WIDTH, 1.0]).double())[1]
    assert sign[2] == 0
    assert torch.allclose(sign[[0, 1, 3, 4]], torch.tensor([-1.0, -1.0, 1.0, 1.0]).double(), rtol=0, atol=1e-4)


def test_initial_hyperparameters_split_a_tenth_of_the_torque_over_features() -> None:
    motion = random_problem(("revolute",) * 2, samples=200, seed=2).motion
    tau = torch.stack([5 * motion.q[:, 0], 0.1 * motion.q[:, 1]], dim=1)
    std = torch.exp(FrictionKernel(2, stribeck=True).initial(motion, tau)["friction.log_std"])
    usual_speed = motion.dq.square().mean(0).sqrt()
    assert std.shape == (2, 4)
    assert torch.allclose(std[:, 0] * usual_speed, 0.1 * tau.square().mean(0).sqrt(), rtol=1e-12)
    assert torch.allclose(std[:, 1:], 0.1 * tau.square().mean(0).sqrt()[:, None].expand(2, 3), rtol=1e-12)
