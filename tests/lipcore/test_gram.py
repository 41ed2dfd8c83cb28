"""Gram matrices: blocks, rows, sums and friction; the compiled ones against the PyTorch form and autograd."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given

from lipcore.data.motion import Array, Motion
from lipcore.estimators.catalogue import make_estimator
from lipcore.kernels.base import SumKernel
from lipcore.kernels.fast.lanes import LANES
from lipcore.kernels.friction import SIGN_WIDTH, STRIBECK_SPEED, FrictionKernel
from lipcore.kernels.lip import LipKernel
from lipcore.posterior.exact import negative_log_evidence
from lipcore.posterior.on_device import evidence_on
from tests.lipcore.oracles import KERNELS, Problem, TorchForm, opposite, problems, random_problem, shares_of

JOINTS = ("revolute", "prismatic", "revolute")


@given(problems(samples=6))
def test_gram_is_symmetric_and_positive_semidefinite(problem: Problem) -> None:
    gram = problem.kernel.gram(problem.params, problem.motion, problem.motion)
    symmetric = problem.kernel.symmetric_gram(problem.params, problem.motion)
    assert np.array_equal(symmetric, symmetric.T)
    assert np.abs(symmetric - gram).max() <= 1e-13 * np.abs(gram).max()
    values = np.linalg.eigvalsh(0.5 * (gram + gram.T))
    assert values[0] >= -1e-10 * values[-1]


@pytest.mark.parametrize("name", KERNELS)
def test_variance_is_the_diagonal_of_the_gram(name: str) -> None:
    problem = random_problem(JOINTS, samples=6, seed=2, kernel=name)
    kernel = SumKernel(problem.kernel, FrictionKernel(3))
    gram = kernel.gram(problem.params, problem.motion, problem.motion)
    blocks = np.stack([gram[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(6)])
    assert np.abs(kernel.variance(problem.params, problem.motion) - blocks).max() <= 1e-13 * np.abs(gram).max()


def test_sum_kernel_adds_its_terms() -> None:
    problem = random_problem(JOINTS, samples=4, seed=3)
    friction = FrictionKernel(3)
    total = SumKernel(problem.kernel, friction).gram(problem.params, problem.motion, problem.motion)
    parts = [k.gram(problem.params, problem.motion, problem.motion) for k in (problem.kernel, friction)]
    assert np.allclose(total, parts[0] + parts[1], rtol=1e-14, atol=0)
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
    std = np.exp(np.random.default_rng(1).normal(size=(3, terms)))
    motion = Motion(motion.q, 0.02 * motion.dq, motion.ddq)  # slow enough for the sign to turn over
    kernel = FrictionKernel(3, terms == 4)
    gram = kernel.gram({"friction.log_std": np.log(std)}, motion, motion).reshape(4, 3, 4, 3)
    for x in range(4):
        for y in range(4):
            for i in range(3):
                for j in range(3):
                    one, two = features(float(motion.dq[x, i])), features(float(motion.dq[y, j]))
                    expected = sum(float(std[i, f]) ** 2 * one[f] * two[f] for f in range(terms)) if i == j else 0.0
                    assert math.isclose(float(gram[x, i, y, j]), expected, rel_tol=1e-12, abs_tol=1e-14)


RELATIVE = 1e-11
ROBOTS = [
    ("revolute",),
    ("prismatic",),
    ("revolute",) * 2,
    ("prismatic",) * 3,
    ("prismatic", "revolute", "revolute", "prismatic", "revolute"),
    ("revolute",) * 7,
]

kernels = pytest.mark.parametrize("kernel", KERNELS)
robots = pytest.mark.parametrize("joint_types", ROBOTS, ids=lambda kinds: "".join(kind[0] for kind in kinds))


def agree(actual: Array, expected: Array, name: str = "") -> None:
    assert actual.shape == expected.shape
    if expected.size:
        assert float(np.abs(actual - expected).max()) <= RELATIVE * float(np.abs(expected).max()), name


def check(problem: Problem) -> None:
    """All samples with each other and the gradient, and the first third of them with the rest."""
    kernel, params, motion, third = problem.kernel, problem.params, problem.motion, len(problem.motion) // 3
    form, places = TorchForm(kernel), len(motion) * kernel.n_joints
    agree(kernel.gram(params, motion[:third], motion[third:]), form.gram(params, motion[:third], motion[third:]))
    gram = kernel.symmetric_gram(params, motion)
    assert np.array_equal(gram, gram.T)
    agree(gram, form.symmetric_gram(params, motion))

    weight = np.random.default_rng(1).standard_normal((places, places))
    compiled, reference = (each.gradient(params, motion, weight + weight.T) for each in (kernel, form))
    assert compiled.keys() == reference.keys()
    for name, derivative in reference.items():
        agree(compiled[name], derivative, name)


@robots
@kernels
# part of a block of columns, exactly one, and several
@pytest.mark.parametrize("samples", [1, 3, LANES - 1, LANES, LANES + 1, 3 * LANES + 2])
def test_equal_the_formula(kernel: str, joint_types: tuple[str, ...], samples: int) -> None:
    check(random_problem(joint_types, samples, seed=samples, kernel=kernel))


@kernels
def test_many_joints(kernel: str) -> None:
    problem = random_problem(("revolute", "prismatic", "revolute") * 5, 3, seed=0, kernel=kernel)
    if kernel == "chain":
        problem.params["chain.logits"] -= 3.0
    check(problem)


@kernels
@pytest.mark.parametrize("joint_types", [("revolute",) * 3, ("prismatic", "revolute", "prismatic")])
@pytest.mark.parametrize("zeros", [(0,), (2,), (0, 2), (0, 1, 2)])
def test_base_kernels_of_zero(kernel: str, joint_types: tuple[str, ...], zeros: tuple[int, ...]) -> None:
    """p_b = 0 of one, two or all joints: the derivatives stay exact, as nothing divides by it."""
    problem = random_problem(joint_types, 2, seed=3, kernel=kernel)
    logits = np.full((3, 2), 0.7)  # σ < α, β: p changes sign
    for name, value in problem.params.items():
        if name.endswith("logits"):
            value[:] = 0.7 if kernel == "chain" else logits[: len(value)]
    shares = shares_of(torch.from_numpy(logits)).numpy()
    if kernel == "chain":
        alpha = np.full(3, 1 / (1 + np.exp(-0.7)))
        straight = np.array([kind == "prismatic" for kind in joint_types])
        shares = np.stack([1 - alpha, alpha, np.where(straight, 0.0, alpha)], axis=1)
    q = problem.motion.q.copy()
    q[0] = np.array([0.4, 0.9, 1.1])
    for joint in zeros:
        q[1, joint] = opposite(joint_types[joint], shares[joint].tolist(), float(q[0, joint]))
    check(Problem(problem.kernel, problem.params, Motion(q, problem.motion.dq, problem.motion.ddq)))


@kernels
def test_no_samples(kernel: str) -> None:
    problem = random_problem(("revolute",) * 2, 3, seed=0, kernel=kernel)
    assert problem.kernel.gram(problem.params, problem.motion, problem.motion[:0]).shape == (6, 0)
    nothing = np.zeros((0, 0))
    assert not any(
        bool(each.any()) for each in problem.kernel.gradient(problem.params, problem.motion[:0], nothing).values()
    )


@robots
@kernels
# part of a block of columns, with and without room for the query, exactly one, and several
@pytest.mark.parametrize("size", [1, LANES - 1, LANES, 2 * LANES - 1, 8 * LANES + 5])
def test_cross_equals_the_gram_matrix(kernel: str, joint_types: tuple[str, ...], size: int) -> None:
    problem, n = random_problem(joint_types, size + 3, seed=size, kernel=kernel), len(joint_types)
    asked = problem.motion[size:]
    queries = np.ascontiguousarray(np.stack([asked.q, asked.dq, asked.ddq], axis=1))
    found = np.full((len(asked), size + 1, n, n), np.nan)  # where anything left out would show
    problem.kernel.cross(problem.params, problem.motion[:size]).fill_many(queries, found)
    gram = problem.kernel.gram(problem.params, problem.motion[:size], asked)
    expected = gram.reshape(size, n, 3, n).transpose(2, 0, 1, 3)
    np.testing.assert_allclose(found[:, :size], expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    prior = problem.kernel.variance(problem.params, asked)
    np.testing.assert_allclose(found[:, size], prior, rtol=0, atol=1e-12 * np.abs(prior).max())
    assert np.array_equal(found[:, size], found[:, size].transpose(0, 2, 1))


@pytest.mark.parametrize("estimator", ["lip-chain", "se", "gip"])
def test_evidence_in_pytorch_is_that_of_numpy(estimator: str) -> None:
    """What computes on a GPU, here on the CPU: value and every derivative, friction's among them."""
    problem = random_problem(("revolute", "prismatic", "revolute"), 7, seed=5, kernel="chain")
    kernel = make_estimator(estimator, ("revolute", "prismatic", "revolute")).kernel
    tau = np.random.default_rng(6).standard_normal((7, 3))
    params = {**kernel.initial(problem.motion, tau), "noise.log_std": np.full(3, -1.0)}
    expected = negative_log_evidence(kernel, params, problem.motion, tau)
    value, gradient = evidence_on(kernel, params, problem.motion, tau, "cpu")
    assert value == pytest.approx(expected.value, rel=1e-10)
    assert gradient.keys() == expected.gradient.keys()
    for name, derivative in expected.gradient.items():
        agree(gradient[name], derivative, name)
