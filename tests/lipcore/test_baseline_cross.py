"""Compiled cross covariances of the baselines, as a control loop asks for them, against torch, loops and autograd."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import numpy as np
import pytest
import torch
from torch import Tensor

from lipcore.data.motion import Motion
from lipcore.kernels.base import PairKernel
from lipcore.kernels.compiled.cross import Array
from lipcore.kernels.compiled.gip_cross import fill_gip
from lipcore.kernels.compiled.lane_cross import LANES
from lipcore.kernels.compiled.lse_cross import fill_lse
from lipcore.kernels.compiled.se_cross import fill_se
from tests.lipcore.oracles import instant, scale_of, torque_terms
from tests.lipcore.test_baseline_kernels import BASELINES, KERNELS, gip_loop, lagrangian, random_case, se_loop

RELATIVE = 1e-10
ROBOTS = [
    ("revolute",),
    ("prismatic",),
    ("prismatic", "revolute"),
    ("revolute",) * 7,
    ("revolute", "prismatic", "prismatic", "revolute", "revolute", "prismatic", "revolute"),
]
# part of one block of lanes, with and without room for the query, exactly one, and several
SIZES = [1, LANES - 1, LANES, 2 * LANES + 5]

baselines = pytest.mark.parametrize("name", BASELINES)
robots = pytest.mark.parametrize("joint_types", ROBOTS, ids=lambda kinds: "".join(kind[0] for kind in kinds))


def queries(motion: Motion) -> Array:
    """As a control loop hands them over: (N, 3, n)."""
    return np.ascontiguousarray(torch.stack([motion.q, motion.dq, motion.ddq], dim=1).numpy())


def unwritten(size: int, n: int) -> Array:
    """Where anything left out would show."""
    return np.full((size + 1, n, n), np.nan)


def expected(kernel: PairKernel, params: Mapping[str, Tensor], inducing: Motion, query: Motion) -> Array:
    """The same from the torch form, (S + 1, n, n)."""
    blocks = kernel.gram(params, inducing, query).reshape(len(inducing), kernel.n_joints, kernel.n_joints)
    return torch.cat([blocks, kernel.variance(params, query)]).numpy()


def agree(found: Array, wanted: Array) -> None:
    """Samples and the query itself each to their own size: the prior variance may be far larger than the rest."""
    for one, other in ((found[:-1], wanted[:-1]), (found[-1], wanted[-1])):
        np.testing.assert_allclose(one, other, rtol=0, atol=RELATIVE * np.abs(other).max())


@robots
@baselines
@pytest.mark.parametrize("size", SIZES)
def test_cross_equals_the_torch_form(name: str, joint_types: tuple[str, ...], size: int) -> None:
    kernel, params, motion = random_case(name, joint_types, size + 3)
    inducing, asked = motion[:size], motion[size:]
    cross = kernel.cross(params, inducing)
    assert (cross.n_joints, cross.size) == (len(joint_types), size)
    for k, query in enumerate(queries(asked)):
        before, out = query.copy(), unwritten(size, len(joint_types))
        cross.fill(query, out)
        agree(out, expected(kernel, params, inducing, asked[k : k + 1]))
        assert (out[-1] == out[-1].T).all()
        assert (query == before).all()


@baselines
def test_cross_equals_the_torch_form_at_the_scale_of_an_arm(name: str) -> None:
    joint_types, rng = ("revolute",) * 6 + ("prismatic",), np.random.default_rng(11)
    spread = np.array([[3.0, 2.0, 10.0]]).T[:, None] * rng.uniform(0.2, 1.0, 7)
    motion = Motion.from_arrays(*(rng.uniform(-1, 1, (3, 60, 7)) * spread))
    tau = torch.from_numpy(rng.normal(size=(60, 7)) * [30.0, 60.0, 20.0, 20.0, 3.0, 2.0, 0.5])
    kernel = KERNELS[name](joint_types)
    params = kernel.initial(motion, tau)
    cross, out = kernel.cross(params, motion[:50]), unwritten(50, 7)
    for k, query in enumerate(queries(motion)):
        cross.fill(query, out)
        agree(out, expected(kernel, params, motion[:50], motion[k : k + 1]))
    # the torque of an inducing sample is the same from either side
    cross.fill(queries(motion)[7], out)
    np.testing.assert_allclose(out[7], out[-1], rtol=0, atol=RELATIVE * np.abs(out[-1]).max())


@pytest.mark.parametrize(
    "joint_types", [("revolute",), ("prismatic", "revolute"), ("revolute", "prismatic", "revolute")]
)
def test_lse_cross_equals_automatic_differentiation(joint_types: tuple[str, ...]) -> None:
    kernel, params, motion = random_case("lse", joint_types, samples=4)
    out, energy = unwritten(3, len(joint_types)), lagrangian(joint_types, params)
    kernel.cross(params, motion[:3]).fill(queries(motion)[3], out)
    for s, block in enumerate(out):
        x, y = instant(motion, s), instant(motion, 3)
        terms = torque_terms([energy], x, y)
        assert np.abs(block - terms.sum(0).numpy()).max() < RELATIVE * scale_of([energy], x, y, terms)


@robots
@pytest.mark.parametrize(("name", "loop"), [("se", se_loop), ("gip", gip_loop)], ids=["se", "gip"])
def test_se_and_gip_cross_equal_plain_loops(
    name: str, loop: Callable[..., Array], joint_types: tuple[str, ...]
) -> None:
    kernel, params, motion = random_case(name, joint_types, samples=4)
    out, states = unwritten(3, len(joint_types)), queries(motion)
    kernel.cross(params, motion[:3]).fill(states[3], out)
    values = {key: value.numpy() for key, value in params.items()}
    agree(out, np.stack([loop(joint_types, values, state, states[3]) for state in states]))


@baselines
def test_queries_leave_no_trace(name: str) -> None:
    """Neither earlier queries, nor what was in `out`, nor another Cross, nor hyperparameters changed since, matter."""
    kernel, params, motion = random_case(name, ("revolute", "prismatic", "revolute"), LANES + 9)
    inducing, asked = motion[: LANES + 4], queries(motion[LANES + 4 :])
    fresh = []
    for query in asked:
        fresh.append(unwritten(len(inducing), 3))
        kernel.cross(params, inducing).fill(query, fresh[-1])
    one, out = kernel.cross(params, inducing), unwritten(len(inducing), 3)
    other = kernel.cross({key: value + 0.3 for key, value in params.items()}, inducing)
    for value in params.values():
        value.add_(1.0)
    for k in (0, 1, 0, 4, 2, 3):
        other.fill(asked[k], out)
        assert not np.array_equal(out, fresh[k])
        one.fill(asked[k], out)
        assert np.array_equal(out, fresh[k])
    many = np.full((5, len(inducing) + 1, 3, 3), np.nan)
    one.fill_many(asked, many)
    assert np.array_equal(many, np.stack(fresh))


@baselines
def test_threads_do_not_meet(name: str) -> None:
    """Four threads ask one Cross at the same time, each for a query of its own, over and over."""
    kernel, params, motion = random_case(name, ("revolute",) * 7, 104)
    cross, asked, together = kernel.cross(params, motion[:100]), queries(motion[100:]), Barrier(4)
    alone = np.empty((4, 101, 7, 7))
    cross.fill_many(asked, alone)

    def ask(k: int) -> bool:
        out, same = unwritten(100, 7), True
        together.wait()
        for _ in range(300):
            out[:] = np.nan
            cross.fill(asked[k], out)
            same &= np.array_equal(out, alone[k])
        return same

    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(ask, range(4)))


def test_one_compilation_serves_every_robot() -> None:
    """A second one would stall a control loop for a second; shapes with ones in them are the likely cause."""
    for name in BASELINES:
        for joint_types in ROBOTS:
            kernel, params, motion = random_case(name, joint_types, samples=3)
            for size in (1, 2):
                kernel.cross(params, motion[:size]).fill(queries(motion)[2], unwritten(size, len(joint_types)))
    for dispatcher in (fill_se, fill_gip, fill_lse):
        assert len(getattr(dispatcher, "signatures")) == 1  # noqa: B009
