"""Slow, independent references: automatic differentiation of the definitions."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from torch import Tensor
from torch.func import jacrev

from lipcore.data.motion import Array, Motion
from lipcore.data.samples import Samples
from lipcore.kernels.base import PairKernel, Params, State
from lipcore.kernels.chain import ChainKernel
from lipcore.kernels.lip import LipKernel
from lipcore.model.torque_model import TorqueModel
from lipcore.posterior.compact import CompactPosterior
from lipcore.posterior.statistics import collect

Instant = tuple[Tensor, Tensor, Tensor]
"""(q, v, a) of one sample, each (n,)."""


@dataclass(frozen=True)
class Energy:
    """One independent energy: k(q, v, q', v'), scalar, and its sign in the Lagrangian, + kinetic, − potential."""

    kernel: Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]
    sign: int


def base_kernel(kind: str, share: Tensor, q: Tensor, q2: Tensor) -> Tensor:
    """Return p(q, q') of one joint, as in the paper."""
    sigma, alpha, beta = share
    if kind == "revolute":
        return sigma + alpha * torch.cos(q) * torch.cos(q2) + beta * torch.sin(q) * torch.sin(q2)
    return sigma + beta + alpha * q * q2


def shares_of(logits: Tensor) -> Tensor:
    """Return (σ, α, β) of each joint, (n, 3), proportional to (1, e^first, e^second) with sum one."""
    parts = torch.cat([torch.ones(len(logits), 1, dtype=logits.dtype), torch.exp(logits)], dim=1)
    return parts / parts.sum(1, keepdim=True)


def pooled_weight(params: Mapping[str, Tensor], link: int, joint: int) -> Tensor:
    """Return w_{l,a} of link l and joint a ≤ l, both counted from 0: five logarithms added up."""
    before = sum(range(link + 1))  # deviations run link by link, a link's first joint first
    return torch.exp(
        params["kinetic.log_scale"]
        + params["kinetic.log_link"][link]
        + params["kinetic.log_joint"][joint]
        + params["kinetic.log_gap"][link - joint]
        + params["kinetic.log_deviation"][before + joint]
    )


def lip_energies(joint_types: Sequence[str], params: Mapping[str, Array]) -> list[Energy]:
    """Return the paper's energies: the potential over all joints, then one kinetic energy per link."""
    params = {name: torch.as_tensor(each) for name, each in params.items()}
    potential_shares = shares_of(params["potential.logits"])
    scale = torch.exp(params["potential.log_scale"])

    def potential(q: Tensor, v: Tensor, q2: Tensor, v2: Tensor) -> Tensor:
        value = scale
        for b, kind in enumerate(joint_types):
            value = value * base_kernel(kind, potential_shares[b], q[b], q2[b])
        return value

    energies = [Energy(potential, -1)]
    for link in range(1, len(joint_types) + 1):
        weights = torch.stack([pooled_weight(params, link - 1, joint) for joint in range(link)])
        logits = params["kinetic.logits"] if "kinetic.logits" in params else params[f"kinetic.{link}.logits"]
        link_shares = shares_of(logits)

        def kinetic(
            q: Tensor, v: Tensor, q2: Tensor, v2: Tensor, weights: Tensor = weights, share: Tensor = link_shares
        ) -> Tensor:
            count = len(weights)
            value = (weights * v[:count] * v2[:count]).sum() ** 2
            for b in range(count):
                value = value * base_kernel(joint_types[b], share[b], q[b], q2[b]) ** 2
            return value

        energies.append(Energy(kinetic, +1))
    return energies


def chain_base_kernel(kind: str, alpha: Tensor, q: Tensor, q2: Tensor) -> Tensor:
    """Return p(q, q') of one joint of a chain; it does not depend on a revolute joint's zero."""
    return 1 - alpha + alpha * (torch.cos(q - q2) if kind == "revolute" else q * q2)


def chain_energies(joint_types: Sequence[str], params: Mapping[str, Array]) -> list[Energy]:
    """Return the energies of a serial chain: the sum of the links' potentials, then one kinetic energy per link."""
    params = {name: torch.as_tensor(each) for name, each in params.items()}
    n, scales = len(joint_types), torch.exp(params["potential.log_scales"])
    alpha = 1 / (1 + torch.exp(-params["chain.logits"]))

    def base(b: int, q: Tensor, q2: Tensor) -> Tensor:
        return chain_base_kernel(joint_types[b], alpha[b], q[b], q2[b])

    def potential(q: Tensor, v: Tensor, q2: Tensor, v2: Tensor) -> Tensor:
        total = torch.zeros((), dtype=q.dtype)
        for link in range(n):
            value = scales[link]
            for b in range(link + 1):
                value = value * base(b, q, q2)
            total = total + value
        return total

    def kinetic_of(link: int) -> Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]:
        weights = [pooled_weight(params, link, joint) for joint in range(link + 1)]

        def kinetic(q: Tensor, v: Tensor, q2: Tensor, v2: Tensor) -> Tensor:
            total = torch.zeros((), dtype=q.dtype)
            for joint, weight in enumerate(weights):
                term = weight * v[joint] * v2[joint]
                for b in range(joint + 1, link + 1):
                    term = term * base(b, q, q2)
                total = total + term
            return total**2

        return kinetic

    return [Energy(potential, -1), *(Energy(kinetic_of(link), +1) for link in range(n))]


def lagrange(lagrangian: Callable[[Tensor, Tensor], Tensor], q: Tensor, v: Tensor, a: Tensor) -> Tensor:
    """Return d/dt(∂L/∂v) − ∂L/∂q of every entry of L(q, v), with the joint as last axis."""
    momentum = jacrev(lagrangian, argnums=1)
    by_q, by_v = jacrev(momentum, argnums=(0, 1))(q, v)
    return by_q @ v + by_v @ a - jacrev(lagrangian, argnums=0)(q, v)


def torque_terms(energies: Sequence[Energy], x: Instant, y: Instant) -> Tensor:
    """Return cov(tau_i(x), tau_j(y)) due to each energy alone, (energies, n, n)."""

    def block(energy: Energy) -> Tensor:
        def at_y(q: Tensor, v: Tensor) -> Tensor:
            return lagrange(lambda q2, v2: energy.kernel(q, v, q2, v2), *y)

        return lagrange(at_y, *x).T  # the sign enters twice

    return torch.stack([block(energy) for energy in energies])


def energy_torque(energies: Sequence[Energy], x: Instant, y: Instant) -> Tensor:
    """Return cov(energy(x), tau_j(y)) of each energy, (energies, n)."""
    q, v, _ = x
    return torch.stack([e.sign * lagrange(lambda q2, v2, e=e: e.kernel(q, v, q2, v2), *y) for e in energies])


def scale_of(energies: Sequence[Energy], x: Instant, y: Instant, terms: Tensor) -> float:
    """Return the scale of rounding errors: the largest entry of any term, or of the energies.

    The sum of the terms may cancel, and so may a term where the derivative of a base kernel is zero.
    """
    values = [float(energy.kernel(*x[:2], *y[:2]).abs()) for energy in energies]
    return max(float(terms.abs().max()), *values)


def instant(motion: Motion, row: int) -> Instant:
    """Return one sample of a motion."""
    return torch.from_numpy(motion.q[row]), torch.from_numpy(motion.dq[row]), torch.from_numpy(motion.ddq[row])


Shapes = dict[str, tuple[int, ...]]


@dataclass(frozen=True)
class Problem:
    """A kernel with hyperparameters and a motion to evaluate it on."""

    kernel: LipKernel | ChainKernel
    params: dict[str, Array]
    motion: Motion

    def energies(self) -> list[Energy]:
        """Return the energies in the kernel's documentation: the potential one, then one per link."""
        energies = lip_energies if isinstance(self.kernel, LipKernel) else chain_energies
        return energies(self.kernel.joint_types, self.params)


class TorchForm(PairKernel):
    """A compiled kernel in the form of its formula, with gradients by autograd."""

    def __init__(self, kernel: PairKernel) -> None:
        self.kernel, self.n_joints = kernel, kernel.n_joints

    def blocks(self, params: Params, x: State, y: State) -> Array:
        """Return the blocks of the kernel itself."""
        return self.kernel.blocks(params, x, y)

    def initial(self, motion: Motion, tau: Array) -> dict[str, Array]:
        """Return the start of the kernel itself."""
        return self.kernel.initial(motion, tau)


def weight_shapes(n: int) -> Shapes:
    """Return the shapes of the velocity weights' hyperparameters."""
    vectors = {f"kinetic.{name}": (n,) for name in ("log_link", "log_joint", "log_gap")}
    return {"kinetic.log_scale": (), **vectors, "kinetic.log_deviation": (n * (n + 1) // 2,)}


def lip_shapes(n: int, tied: bool) -> Shapes:
    """Return the shapes of the paper kernel's hyperparameters, as documented."""
    kinetic = {"kinetic.logits": n} if tied else {f"kinetic.{link}.logits": link for link in range(1, n + 1)}
    shapes: Shapes = {"potential.log_scale": (), "potential.logits": (n, 2)}
    return shapes | {name: (size, 2) for name, size in kinetic.items()} | weight_shapes(n)


def chain_shapes(n: int) -> Shapes:
    """Return the shapes of the chain kernel's hyperparameters, as documented."""
    return {"chain.logits": (n,), "potential.log_scales": (n,), **weight_shapes(n)}


KERNELS: Mapping[str, tuple[Callable[[Sequence[str]], LipKernel | ChainKernel], Callable[[int], Shapes]]] = {
    "tied": (lambda joint_types: LipKernel(joint_types, tied=True), lambda n: lip_shapes(n, tied=True)),
    "untied": (lambda joint_types: LipKernel(joint_types, tied=False), lambda n: lip_shapes(n, tied=False)),
    "chain": (ChainKernel, chain_shapes),
}
"""Energy kernels by name, each with the shapes of its hyperparameters for n joints."""


def random_problem(joint_types: Sequence[str], samples: int, seed: int, kernel: str = "tied") -> Problem:
    """Return a problem of moderate hyperparameters and motion, with noise and friction. kernel: of KERNELS."""
    rng, n = np.random.default_rng(seed), len(joint_types)
    make, shapes = KERNELS[kernel]
    both = shapes(n) | {"noise.log_std": (n,), "friction.log_std": (n, 3)}
    params = {name: np.array(rng.uniform(*hyperparameter_range(name), shape)) for name, shape in both.items()}
    params["noise.log_std"] = params["noise.log_std"] - 1.0
    motion = Motion.from_arrays(*rng.uniform(-2.0, 2.0, (3, samples, n)))
    return Problem(make(joint_types), params, motion)


def hyperparameter_range(name: str) -> tuple[float, float]:
    """Return the range of a hyperparameter; five of the velocity weights' add up."""
    return (-0.5, 0.4) if name.startswith("kinetic.log_") else (-1.5, 1.0)


@st.composite
def problems(draw: st.DrawFn, max_joints: int = 4) -> Problem:
    """Draw problems of two samples with mixed joints and states within a few rad."""
    joint_types = draw(st.lists(st.sampled_from(["revolute", "prismatic"]), min_size=1, max_size=max_joints))
    make, shapes = KERNELS[draw(st.sampled_from(tuple(KERNELS)))]
    n = len(joint_types)

    def array(shape: tuple[int, ...], bound: float) -> np.ndarray:
        return draw(arrays(np.float64, shape, elements=st.floats(-bound, bound, allow_subnormal=False)))

    bounds = {name: 1.0 if name.startswith("kinetic.log_") else 3.0 for name in shapes(n)}
    params = {name: array(shape, bounds[name]) for name, shape in shapes(n).items()}
    motion = Motion.from_arrays(*(array((2, n), 4.0) for _ in range(3)))
    return Problem(make(joint_types), params, motion)


RELATIVE_TOLERANCE = 1e-10
"""Maximum error relative to `scale_of` the terms."""
PAIRS = ((0, 0), (0, 1))


def worst_block_error(problem: Problem, pairs: Sequence[tuple[int, int]] = PAIRS) -> float:
    """Return the largest error of the torques' covariance over pairs of samples, relative to `scale_of`."""
    motion, energies = problem.motion, problem.energies()
    blocks = problem.kernel.blocks(problem.params, State.rows(motion), State.columns(motion))
    worst = 0.0
    for i, j in pairs:
        x, y = instant(motion, i), instant(motion, j)
        terms = torque_terms(energies, x, y)
        error = float(np.abs(blocks[:, :, i, j] - terms.sum(0).numpy()).max())
        worst = max(worst, error / scale_of(energies, x, y, terms))
    return worst


def worst_energy_error(problem: Problem, pairs: Sequence[tuple[int, int]] = PAIRS) -> float:
    """Return the same for the covariances of the energies with the torques and with themselves."""
    kernel, motion, energies = problem.kernel, problem.motion, problem.energies()
    rows, columns = State.rows(motion), State.columns(motion)
    torques = kernel.energies(problem.params, rows, columns)
    values = kernel.energy_covariance(problem.params, rows, columns)
    worst = 0.0
    for i, j in pairs:
        x, y = instant(motion, i), instant(motion, j)
        terms = energy_torque(energies, x, y)
        alone = torch.stack([energy.kernel(*x[:2], *y[:2]) for energy in energies])
        scale = scale_of(energies, x, y, terms)
        for found, each in ((torques, terms), (values, alone)):
            expected = torch.stack([each[1:].sum(0), each[0]])
            worst = max(worst, float(np.abs(found[..., i, j] - expected.numpy()).max()) / scale)
    return worst


def central_difference(value: Callable[[float], Any], step: float) -> Any:
    """Return the slope at zero of a function, a number or an array, exact to about step⁴."""
    near, far = (value(s * step) - value(-s * step) for s in (1, 2))
    return (8 * near - far) / (12 * step)


def zero_position(kind: str, share: Sequence[float], q: float) -> float:
    """Return the position q' at which the base kernel p(q, q') of shares (σ, α, β) is zero."""
    sigma, alpha, beta = share
    if kind == "prismatic":
        return -(sigma + beta) / (alpha * q)
    cosine, sine = alpha * math.cos(q), beta * math.sin(q)
    return math.atan2(sine, cosine) + math.acos(-sigma / math.hypot(cosine, sine))


def base_shares(problem: Problem) -> np.ndarray:
    """Return (σ, α, β) of each joint's potential base kernel, (n, 3)."""
    if isinstance(problem.kernel, LipKernel):
        return shares_of(torch.from_numpy(problem.params["potential.logits"])).numpy()
    alpha = 1 / (1 + np.exp(-problem.params["chain.logits"]))
    turns = np.array([kind == "revolute" for kind in problem.kernel.joint_types])
    return np.stack([1 - alpha, alpha, alpha * turns], axis=1)


def cross_zeros(problem: Problem, q: np.ndarray, joints: Sequence[int], offset: float = 0.0) -> Problem:
    """Return the problem with p(q, q') = 0 of some joints for samples 0, at q (n,), and 1, plus an offset of q'."""
    moved, shares = problem.motion.q.copy(), base_shares(problem)
    moved[0] = q
    for joint in joints:
        kind = problem.kernel.joint_types[joint]
        moved[1, joint] = zero_position(kind, shares[joint].tolist(), q[joint]) + offset
    return replace(problem, motion=replace(problem.motion, q=moved))


def with_full_counts(model: TorqueModel, samples: Samples) -> TorqueModel:
    """Return the model with every sample counted fully and without misfit, as in a textbook."""
    posterior, motion = model.posterior, samples.motion()
    noise, residual = posterior.noise_variance, samples.tau - posterior.kernel.mean(motion)
    every = collect(posterior.basis, noise, motion, residual)
    built = CompactPosterior.build(posterior.kernel, posterior.basis, every, noise, posterior.std_factor)
    return replace(model, posterior=built)
