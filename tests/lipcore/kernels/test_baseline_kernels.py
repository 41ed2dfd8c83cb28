"""Tests of the baseline kernels: lse against automatic differentiation, se and gip against plain loops."""

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import pytest
import torch
from torch import Tensor

from lipcore.data.motion import Array, Motion
from lipcore.kernels.base import PairKernel, State
from lipcore.kernels.independent import GeometricallyInspiredKernel, SquaredExponentialKernel
from lipcore.kernels.lse import LagrangianSEKernel
from lipcore.posterior.exact import negative_log_evidence
from tests.lipcore.oracles import Energy, Problem, worst_block_error

BASELINES = ["se", "gip", "lse"]
KERNELS: dict[str, Callable[[Sequence[str]], PairKernel]] = {
    "se": lambda joint_types: SquaredExponentialKernel(len(joint_types)),
    "gip": GeometricallyInspiredKernel,
    "lse": LagrangianSEKernel,
}
ROBOTS = [
    ("revolute",) * 4,
    ("prismatic", "revolute", "revolute"),
    ("revolute", "prismatic", "revolute", "prismatic"),
    ("prismatic",),
    ("revolute",),
]
robots = pytest.mark.parametrize("joint_types", ROBOTS, ids=lambda kinds: "".join(kind[0] for kind in kinds))


def shapes(name: str, n: int) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the hyperparameters, as the kernels' documentation states them."""
    return {
        "se": {"se.log_scale": (n,), "se.log_lengthscales": (n, 3 * n)},
        "gip": {
            "gip.log_constant": (n,),
            "gip.log_row": (n,),
            "gip.log_column": (n,),
            "gip.log_acceleration": (n, n),
            "gip.log_speed": (n,),
            "gip.log_velocity": (n, n),
            "gip.logits": (n, 2, 2),
            "gip.logits_deviation": (n, n, 2, 2),
        },
        "lse": {
            "lse.log_scale": (),
            "lse.log_position_lengthscales": (n,),
            "lse.log_velocity_lengthscales": (n,),
        },
    }[name]


def random_case(name: str, joint_types: Sequence[str], samples: int) -> tuple[PairKernel, dict[str, Array], Motion]:
    rng, n = np.random.default_rng(len(joint_types)), len(joint_types)
    params = {key: np.asarray(rng.uniform(-0.5, 1.0, shape)) for key, shape in shapes(name, n).items()}
    return KERNELS[name](joint_types), params, Motion.from_arrays(*rng.uniform(-2.0, 2.0, (3, samples, n)))


def lagrangian(joint_types: Sequence[str], params: Mapping[str, Array]) -> Energy:
    """Return the prior of L by its definition: a squared exponential of (cos q, sin q) or q, and of dq."""
    tensors = {name: torch.as_tensor(each) for name, each in params.items()}
    position = torch.exp(tensors["lse.log_position_lengthscales"])
    velocity = torch.exp(tensors["lse.log_velocity_lengthscales"])

    def kernel(q: Tensor, v: Tensor, q2: Tensor, v2: Tensor) -> Tensor:
        total = (((v - v2) / velocity) ** 2).sum()
        for b, kind in enumerate(joint_types):
            pairs = [(q[b], q2[b])]
            if kind == "revolute":
                pairs = [(torch.cos(q[b]), torch.cos(q2[b])), (torch.sin(q[b]), torch.sin(q2[b]))]
            for one, other in pairs:
                total = total + ((one - other) / position[b]) ** 2
        return torch.exp(tensors["lse.log_scale"]) * torch.exp(-0.5 * total)

    return Energy(kernel, +1)


class LagrangianProblem(Problem):
    """A problem of the kernel lse."""

    def energies(self) -> list[Energy]:
        """Return the prior of L by its definition: a squared exponential of (cos q, sin q) or q, and of dq."""
        return [lagrangian(self.kernel.joint_types, self.params)]


@robots
def test_lse_equals_automatic_differentiation(joint_types: tuple[str, ...]) -> None:
    assert worst_block_error(LagrangianProblem(*random_case("lse", joint_types, samples=2))) < 1e-12


def se_loop(joint_types: Sequence[str], params: Mapping[str, np.ndarray], x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the se block of two states x and y, (3, n) with rows q, dq, ddq."""
    n = len(joint_types)
    out = np.zeros((n, n))
    for i in range(n):
        total = 0.0
        for d, difference in enumerate((x - y).ravel()):
            total += (difference / math.exp(params["se.log_lengthscales"][i, d])) ** 2
        out[i, i] = math.exp(params["se.log_scale"][i]) * math.exp(-total / 2)
    return out


def gip_loop(joint_types: Sequence[str], params: Mapping[str, np.ndarray], x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the gip block, with every product dq_a dq_b computed separately."""
    n = len(joint_types)
    out = np.zeros((n, n))
    for i in range(n):
        value = math.exp(params["gip.log_constant"][i])
        inertia = [math.exp(params["gip.log_row"][i] + params["gip.log_column"][a]) for a in range(n)]
        squares = [inertia[a] ** 2 * math.exp(params["gip.log_acceleration"][i, a]) for a in range(n)]
        speed = params["gip.log_speed"][i] + params["gip.log_velocity"][i]
        weights = [math.sqrt(squares[a]) * math.exp(speed[a]) for a in range(n)]
        for a in range(n):
            value += squares[a] * x[2, a] * y[2, a]
            for b in range(n):
                value += weights[a] * weights[b] * (x[1, a] * x[1, b]) * (y[1, a] * y[1, b])
        for b, kind in enumerate(joint_types):
            for factor in range(2):
                alpha, beta = np.exp(params["gip.logits"][b, factor] + params["gip.logits_deviation"][i, b, factor])
                q, q2 = x[0, b], y[0, b]
                if kind == "revolute":
                    p = 1 + alpha * math.cos(q) * math.cos(q2) + beta * math.sin(q) * math.sin(q2)
                else:
                    p = 1 + beta + alpha * q * q2
                value *= p / (1 + alpha + beta)
        out[i, i] = value
    return out


@robots
@pytest.mark.parametrize(("name", "loop"), [("se", se_loop), ("gip", gip_loop)], ids=["se", "gip"])
def test_se_and_gip_equal_plain_loops(name: str, loop: Callable[..., np.ndarray], joint_types: tuple[str, ...]) -> None:
    kernel, params, motion = random_case(name, joint_types, samples=3)
    blocks = kernel.blocks(params, State.rows(motion), State.columns(motion))
    states = np.stack([motion.q, motion.dq, motion.ddq], axis=1)
    for i, x in enumerate(states):
        for j, y in enumerate(states):
            np.testing.assert_allclose(blocks[:, :, i, j], loop(joint_types, params, x, y), rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("still", [(0,), (0, 1, 2)], ids=["one", "all"])
@pytest.mark.parametrize("name", BASELINES)
def test_start_is_scaled_to_data_with_resting_joints(name: str, still: tuple[int, ...]) -> None:
    joint_types = ("revolute", "prismatic", "revolute")
    rng = np.random.default_rng(3)
    q, dq, ddq = rng.uniform(-1.0, 1.0, (3, 30, 3))
    for joint in still:
        q[:, joint], dq[:, joint], ddq[:, joint] = 0.4, 0.0, 0.0
    tau = rng.standard_normal((30, 3)) * [20.0, 5.0, 0.5]
    motion, kernel = Motion.from_arrays(q, dq, ddq), KERNELS[name](joint_types)
    params = kernel.initial(motion, tau)
    assert {key: tuple(value.shape) for key, value in params.items()} == shapes(name, 3)
    assert all(value.dtype == np.float64 and np.isfinite(value).all() for value in params.values())

    prior = kernel.variance(params, motion).diagonal(axis1=1, axis2=2).mean(0).sum()
    assert 0.2 < float(prior / np.square(tau).mean(0).sum()) < 5.0
    params["noise.log_std"] = np.log(0.01 * tau.std(0))
    assert math.isfinite(negative_log_evidence(kernel, params, motion, tau).value)
