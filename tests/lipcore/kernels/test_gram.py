"""Tests of Gram matrices: sums, friction, and compiled kernels at zeros, with many joints and without samples."""

import math

import numpy as np
import pytest

from lipcore.data.motion import Array, Motion
from lipcore.estimators.catalogue import make_estimator
from lipcore.kernels.combined import SumKernel
from lipcore.kernels.drive.kernel import Drive, DriveKernel
from lipcore.kernels.drive.terms import SIGN_WIDTH, STRIBECK_SPEED
from lipcore.kernels.lip import LipKernel
from lipcore.posterior.exact import negative_log_evidence
from lipcore.posterior.on_device import evidence_on
from tests.lipcore.oracles import KERNELS, Problem, TorchForm, cross_zeros, random_problem

JOINTS = ("revolute", "prismatic", "revolute")


def test_sum_has_the_hyperparameters_of_all_terms() -> None:
    problem = random_problem(JOINTS, samples=4, seed=3)
    initial = SumKernel(problem.kernel, DriveKernel(Drive(3))).initial(problem.motion, problem.motion.q)
    assert initial.keys() == problem.params.keys() - {"noise.log_std"}
    with pytest.raises(ValueError, match=r"\[2, 3\] joints"):
        SumKernel(LipKernel(JOINTS), DriveKernel(Drive(2)))


def features(speed: float) -> list[float]:
    sign = math.tanh(speed / SIGN_WIDTH)
    return [speed, sign, 1.0, sign * math.exp(-((speed / STRIBECK_SPEED) ** 2))]


@pytest.mark.parametrize("terms", [3, 4])
def test_block_is_the_covariance_of_independent_weights(terms: int) -> None:
    motion = random_problem(JOINTS, samples=4, seed=1).motion
    std = np.exp(np.random.default_rng(1).normal(size=(3, terms)))
    motion = Motion(motion.q, 0.02 * motion.dq, motion.ddq)  # slow enough to change the sign
    kernel = DriveKernel(Drive(3, ("stribeck",)[: terms - 3]))
    gram = kernel.gram({"friction.log_std": np.log(std)}, motion, motion).reshape(4, 3, 4, 3)
    for x in range(4):
        for y in range(4):
            for i in range(3):
                for j in range(3):
                    one, two = features(float(motion.dq[x, i])), features(float(motion.dq[y, j]))
                    expected = sum(float(std[i, f]) ** 2 * one[f] * two[f] for f in range(terms)) if i == j else 0.0
                    assert math.isclose(float(gram[x, i, y, j]), expected, rel_tol=1e-12, abs_tol=1e-14)


RELATIVE_TOLERANCE = 1e-11
kernels = pytest.mark.parametrize("kernel", KERNELS)


def assert_close(actual: Array, expected: Array, name: str = "") -> None:
    assert actual.shape == expected.shape
    if expected.size:
        assert float(np.abs(actual - expected).max()) <= RELATIVE_TOLERANCE * float(np.abs(expected).max()), name


def compare_with_formula(problem: Problem) -> None:
    """Compare the Gram matrix of all samples, its gradient, and the Gram matrix of the first third and the rest."""
    kernel, params, motion, third = problem.kernel, problem.params, problem.motion, len(problem.motion) // 3
    form, places = TorchForm(kernel), len(motion) * kernel.n_joints
    assert_close(kernel.gram(params, motion[:third], motion[third:]), form.gram(params, motion[:third], motion[third:]))
    gram = kernel.symmetric_gram(params, motion)
    assert np.array_equal(gram, gram.T)
    assert_close(gram, form.symmetric_gram(params, motion))

    weight = np.random.default_rng(1).standard_normal((places, places))
    compiled, reference = (each.gradient(params, motion, weight + weight.T) for each in (kernel, form))
    assert compiled.keys() == reference.keys()
    for name, derivative in reference.items():
        assert_close(compiled[name], derivative, name)


@pytest.mark.slow
@kernels
def test_kernels_with_many_joints_match_the_formula(kernel: str) -> None:
    problem = random_problem(JOINTS * 5, 3, seed=0, kernel=kernel)
    if kernel == "chain":
        problem.params["chain.logits"] -= 3.0
    compare_with_formula(problem)


@kernels
@pytest.mark.parametrize("joint_types", [("revolute",) * 3, ("prismatic", "revolute", "prismatic")])
@pytest.mark.parametrize("zeros", [(0,), (2,), (0, 2), (0, 1, 2)])
def test_kernels_are_exact_at_zeros(kernel: str, joint_types: tuple[str, ...], zeros: tuple[int, ...]) -> None:
    """With p_b = 0 of one, two or all joints, the derivatives stay exact, as nothing divides by p_b."""
    problem = random_problem(joint_types, 2, seed=3, kernel=kernel)
    for name, value in problem.params.items():
        if name.endswith("logits"):
            value[:] = 0.7  # σ < α, β: p changes sign
    compare_with_formula(cross_zeros(problem, np.array([0.4, 0.9, 1.1]), zeros))


@kernels
def test_no_samples_give_empty_matrices(kernel: str) -> None:
    problem = random_problem(("revolute",) * 2, 3, seed=0, kernel=kernel)
    assert problem.kernel.gram(problem.params, problem.motion, problem.motion[:0]).shape == (6, 0)
    nothing = np.zeros((0, 0))
    gradient = problem.kernel.gradient(problem.params, problem.motion[:0], nothing)
    assert not any(bool(each.any()) for each in gradient.values())


@pytest.mark.parametrize("estimator", ["se", "gip", "lse"])
def test_torch_evidence_matches_numpy(estimator: str) -> None:
    """Run the GPU code on the CPU: value and every derivative, including friction's."""
    problem = random_problem(JOINTS, 7, seed=5, kernel="chain")
    kernel = make_estimator(estimator, JOINTS).kernel
    tau = np.random.default_rng(6).standard_normal((7, 3))
    params = {**kernel.initial(problem.motion, tau), "noise.log_std": np.full(3, -1.0)}
    expected = negative_log_evidence(kernel, params, problem.motion, tau)
    value, gradient = evidence_on(kernel, params, problem.motion, tau, "cpu")
    assert value == pytest.approx(expected.value, rel=1e-10)
    assert gradient.keys() == expected.gradient.keys()
    for name, derivative in expected.gradient.items():
        assert_close(gradient[name], derivative, name)
