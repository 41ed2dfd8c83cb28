"""Tests that every kernel, compiled or not, equals the formula that its class states.

Other tests compare the formulas with automatic differentiation, plain loops and Pinocchio.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pytest
import torch
from torch import Tensor

from lipcore.data.motion import Array, Motion
from lipcore.kernels.arm import ArmKernel
from lipcore.kernels.arm_prior import Alternative, Arm
from lipcore.kernels.base import LinearKernel, PairKernel, State, TorqueKernel
from lipcore.kernels.chain import ChainKernel
from lipcore.kernels.combined import SumKernel
from lipcore.kernels.drive.kernel import DriveKernel
from lipcore.kernels.drive.play import ELEMENTS, deflections_of, element_widths
from lipcore.kernels.drive.terms import drive_features, drive_terms
from lipcore.kernels.fast.lanes import LANES
from lipcore.kernels.geometry import Geometry
from lipcore.kernels.independent import GeometricallyInspiredKernel, SquaredExponentialKernel
from lipcore.kernels.lip import LipKernel
from lipcore.kernels.lse import LagrangianSEKernel
from lipcore.kernels.mixture import MixtureKernel
from lipcore.kernels.newton_euler import rigid_body_torque
from lipcore.kernels.payload import PayloadKernel
from lipcore.vocabulary import DRIVE_KINDS, DriveKind
from tests.lipcore.arms import random_bodies, random_geometry
from tests.lipcore.oracles import central_difference

RELATIVE_TOLERANCE = 1e-10
"""Relative tolerance for rounding errors."""
GEOMETRY_STEP = 1e-4
"""Step of central differences by the geometry, rad and m; they are exact to about GEOMETRY_STEP⁴."""
GEOMETRY_TOLERANCE = 1e-9
"""Relative tolerance for derivatives by the geometry."""

KINDS_OF_ARM: tuple[DriveKind, ...] = ("stribeck", "position", "load", "gain", "play")

Features = Callable[[Motion], Array]


@dataclass(frozen=True)
class Case:
    """A kernel, the features Φ of its linear terms in order, (N, n, p), and the relative tolerance."""

    kernel: TorqueKernel
    features: Sequence[Features] = ()
    share: float = RELATIVE_TOLERANCE


def bodies_torque(geometry: Geometry, order: np.ndarray, bodies: Array, motion: Motion) -> Array:
    """Return the rigid bodies' torque by its formula, in the order of the data, (N, n)."""
    states = (each[:, order].T for each in (motion.q, motion.dq, motion.ddq))
    out = np.empty_like(motion.q)
    out[:, order] = rigid_body_torque(geometry, bodies, State(*states)).T
    return out


def derivatives_by_bodies(geometry: Geometry, order: np.ndarray, motion: Motion) -> Array:
    """Return ∂τ/∂π in the order of the data, (N, n, 10 n); the formula is linear in π."""
    units = np.eye(10 * len(order)).reshape(-1, len(order), 10)
    columns = [bodies_torque(geometry, order, bodies[order], motion) for bodies in units]
    return np.stack(columns, axis=2)


def derivatives_by_geometry(arm: Arm, motion: Motion) -> Array:
    """Return ∂τ/∂θ at the arm's bodies, (N, n, g)."""

    def torque(direction: Array, step: float) -> Array:
        return bodies_torque(arm.geometry.moved(step * direction), arm.order, arm.parameters, motion)

    slopes = [central_difference(partial(torque, direction), GEOMETRY_STEP) for direction in np.eye(arm.steps)]
    return np.stack(slopes, axis=2)


def arm_features(arm: Arm, motion: Motion) -> Array:
    """Return the features of an arm without alternatives."""
    rotors = motion.ddq[:, :, None] * np.eye(arm.n_joints)
    bodies = derivatives_by_bodies(arm.geometry, arm.order, motion)
    return np.concatenate([bodies, rotors, derivatives_by_geometry(arm, motion)], axis=2)


def drive_terms_of(arm: Arm, kinds: Sequence[DriveKind], motion: Motion) -> Array:
    """Return the terms of friction with the torque of an arm's bodies as the load, (f, N, n)."""
    load = bodies_torque(arm.geometry, arm.order, arm.parameters, motion)
    known = deflections_of(motion, element_widths(arm.joint_types), arm.acceleration)
    return drive_features(motion.dq, kinds, motion.q, load, known[:, : len(ELEMENTS)])


def mixture_features(kernel: MixtureKernel, arm: Arm, motion: Motion) -> Array:
    """Return the features Lᵀ δ of the other arms."""
    friction = drive_terms_of(arm, arm.drive, motion)
    torques = [
        bodies_torque(each.geometry, arm.order, each.parameters, motion)
        + each.rotor * motion.ddq
        + np.einsum("fki,if->ki", friction, each.friction)
        for each in arm.alternatives
    ]
    return np.stack([each - torques[0] for each in torques[1:]], axis=2) @ kernel.mixing


def random_arm(joint_types: Sequence[str], others: int = 0, several: bool = False) -> Arm:
    """Return a random arm with another joint order in the data, and its alternatives.

    several: whether the last joint is an arm by itself.
    """
    n, rng = len(joint_types), np.random.default_rng(1)
    letters = "".join("P" if kind == "prismatic" else "R" for kind in joint_types)
    geometry = random_geometry(letters[:-1] + letters[-1].lower() if several else letters, 2)
    units = 0.5 + rng.random(11 * n), rng.random(n), rng.normal(0, 0.1, geometry.size), np.full(geometry.size, 0.3)
    shares = np.array([0.5, 0.3, 0.2])
    alternatives = tuple(
        Alternative(
            geometry.moved(0.1 * k * rng.standard_normal(geometry.size)),
            random_bodies(n, k),
            0.1 * rng.random(n),
            rng.random((n, len(drive_terms(KINDS_OF_ARM)))),
            float(shares[k]),
        )
        for k in range(others + 1)
    )
    bodies = random_bodies(n, 5)
    order = np.roll(np.arange(n), 1)
    return Arm(
        geometry,
        order,
        "learn",
        bodies,
        bodies,
        *units,
        drive=KINDS_OF_ARM,
        acceleration=0.5 + rng.random(n),
        alternatives=alternatives if others else (),
    )


def arm_case(joint_types: Sequence[str], several: bool = False) -> Case:
    arm = random_arm(joint_types, several=several)
    return Case(ArmKernel(arm), [partial(arm_features, arm)], GEOMETRY_TOLERANCE)


def mixture_case(joint_types: Sequence[str], several: bool = False) -> Case:
    arm = random_arm(joint_types, others=2, several=several)
    kernel = MixtureKernel(arm, arm.alternatives)
    return Case(kernel, [partial(mixture_features, kernel, arm)])


def arm_with_alternatives_case(joint_types: Sequence[str]) -> Case:
    alone, (more,) = random_arm(joint_types, others=2), mixture_case(joint_types).features
    return Case(
        ArmKernel(alone),
        [lambda motion: np.concatenate([arm_features(alone, motion), more(motion)], axis=2)],
        GEOMETRY_TOLERANCE,
    )


def payload_case(joint_types: Sequence[str], several: bool = False) -> Case:
    arm = random_arm(joint_types, several=several)
    last = slice(10 * int(arm.order[-1]), 10 * int(arm.order[-1]) + 10)

    bodies = partial(derivatives_by_bodies, arm.geometry, arm.order)
    return Case(PayloadKernel(arm, np.arange(1.0, 11.0)), [lambda motion: bodies(motion)[..., last]])


def friction_case(joint_types: Sequence[str], kinds: Sequence[DriveKind] = ()) -> Case:
    arm, n = random_arm(joint_types), len(joint_types)

    def features(motion: Motion) -> Array:
        terms = drive_terms_of(arm, kinds, motion)
        return np.einsum("fki,ij->kijf", terms, np.eye(n)).reshape(len(motion), n, -1)

    return Case(DriveKernel(replace(arm.friction, kinds=tuple(kinds))), [features])


def sum_case(joint_types: Sequence[str]) -> Case:
    arm, friction = arm_case(joint_types), friction_case(joint_types)
    kernel = SumKernel(ChainKernel(joint_types), arm.kernel, friction.kernel)
    return Case(kernel, [*arm.features, *friction.features], GEOMETRY_TOLERANCE)


CASES: dict[str, Callable[[Sequence[str]], Case]] = {
    "lip": lambda joint_types: Case(LipKernel(joint_types)),
    "lip untied": lambda joint_types: Case(LipKernel(joint_types, tied=False)),
    "lip-chain": lambda joint_types: Case(ChainKernel(joint_types)),
    "se": lambda joint_types: Case(SquaredExponentialKernel(len(joint_types))),
    "gip": lambda joint_types: Case(GeometricallyInspiredKernel(joint_types)),
    "lse": lambda joint_types: Case(LagrangianSEKernel(joint_types)),
    "friction": friction_case,
    "friction of slow joints": partial(friction_case, kinds=("stribeck",)),
    "friction that is not linear in speed": partial(friction_case, kinds=("speed", "sides")),
    "friction of all kinds": partial(friction_case, kinds=DRIVE_KINDS),
    "arm": arm_case,
    "arm with alternatives": arm_with_alternatives_case,
    "mixture of arms": mixture_case,
    "payload": payload_case,
    "two arms": partial(arm_case, several=True),
    "mixture of two arms each": partial(mixture_case, several=True),
    "payload of the last of two arms": partial(payload_case, several=True),
    "sum": sum_case,
}
JOINTS = {"RR": ("revolute", "revolute"), "RPR": ("revolute", "prismatic", "revolute")}
SIZES = (1, LANES - 1, LANES, LANES + 3)
"""Numbers of samples: part of a block of compiled columns, nearly one, exactly one, and more."""

every_kernel = pytest.mark.parametrize("name", CASES)
robots = pytest.mark.parametrize("joint_types", JOINTS.values(), ids=JOINTS)


def draw_problem(kernel: TorqueKernel, samples: int, known: bool = False) -> tuple[dict[str, Array], Motion]:
    """Return hyperparameters around the kernel's start, and random motion. known: whether deflections are known."""
    rng = np.random.default_rng(samples)
    motion, training = (Motion(*rng.uniform(-2, 2, (3, size, kernel.n_joints))) for size in (samples, 20))
    if known:
        deflections = rng.uniform(-1, 1, (samples, 2 * len(ELEMENTS), kernel.n_joints))
        motion = replace(motion, deflections=deflections)
    start = kernel.initial(training, rng.normal(0, 5, training.q.shape))
    return {name: np.asarray(value + 0.3 * rng.standard_normal(value.shape)) for name, value in start.items()}, motion


def formula(case: Case, params: dict[str, Tensor], x: Motion, y: Motion) -> Tensor:
    """Return the covariance of all torques of x and y by the formulas, (N n, M n), differentiable by PyTorch."""
    features, total = iter(case.features), torch.zeros((), dtype=torch.float64)
    for term in case.kernel.terms if isinstance(case.kernel, SumKernel) else (case.kernel,):
        if isinstance(term, PairKernel):
            rows, columns = (
                State(*(torch.from_numpy(part) for part in (state.q, state.v, state.a)))
                for state in (State.rows(x), State.columns(y))
            )
            blocks = torch.as_tensor(term.blocks(params, rows, columns))
            total = total + blocks.permute(2, 0, 3, 1).reshape(x.q.size, y.q.size)
        elif isinstance(term, LinearKernel):
            features_of = next(features)
            one, other = (torch.from_numpy(features_of(each)).reshape(each.q.size, -1) for each in (x, y))
            total = total + (one * torch.as_tensor(term.variances(params))) @ other.T
    return total


def leaves(params: dict[str, Array]) -> dict[str, Tensor]:
    return {name: torch.from_numpy(np.array(value)).requires_grad_() for name, value in params.items()}


def assert_close(found: Array, expected: Array, share: float) -> None:
    assert found.shape == expected.shape
    np.testing.assert_allclose(found, expected, rtol=0, atol=share * np.abs(expected).max(initial=0.0))


@pytest.mark.each_once
@robots
@every_kernel
def test_covariances_equal_the_formula(name: str, joint_types: tuple[str, ...]) -> None:
    case = CASES[name](joint_types)
    kernel, n = case.kernel, len(joint_types)
    for size in SIZES:
        params, motion = draw_problem(kernel, size + 2)
        x, y, constants = motion[:2], motion[2:], leaves(params)
        gram = kernel.gram(params, x, y)
        assert_close(gram, formula(case, constants, x, y).detach().numpy(), case.share)
        assert_close(kernel.gram(params, y, x), gram.T, RELATIVE_TOLERANCE)
        symmetric = kernel.symmetric_gram(params, y)
        assert_close(symmetric, formula(case, constants, y, y).detach().numpy(), case.share)
        assert np.array_equal(symmetric, symmetric.T)
        values = np.linalg.eigvalsh(symmetric)
        assert values[0] >= -RELATIVE_TOLERANCE * values[-1]
        blocks = symmetric.reshape(size, n, size, n)[np.arange(size), :, np.arange(size)]
        assert_close(kernel.variance(params, y), blocks, RELATIVE_TOLERANCE)


@pytest.mark.each_once
@robots
@every_kernel
def test_gradient_equals_automatic_differentiation(name: str, joint_types: tuple[str, ...]) -> None:
    case = CASES[name](joint_types)
    for size in SIZES:
        params, motion = draw_problem(case.kernel, size)
        weight = np.random.default_rng(0).standard_normal((motion.q.size,) * 2)
        weight += weight.T
        tensors = leaves(params)
        total = (torch.from_numpy(weight) * formula(case, tensors, motion, motion)).sum()
        if tensors:
            total.backward()
        found = case.kernel.gradient(params, motion, weight)
        assert found.keys() == tensors.keys() == set(case.kernel.names())
        largest = max((float(each.grad.abs().max()) for each in tensors.values()), default=0.0)
        for key, tensor in tensors.items():
            expected = tensor.grad.numpy()
            bound = case.share * np.abs(expected).max() + 1e-12 * largest
            np.testing.assert_allclose(found[key], expected, rtol=0, atol=bound, err_msg=key)


def check_array_api(kernel: LinearKernel, query: Motion, expected: Array, share: float) -> None:
    """Check the formula of features Φᵀ, (p, n, N), and of their weighted sum, by NumPy and by PyTorch."""
    weights = np.random.default_rng(7).standard_normal(len(expected))
    total = np.einsum("p,pjk->jk", weights, expected)
    parts = query.q, query.dq, query.ddq, query.deflections
    tensors = Motion(*(None if each is None else torch.from_numpy(each) for each in parts))
    for motion in (query, tensors):
        assert_close(np.asarray(kernel.formula(motion)), expected, share)
        assert_close(np.asarray(kernel.weighted(weights, motion)), total, 10 * share)


@pytest.mark.each_once
@robots
@every_kernel
def test_query_covariances_equal_the_formula(name: str, joint_types: tuple[str, ...]) -> None:
    case, n = CASES[name](joint_types), len(joint_types)
    kernel = case.kernel
    for size in SIZES:
        params, motion = draw_problem(kernel, size + 2, known=size > 1)
        query, inducing = motion[:2], motion[2:]
        if isinstance(kernel, PairKernel):
            found = np.full((2, size + 1, n, n), np.nan)  # shows any entry that is not written
            kernel.cross(params, inducing).fill_many(query.arrays(), found)
            expected = formula(case, leaves(params), inducing, query).detach().numpy().reshape(size, n, 2, n)
            assert_close(found[:, :size], expected.transpose(2, 0, 1, 3), case.share)
            assert_close(found[:, size], kernel.variance(params, query), RELATIVE_TOLERANCE)
            assert np.array_equal(found[:, size], found[:, size].transpose(0, 2, 1))
        elif isinstance(kernel, LinearKernel):
            expected = case.features[0](query).transpose(0, 2, 1)
            p = expected.shape[1]
            found = np.full((2, p + 3, n), np.nan)
            kernel.regressor().fill_many(query.arrays(), found, 1)
            assert_close(found[:, 1 : p + 1], expected, case.share)
            assert np.isnan(found[:, [0, p + 1, p + 2]]).all()
            one = np.empty((p, n))
            kernel.regressor().fill(query.arrays()[0], one)
            assert np.array_equal(one, found[0, 1 : p + 1])
            assert_close(kernel.features(query), expected.transpose(0, 2, 1), case.share)
            check_array_api(kernel, query, expected.transpose(1, 2, 0), case.share)
