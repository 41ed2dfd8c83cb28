"""What samples ask of an arm: the problem of `arm.problem`, with what is expected beforehand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from lipcore.arm.problem import Expected, Problem
from lipcore.data.samples import Array, Samples
from lipcore.fitting import noise
from lipcore.fitting.options import FitOptions
from lipcore.kernels.arm_prior import arm_of_robot, chain, in_chain, unit_anywhere, widths_of
from lipcore.kernels.compiled.arm import PARAMETERS
from lipcore.kernels.friction import FRICTION_TERMS, friction_features
from lipcore.kernels.geometry import Geometry
from lipcore.robots.urdf import RigidBody
from lipcore.vocabulary import GeometryMode, JointType


def mode_of(options: FitOptions, robot: RigidBody | None) -> GeometryMode:
    """How a geometry is obtained: learnt, calibrated around a URDF or fixed to it.

    robot: the URDF's bodies, if any. Raise ValueError where `options.geometry` needs a robot and there is none.
    """
    if options.geometry == "auto":
        return "learn" if robot is None else "calibrate"
    if robot is None and options.geometry != "learn":
        raise ValueError(f"geometry is {options.geometry!r}, which needs a robot: a profile such as panda, or a URDF")
    return options.geometry


def make_problem(
    samples: Samples,
    joint_types: Sequence[JointType],
    options: FitOptions,
    gravity: bool,
    robot: RigidBody | None = None,
    every: Samples | None = None,
) -> tuple[Problem, NDArray[np.int64]]:
    """What N samples ask of an arm, base to tip, and the data's joint at each place of the chain, (n,).

    joint_types: (n,), in the order of the data; gravity: whether torques contain it; robot: a URDF's bodies, which the
    geometry and the masses are expected around; every: all samples, which tell how large torques and noise are;
    `samples` where None. Raise ValueError where `options.geometry` needs a robot and there is none.
    """
    mode, n, every = mode_of(options, robot), samples.n_joints, samples if every is None else every
    order = chain(robot, n)
    motions, tau = _in_chain(samples, order)
    usual = np.sqrt(np.mean(every.tau**2, axis=0))[order]
    floor, start = noise.floor(every)[order], noise.start(every)[order]
    speed = np.maximum(np.sqrt(np.mean(every.dq**2, axis=0))[order], 1e-3)
    # friction's weights of a joint, as large as its torque
    friction = np.stack([usual / speed, usual, usual], axis=1).reshape(-1) + floor.repeat(len(FRICTION_TERMS))
    anywhere = unit_anywhere(float(usual.max()), n)
    body, centre = anywhere, np.zeros((n, PARAMETERS))
    if robot is not None and mode != "learn":
        arm = arm_of_robot(robot, gravity, options.prior)
        masses, rotors = arm.unit[: PARAMETERS * n].reshape(n, -1), arm.unit[PARAMETERS * n :]
        body, centre = np.concatenate([masses[order].reshape(-1), rotors[order]]), arm.centre
    types = tuple(joint_types[joint] for joint in order)
    return (
        Problem(
            motions,
            tau,
            np.ones(tau.shape),
            joint_friction(motions[:, 1]),
            np.concatenate([centre.reshape(-1), np.zeros(n + len(friction))]),
            np.concatenate([body, friction]),
            start,
            floor,
            _expected(types, gravity, robot, mode),
        ),
        order,
    )


def with_samples(problem: Problem, samples: Samples, order: NDArray[np.int64]) -> Problem:
    """The same expectations with N other samples, each counted in full. order: (n,), as of `make_problem`."""
    motions, tau = _in_chain(samples, order)
    friction = joint_friction(motions[:, 1], problem.friction_terms > len(FRICTION_TERMS))
    return replace(problem, motions=motions, tau=tau, counts=np.ones(tau.shape), friction=friction)


def _in_chain(samples: Samples, order: NDArray[np.int64]) -> tuple[Array, Array]:
    """Motions (N, 3, n) and torques (N, n) from base to tip."""
    parts = [in_chain(part, order) for part in (samples.q, samples.dq, samples.ddq)]
    return np.ascontiguousarray(np.stack(parts, axis=1)), in_chain(samples.tau, order)


def _expected(
    types: tuple[JointType, ...], gravity: bool, robot: RigidBody | None, mode: GeometryMode
) -> Expected | None:
    if mode == "fixed":
        return None
    if mode == "calibrate" and robot is not None:
        around = Geometry.from_robot(robot, gravity)
        return Expected(widths_of(around), around)
    n = len(types)
    any_arm = Geometry(
        types,
        np.tile(np.eye(3), (n, 1, 1)),
        np.zeros((n, 3)),
        np.tile([0.0, 0.0, 1.0], (n, 1)),
        np.array([0.0, 0.0, -1.0 if gravity else 0.0]),
    )
    return Expected.anything(any_arm)


def with_stribeck(problem: Problem) -> Problem:
    """The same with friction's fourth term, whose weights may be as large as a joint's torque, like the Coulomb ones
    before their scale was fitted."""
    n = problem.n_joints
    first, usual = (PARAMETERS + 1) * n, np.sqrt(np.mean(problem.tau**2, axis=0)) + problem.floor
    scale = np.concatenate([problem.scale[first:].reshape(n, -1), usual[:, None]], axis=1)
    return replace(
        problem,
        friction=joint_friction(problem.motions[:, 1], stribeck=True),
        centre=np.concatenate([problem.centre[:first], np.zeros(scale.size)]),
        scale=np.concatenate([problem.scale[:first], scale.reshape(-1)]),
    )


def joint_friction(dq: Array, stribeck: bool = False) -> Array:
    """Friction's features P of N velocities, joint by joint (section 5 of docs/method.md): (N, n, f n).

    dq: (N, n) rad/s or m/s; stribeck: whether friction has its fourth term.
    """
    size, n = dq.shape
    features = friction_features(torch.from_numpy(np.ascontiguousarray(dq)), stribeck).numpy()  # (f, N, n)
    out = np.zeros((size, n, n, len(features)))
    joints = np.arange(n)
    out[:, joints, joints] = features.transpose(1, 2, 0)
    return out.reshape(size, n, -1)
