"""Construction of the problem of `arm.problem` from samples and a prior."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lipcore.arm.problem import GeometryPrior, Point, Problem
from lipcore.data.samples import Array, Samples
from lipcore.estimators import noise
from lipcore.estimators.task import Task
from lipcore.kernels.arm_prior import Arm, arm_of_robot, in_chain, unit_from_torque
from lipcore.kernels.drive.kernel import Bodies, Drive, Elements
from lipcore.kernels.drive.play import element_widths
from lipcore.kernels.drive.terms import BASE_TERMS, MAX_GAIN_STD, SIGN_WIDTH, check_kinds
from lipcore.kernels.fast.arm import PARAMETERS
from lipcore.kernels.geometry import Geometry
from lipcore.vocabulary import DriveKind, GeometryMode, JointType


def mode_of(task: Task) -> GeometryMode:
    """Return how a task obtains the geometry: learnt, calibrated around a URDF or a sibling, or fixed to it.

    Raise ValueError if `options.geometry` needs one of them and there is none.
    """
    asked, around = task.options.geometry, task.robot is not None or task.sibling is not None
    if asked == "auto":
        return "calibrate" if around else "learn"
    if not around and asked != "learn":
        raise ValueError(f"geometry is {asked!r}, which needs a robot: a profile such as panda, or a URDF")
    return asked


def surroundings(task: Task) -> Arm | None:
    """Return the prior arm of a task, that of the sibling or of the URDF; None if the arm is learnt without a prior.

    `options.geometry` and `options.prior` select it. Raise ValueError like `mode_of`, or if the prior is "urdf" and the
    URDF has no masses.
    """
    mode = mode_of(task)
    if mode == "learn":
        return None
    if task.sibling is None:
        assert task.robot is not None  # `mode_of` has checked it
        return arm_of_robot(task.robot, task.gravity, task.options.prior, mode)
    if mode == "calibrate":
        return task.sibling
    return replace(task.sibling, mode=mode, expected=np.zeros(0), widths=np.zeros(0))


def make_problem(
    samples: Samples,
    joint_types: Sequence[JointType],
    order: NDArray[np.int64],
    gravity: bool,
    around: Arm | None = None,
    every: Samples | None = None,
) -> Problem:
    """Return the problem of learning an arm from N samples, base to tip.

    joint_types: (n,), in the order of the data; order: (n,), the data's joint at each place of the chain; gravity:
    whether torques contain it; around: prior arm of geometry and masses; every: all samples, for the size of torques
    and noise, `samples` if None.
    """
    n, every = samples.n_joints, samples if every is None else every
    drive = Drive(n)
    motions, tau = _in_chain(samples, order)
    usual = np.sqrt(np.mean(every.tau**2, axis=0))[order]
    floor, start = noise.floor(every)[order], noise.start(every)[order]
    speed = np.sqrt(np.mean(every.dq**2, axis=0))[order]
    speed[speed < SIGN_WIDTH] = 1.0  # of a joint that stood still
    # the prior std of a joint's friction weights is its torque
    friction = np.stack([usual / speed, usual, usual], axis=1).reshape(-1) + floor.repeat(len(BASE_TERMS))
    anywhere = unit_from_torque(float(usual.max()), n)
    body, centre = anywhere, np.zeros((PARAMETERS + 1) * n)
    if around is not None:
        masses, rotors = around.unit[: PARAMETERS * n].reshape(n, -1), around.unit[PARAMETERS * n :]
        body = np.concatenate([masses[order].reshape(-1), rotors[order]])
        centre = np.concatenate([around.centre.reshape(-1), around.rotor[order]])
    types = tuple(joint_types[joint] for joint in order)
    unit = np.concatenate([body, friction])
    return Problem(
        motions,
        tau,
        np.ones(tau.shape),
        drive.features(motions),
        np.concatenate([centre, np.zeros(len(friction))]),
        unit,
        unit,
        start,
        floor,
        _expected(types, gravity, around),
        drive,
        np.ones((n, len(BASE_TERMS)), np.bool_),
    )


def with_samples(problem: Problem, samples: Samples, order: NDArray[np.int64]) -> Problem:
    """Return the same problem with N other samples of weight one. order: (n,), as in `make_problem`."""
    motions, tau = _in_chain(samples, order)
    friction = problem.drive.features(motions)
    return replace(problem, motions=motions, tau=tau, counts=np.ones(tau.shape), friction=friction)


def _in_chain(samples: Samples, order: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return motions, as of `Motion.arrays`, and torques (N, n) from base to tip."""
    return np.ascontiguousarray(samples.motion().arrays()[:, :, order]), in_chain(samples.tau, order)


def _expected(types: tuple[JointType, ...], gravity: bool, around: Arm | None) -> GeometryPrior | None:
    if around is not None:
        return GeometryPrior(around.widths, around.geometry.moved(around.expected)) if around.steps else None
    n = len(types)
    any_arm = Geometry(
        types,
        np.tile(np.eye(3), (n, 1, 1)),
        np.zeros((n, 3)),
        np.tile([0.0, 0.0, 1.0], (n, 1)),
        np.array([0.0, 0.0, -1.0 if gravity else 0.0]),
    )
    return GeometryPrior.anything(any_arm)


def with_kind(problem: Problem, point: Point, kind: DriveKind, joints: NDArray[np.bool_]) -> Problem:
    """Return the same problem with another kind of friction. The load is that of a point's bodies.

    joints: (n,), those that have the kind. The prior std of a new term is that of the Coulomb term, for the term's
    largest size in the samples; that of a gain is MAX_GAIN_STD.
    """
    n, first, before = problem.n_joints, problem.bodies, problem.drive
    kinds, elements = check_kinds((*before.kinds, kind)), before.elements
    if kind == "play":
        usual = np.sqrt(np.mean(problem.motions[:, 2] ** 2, axis=0)).clip(1e-3)
        elements = Elements(element_widths(point.geometry.joint_types), usual)
    drive = Drive(n, kinds, _carried(problem, point), elements)
    terms, known = drive.terms, before.terms
    largest = np.abs(drive.by_joint(problem.motions)).max(axis=0)  # (n, f)
    unit, scale = np.empty((2, n, len(terms)))
    used = np.empty(unit.shape, np.bool_)
    for place, term in enumerate(terms):
        used[:, place] = problem.used[:, known.index(term)] if term in known else joints
    for values, old in ((unit, problem.unit), (scale, problem.scale)):
        of_joint = old[first:].reshape(n, -1)
        for place, term in enumerate(terms):
            if term in known:
                values[:, place] = of_joint[:, known.index(term)]
            elif term == "gain":
                values[:, place] = MAX_GAIN_STD
            else:
                values[:, place] = of_joint[:, BASE_TERMS.index("coulomb")] / np.maximum(largest[:, place], 1e-3)
    return replace(
        problem,
        friction=drive.features(problem.motions),
        drive=drive,
        used=used,
        centre=np.concatenate([problem.centre[:first], np.zeros(unit.size)]),
        scale=np.concatenate([problem.scale[:first], scale.reshape(-1)]),
        unit=np.concatenate([problem.unit[:first], unit.reshape(-1)]),
    )


def _carried(problem: Problem, point: Point) -> Bodies:
    return Bodies(point.geometry, problem.parameters(point), np.arange(problem.n_joints))


def with_load(problem: Problem, point: Point) -> Problem:
    """Return the same problem with the load of a point's bodies."""
    if not problem.drive.needs_bodies:
        return problem
    drive = replace(problem.drive, bodies=_carried(problem, point))
    return replace(problem, drive=drive, friction=drive.features(problem.motions))
