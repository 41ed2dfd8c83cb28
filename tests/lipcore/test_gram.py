"""From blocks to Gram matrices: order of rows, symmetry, positive semidefiniteness, chunks, sums."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given

from lipcore.kernels.base import PAIRS_PER_CHUNK, State, SumKernel, row_chunks
from lipcore.kernels.friction import FrictionKernel
from lipcore.kernels.lip import LipKernel
from tests.lipcore.problems import KERNELS, Problem, TorchForm, problems, random_problem

JOINTS = ("revolute", "prismatic", "revolute")


@given(problems(samples=6))
def test_gram_is_symmetric_and_positive_semidefinite(problem: Problem) -> None:
    gram = problem.kernel.gram(problem.params, problem.motion, problem.motion)
    size = gram.abs().max()
    assert (gram - gram.T).abs().max() <= 1e-13 * size
    values = torch.linalg.eigvalsh(0.5 * (gram + gram.T))
    assert values[0] >= -1e-10 * values[-1]


@given(problems(samples=5))
def test_symmetric_gram_is_the_gram_and_exactly_symmetric(problem: Problem) -> None:
    gram = problem.kernel.gram(problem.params, problem.motion, problem.motion)
    symmetric = problem.kernel.symmetric_gram(problem.params, problem.motion)
    assert torch.equal(symmetric, symmetric.T)
    assert (symmetric - gram).abs().max() <= 1e-13 * gram.abs().max()


def test_rows_and_columns_run_sample_by_sample() -> None:
    problem = random_problem(JOINTS, samples=5, seed=0)
    kernel, params, motion = problem.kernel, problem.params, problem.motion
    gram = kernel.gram(params, motion[:2], motion[2:])
    assert gram.shape == (6, 9)
    blocks = kernel.blocks(params, State.rows(motion[:2]), State.columns(motion[2:]))
    for x in range(2):
        for y in range(3):
            part = gram[3 * x : 3 * x + 3, 3 * y : 3 * y + 3]
            assert torch.allclose(part, blocks[:, :, x, y], rtol=1e-12, atol=0)


@pytest.mark.parametrize("pairs", [1, 7, 20, 10**6])
def test_results_do_not_depend_on_the_chunk_size(pairs: int, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = random_problem(JOINTS, samples=11, seed=1)
    kernel, params, motion = TorchForm(problem.kernel), problem.params, problem.motion
    gram, symmetric = kernel.gram(params, motion[:4], motion), kernel.symmetric_gram(params, motion)
    monkeypatch.setattr("lipcore.kernels.base.PAIRS_PER_CHUNK", pairs)
    tolerance = {"rtol": 1e-12, "atol": 1e-13 * float(gram.abs().max())}
    assert torch.allclose(kernel.gram(params, motion[:4], motion), gram, **tolerance)
    assert torch.allclose(kernel.symmetric_gram(params, motion), symmetric, **tolerance)


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


def test_sum_kernel_refuses_terms_of_different_robots() -> None:
    with pytest.raises(ValueError, match=r"\[2, 3\] joints"):
        SumKernel(LipKernel(JOINTS), FrictionKernel(2))
