"""The mounting of a known robot: how its base stands, and where its joints count from.

A URDF states neither. The base is tried in six positions, upright, upside down, or on a wall; the geometry's first two
angles are its tilt from there. (A turn about the first axis is the zero of that joint.) The zeros of the joints are
unknowns δ beside w and θ (`arm.problem`), with

    ∂τ/∂δ_j = ∂(Y π)/∂q_j,    δ ~ N(0, OPTIONS.zero_std²).

If the evidence supports δ, the frames of the geometry turn by it. Without a URDF the geometry contains both.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.linalg import LinAlgError
from scipy.linalg import cho_solve

from lipcore.arm.problem import GeometryPrior, Point, Problem, root_of
from lipcore.arm.scales import rescale
from lipcore.data.motion import Indices
from lipcore.data.samples import Array
from lipcore.kernels.fast.arm import arm_torques
from lipcore.kernels.geometry import Geometry, rotation_of


@dataclass(frozen=True)
class MountingOptions:
    """Prior of a robot's mounting."""

    min_nats: float = 7.0
    """Min gain in evidence for another position of the base: one robot in a thousand has one."""
    min_samples: float = 9.9
    """Min effective samples for it. A recording in which joints hardly move fits a wrong position as well."""
    zero_std: float = float(np.radians(1.0))
    """Prior standard deviation of a joint's zero, rad (m)."""
    min_zero_nats: float = 3.0
    """Min gain in evidence of the zeros."""
    rounds: int = 3
    """Max steps of a first descent at a position, and max steps of the zeros."""
    step: float = 1e-4
    """Step of the derivative by position, rad (m)."""


OPTIONS = MountingOptions()
UPRIGHT = "as in the URDF"
POSITIONS = {
    UPRIGHT: (0.0, 0.0, 0.0),
    "upside down": (np.pi, 0.0, 0.0),
    "on a wall, +x up": (0.0, -np.pi / 2, 0.0),
    "on a wall, -x up": (0.0, np.pi / 2, 0.0),
    "on a wall, +y up": (np.pi / 2, 0.0, 0.0),
    "on a wall, -y up": (-np.pi / 2, 0.0, 0.0),
}
"""Positions of the base: rotation vectors, rad. The named axis of the URDF's base points up."""


@dataclass(frozen=True)
class Zeros:
    """Zeros of n joints, base to tip."""

    mean: Array
    """(n,) rad (m): the measured position is that of the URDF minus this."""
    std: Array
    """Posterior standard deviations, (n,)."""
    nats: float
    """Gain in evidence."""


@dataclass(frozen=True)
class Mounting:
    """The mounting of a known robot, and the problem and its optimum with it."""

    position: str
    """One of POSITIONS."""
    zeros: Zeros
    problem: Problem
    point: Point

    def report(self, geometry: Geometry, order: Indices) -> dict[str, float | int | bool | str]:
        """Return where it differs from the URDF's, degrees, or mm for zeros of prismatic joints.

        geometry: as learnt in the end; order: (n,), the data's joint at each place of the chain.
        """
        assert self.problem.expected is not None
        assert self.problem.expected.around is not None
        out: dict[str, float | int | bool | str] = {"zero_nats": self.zeros.nats}
        if self.position != UPRIGHT:
            out["mounting"] = self.position
        if geometry.gravity.any():
            out["base_tilt"] = round(tilt_deg(geometry, self.problem.expected.around), 3)
        if self.zeros.nats:
            for joint, place in enumerate(np.argsort(order)):
                unit = float(np.degrees(1.0)) if geometry.joint_types[place] == "revolute" else 1e3
                out[f"zero_{joint + 1}"] = round(unit * float(self.zeros.mean[place]), 3)
                out[f"std_of_zero_{joint + 1}"] = round(unit * float(self.zeros.std[place]), 3)
        return out


def find_mounting(problem: Problem, point: Point, steps: int, stop: Callable[[], bool]) -> Mounting:
    """Return the mounting with the highest evidence.

    point: the optimum as in the URDF; steps: max steps of a descent; stop: called at every step. Raise LinAlgError if
    the evidence cannot be computed.
    """
    position, problem, point = find_position(problem, point, steps, stop)
    problem, point, zeros = find_zeros(problem, point, steps, stop)
    return Mounting(position, zeros, problem, point)


def mount(geometry: Geometry, position: str) -> Geometry:
    """Return the geometry with its base in one of POSITIONS."""
    turn = rotation_of(np.array(POSITIONS[position]))
    rotation, translation = geometry.rotation.copy(), geometry.translation.copy()
    rotation[0], translation[0] = turn @ rotation[0], turn @ translation[0]
    return replace(geometry, rotation=rotation, translation=translation)


def find_position(problem: Problem, point: Point, steps: int, stop: Callable[[], bool]) -> tuple[str, Problem, Point]:
    """Return the position of the base with the highest evidence, one of POSITIONS, with the problem and its optimum.

    point: the optimum as in the URDF; steps: max steps of a descent. Raise LinAlgError if the evidence cannot be
    computed.
    """
    assert problem.expected is not None
    assert problem.expected.around is not None
    best = UPRIGHT, problem, point
    if not np.any(point.geometry.gravity) or problem.counts.mean(axis=1).sum() < OPTIONS.min_samples:
        return best
    for position in list(POSITIONS)[1:]:
        start = mount(problem.expected.around, position)
        mounted = around(problem, start)
        try:
            trial = mounted.descend(start, point.sigma, OPTIONS.rounds, stop)
        except LinAlgError:  # far from any optimum
            continue
        if trial.value < min(best[2].value, point.value - OPTIONS.min_nats):
            best = position, mounted, trial
    position, mounted, trial = best
    if position == UPRIGHT:
        return best
    trial = mounted.descend(trial.geometry, trial.sigma, steps, stop)
    # a URDF whose masses are wrong fits badly in every position, so they may differ more
    gain = rescale(problem, point).value - rescale(mounted, trial).value
    return (position, mounted, trial) if gain > OPTIONS.min_nats else (UPRIGHT, problem, point)


def tilt_deg(geometry: Geometry, other: Geometry) -> float:
    """Return the angle between gravity in the first joint's frame of two geometries, degrees."""
    one, two = (each.rotation[0].T @ each.gravity for each in (geometry, other))
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(one, two)), one @ two)))


def around(problem: Problem, geometry: Geometry) -> Problem:
    """Return the problem with its geometry's prior around another one."""
    assert problem.expected is not None
    return replace(problem, expected=GeometryPrior(problem.expected.widths, geometry))


def find_zeros(problem: Problem, point: Point, steps: int, stop: Callable[[], bool]) -> tuple[Problem, Point, Zeros]:
    """Return the zeros of a known robot's joints, and the problem and its optimum with them if the evidence is for it.

    point: the optimum without; steps: max steps of a descent. Raise LinAlgError if the evidence cannot be computed.
    """
    assert problem.expected is not None
    assert problem.expected.around is not None
    total, found = np.zeros(problem.n_joints), estimate_zeros(problem, point, 0.0)
    nats = found.nats
    if nats < OPTIONS.min_zero_nats:
        return problem, point, replace(found, mean=total, nats=0.0)
    for _ in range(OPTIONS.rounds):
        problem = around(problem, turn_joints(problem.expected.around, found.mean))
        point = problem.descend(turn_joints(point.geometry, found.mean), point.sigma, steps, stop)
        total = total + found.mean
        found = estimate_zeros(problem, point, total)
        if (np.abs(found.mean) < 0.1 * found.std).all():
            break
    return problem, point, Zeros(total, found.std, nats)


def estimate_zeros(problem: Problem, point: Point, known: Array | float) -> Zeros:
    """Return the step of the zeros from a point, with w and θ integrated out.

    known: zeros that the point's geometry already has, (n,).
    """
    hessian, gradient, _ = problem.normal(point)
    weight = np.sqrt(problem.counts) / point.sigma
    both = np.concatenate([point.features, problem.shapes(point)], axis=2) * weight[:, :, None]
    own = slopes_by_position(problem, point) * weight[:, :, None]
    flat, zero = both.reshape(-1, both.shape[2]), own.reshape(-1, own.shape[2])
    cross, right = flat.T @ zero, zero.T @ (problem.residual(point) * weight).reshape(-1)
    solved = cho_solve((root_of(hessian), True), np.column_stack([cross, gradient]), check_finite=False)
    # in units of the prior
    scale = OPTIONS.zero_std
    precision = scale**2 * (zero.T @ zero - cross.T @ solved[:, :-1]) + np.eye(len(right))
    pull = scale * (right - cross.T @ solved[:, -1]) - known / scale
    root = root_of(precision)
    mean = cho_solve((root, True), pull, check_finite=False)
    std = np.sqrt(np.diag(cho_solve((root, True), np.eye(len(right)), check_finite=False)))
    return Zeros(scale * mean, scale * std, float(0.5 * pull @ mean - np.log(root.diagonal()).sum()))


def slopes_by_position(problem: Problem, point: Point) -> Array:
    """Return ∂(Y π)/∂q of a point, (N, n, n), by central differences."""
    n, geometry, parameters = problem.n_joints, point.geometry, problem.parameters(point)
    out = np.empty((*problem.tau.shape, n))
    for joint in range(n):
        ends = []
        for sign in (1, -1):
            motions, torque = problem.motions[:, :3].copy(), np.empty(problem.tau.shape)
            motions[:, 0, joint] += sign * OPTIONS.step
            arm_torques(geometry.constants, geometry.gravity, parameters, np.arange(n), motions, torque)
            ends.append(torque)
        out[:, :, joint] = (ends[0] - ends[1]) / (2 * OPTIONS.step)
    return out


def turn_joints(geometry: Geometry, zeros: Array) -> Geometry:
    """Return the geometry with each joint turned, or shifted, along its axis. zeros: (n,) rad (m)."""
    rotation, translation = geometry.rotation.copy(), geometry.translation.copy()
    for j, kind in enumerate(geometry.joint_types):
        along = geometry.axis[j] * zeros[j]
        if kind == "revolute":
            rotation[j] = rotation[j] @ rotation_of(along)
        else:
            translation[j] = translation[j] + rotation[j] @ along
    return replace(geometry, rotation=rotation, translation=translation)
