"""The torque of rigid bodies and its derivatives as formulas: Newton–Euler, section 5 of docs/method.md.

They are written in the array API: NumPy, PyTorch or JAX compute them. `kernels.fast.arm` computes the same, compiled.

Joints and bodies are in order from base to tip, arm after arm. Coordinates are those of the base; spatial motions
(ω, v) and forces (n, f) are about its origin. The three coordinates are the first axis of an array, then come joints,
then the batch.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import accumulate
from typing import Any

import numpy as np
from array_api_compat import array_namespace

from lipcore.data.motion import Array
from lipcore.kernels.arrays import constant
from lipcore.kernels.base import State
from lipcore.kernels.geometry import Geometry

Spatial = tuple[Array, Array]
"""Motions (ω, v) or forces (n, f)."""


@dataclass(frozen=True)
class Chain:
    """A chain of joints in motion, with the bodies behind them."""

    turn: Array
    """Axes of the bodies' frames, (3, 3, n, *batch)."""
    origin: Array
    """Origins of the bodies' frames, (3, n, *batch)."""
    screw: Spatial
    """S: motions of the bodies at unit speed of their joints."""
    steps: Spatial
    """Screws of the steps of the geometry: two turns and two shifts across each axis, (3, 4, n, *batch) each."""
    before: tuple[Spatial, Spatial]
    """Velocity V and acceleration A, minus gravity, of the bodies before the joints."""
    after: tuple[Spatial, Spatial]
    """The same of the bodies behind them."""


@dataclass(frozen=True)
class Bodies:
    """Single bodies, or sums of them."""

    mass: Array
    """(n, *batch)"""
    first: Array
    """First moments h, (3, n, *batch)."""
    inertia: Array
    """Ī about the base's origin, (3, 3, n, *batch)."""
    force: Spatial
    """F = Σ I A + V ×* I V."""
    momentum: Array
    """Linear momenta p, (3, n, *batch)."""
    coriolis: Array
    """N = Σ 2 ω× Ī − tr(Ī) ω× − 2 h× v×, (3, 3, n, *batch), see (17)."""

    def packed(self) -> Array:
        """Return all numbers, (31, n, *batch)."""
        parts = self.mass[None], self.first, self.inertia, *self.force, self.momentum, self.coriolis
        return array_namespace(self.mass).concat([each.reshape(-1, *self.mass.shape) for each in parts])

    @classmethod
    def unpacked(cls, values: Array) -> Bodies:
        """Return the bodies of `packed`."""
        first, moment, force, momentum = (values[at : at + 3] for at in (1, 13, 16, 19))
        inertia, coriolis = (values[at : at + 9].reshape(3, 3, *values.shape[1:]) for at in (4, 22))
        return cls(values[0], first, inertia, (moment, force), momentum, coriolis)

    def behind(self) -> Bodies:
        """Return the sums over all bodies from each joint to the tip."""
        return Bodies.unpacked(_behind(self.packed()))

    def spread(self) -> Bodies:
        """Return the bodies with one more axis after the coordinates."""
        moment, force = _spread(self.force, 1)
        first, momentum = self.first[:, None], self.momentum[:, None]
        return Bodies(self.mass, first, self.inertia[:, :, None], (moment, force), momentum, self.coriolis[:, :, None])


def rigid_body_torque(geometry: Geometry, bodies: Array, x: State) -> Array:
    """Return Y(θ; q, v, a) π at a batch of motions, (n, *batch) N·m.

    geometry: θ; bodies: π, (n, 10); x: motion of the joints.
    """
    torques = [_torque(_chain(arm, x.part(joints)), bodies[joints]) for joints, _, arm in geometry.arms]
    return array_namespace(x.q).concat(torques)


def rigid_body_features(geometry: Geometry, bodies: Array, x: State) -> tuple[Array, Array]:
    """Return Yᵀ, (10 n, n, *batch), and Jᵀ = ∂(Y π)/∂θ, (g, n, *batch), see (12) and (16) of docs/method.md.

    Arguments are those of `rigid_body_torque`. Columns are torques.
    """
    xp, n = array_namespace(x.q), geometry.n_joints
    masses, steps = list[Array](), list[Array]()
    for joints, _, arm in geometry.arms:
        chain = _chain(arm, x.part(joints))
        for rows, of_arm in (
            (masses, _by_bodies(chain)),
            (steps, _by_steps(arm, chain, _bodies(chain, bodies[joints]))),
        ):
            none = xp.zeros_like(of_arm[:, :1])
            rows.append(xp.concat([none] * joints.start + [of_arm] + [none] * (n - joints.stop), axis=1))
    return xp.concat(masses), xp.concat(steps)


def linearised_torque(geometry: Geometry, bodies: Array, x: State, around: Array, step: Array) -> Array:
    """Return Y π + J δθ, (n, *batch) N·m, with J at the bodies `around`, (n, 10). step: δθ, (g,)."""
    torques = []
    for joints, numbers, arm in geometry.arms:
        chain = _chain(arm, x.part(joints))
        torque = _torque(chain, bodies[joints])
        if (own := step[numbers]).any():
            torque = torque + _along(chain, _bodies(chain, around[joints]), arm.numbers(own).T)
        torques.append(torque)
    return array_namespace(x.q).concat(torques)


def _torque(chain: Chain, bodies: Array) -> Array:
    moment, force = _bodies(chain, bodies).force
    return _power(chain.screw, (_behind(moment), _behind(force)))


def _chain(geometry: Geometry, x: State) -> Chain:
    parts = geometry.rotation[:, None] @ geometry.turn_parts
    like = x.q[0]
    xp, none = array_namespace(like), _full(np.zeros(3), like)
    turn, origin, turns, origins, screws, steps = _full(np.eye(3), like), none, [], [], [], []
    velocities, accelerations = [(none, none)], [(none, _full(-geometry.gravity, like))]
    for j, kind in enumerate(geometry.joint_types):
        slides, position = kind == "prismatic", x.q[j]
        place = origin + _times(turn, _full(geometry.translation[j], like))
        across = np.stack([geometry.axis[j], *geometry.across[j]]) @ geometry.rotation[j].T
        axis, one, two = (_times(turn, _full(each, like)) for each in across)
        screw = (none, axis) if slides else (axis, _cross(place, axis))
        tilts = _cross(place, one), _cross(place, two)
        steps.append((xp.stack([one, two, none, none], axis=1), xp.stack([*tilts, one, two], axis=1)))
        change = _motion_cross(velocities[-1], screw)
        accelerations.append(_sum(accelerations[-1], _scaled(screw, x.a[j]), _scaled(change, x.v[j])))
        velocities.append(_sum(velocities[-1], _scaled(screw, x.v[j])))
        origin = place + axis * position if slides else place
        first, sine, cosine = (_full(part, like) for part in parts[j])
        turn = _product(turn, first if slides else first + xp.sin(position) * sine + xp.cos(position) * cosine)
        turns.append(turn)
        origins.append(origin)
        screws.append(screw)
    return Chain(
        xp.stack(turns, axis=2),
        xp.stack(origins, axis=1),
        _stacked(screws, 1),
        _stacked(steps, 2),
        (_stacked(velocities[:-1], 1), _stacked(accelerations[:-1], 1)),
        (_stacked(velocities[1:], 1), _stacked(accelerations[1:], 1)),
    )


def _bodies(chain: Chain, parameters: Array) -> Bodies:
    """Return the single bodies. parameters: mass, first moment and inertia xx, xy, yy, xz, yz, zz, (n, 10)."""
    like, origin = chain.origin[0, 0], chain.origin
    (turning, moving), up = chain.after
    mass, (xx, xy, yy, xz, yz, zz) = parameters[:, 0], parameters[:, 4:].T
    mass = _full(mass, like)
    own = _times(chain.turn, _full(parameters[:, 1:4].T, like))
    turned = _product(chain.turn, _full(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]), like))
    about = (turned[:, None] * chain.turn[None]).sum(2)
    one, first = _full(np.eye(3)[..., None], like), own + mass * origin
    # Steiner: − h× o× − o× h× − m o× o×, with a× b× = b aᵀ − (a·b) 1
    inertia = about + _dot(own + first, origin) * one - _outer(own, origin) - _outer(origin, first)
    momentum = _momentum(mass, first, inertia, (turning, moving))
    force = _sum(_momentum(mass, first, inertia, up), _force_cross((turning, moving), momentum))
    trace = inertia[0, 0] + inertia[1, 1] + inertia[2, 2]
    coriolis = _cross(turning[:, None], 2 * inertia - trace * one)
    coriolis = coriolis - 2 * _outer(moving, first) + 2 * _dot(first, moving) * one
    return Bodies(mass, first, inertia, force, momentum[1], coriolis)


def _by_bodies(chain: Chain) -> Array:
    """Return the derivatives of all torques by the ten parameters of each body, (10 n, n, *batch).

    In the frame of a body, with the screws (s, u) of the joints before it: force and moment times screws,

        mass: a·u     first moment: a × s + u × α + ω (ω·u) − u (ω·ω)     inertia: sᵀ I α + (s × ω)ᵀ I ω

    a, α and ω are the acceleration of the frame's origin, the angular acceleration and the angular velocity.
    """
    xp, origin, n = array_namespace(chain.origin), chain.origin, chain.origin.shape[1]
    (turning, moving), (angular, linear) = chain.after
    linear = linear + _cross(angular, origin) + _cross(turning, moving + _cross(turning, origin))
    # axes: coordinates, joints, bodies, batch
    a, alpha, omega = ((chain.turn * each[:, None]).sum(0)[:, None] for each in (linear, angular, turning))
    tilts, shifts = (each[:, :, None] for each in chain.screw)
    before = _full(np.triu(np.ones((n, n))), chain.origin[0, 0])
    s, u = (
        (chain.turn[:, :, None] * (before * each)[:, None]).sum(0)
        for each in (tilts, shifts + _cross(tilts, origin[:, None]))
    )
    first = _cross(a, s) + _cross(u, alpha) + omega * _dot(omega, u) - u * _dot(omega, omega)
    other = _cross(s, omega)
    inertia = [
        s[k] * alpha[i] + other[k] * omega[i] + (s[i] * alpha[k] + other[i] * omega[k] if k != i else 0)
        for i in range(3)
        for k in range(i + 1)
    ]
    rows = xp.concat([_dot(a, u)[None], first, xp.stack(inertia)])
    return _joints_first(rows).reshape(-1, n, *rows.shape[3:])


def _by_steps(geometry: Geometry, chain: Chain, bodies: Bodies) -> Array:
    """Return ∂τ/∂θ, (g, n, *batch), see (16)."""
    xp, n = array_namespace(chain.origin), chain.origin.shape[1]
    sums = bodies.behind().packed()
    at_later = [xp.concat([*([sums[:, i : i + 1]] * i), sums[:, i:]], axis=1) for i in range(n)]
    later = Bodies.unpacked(xp.stack(at_later, axis=1)).spread()
    eta, zeta = _rates(_spread(chain.before, 1), chain.steps)
    # axes: coordinates, numbers of a step, joints with a torque, joints with a step, batch
    eta, zeta, screw = (_spread(each, 2) for each in (eta, zeta, chain.steps))
    before = _full(np.triu(np.ones((n, n)), 1), chain.origin[0, 0])
    forces = _sum(_changed(later, eta, zeta), _force_cross(screw, _scaled(later.force, before)))
    rows = _joints_first(_power(_spread(_spread(chain.screw, 2), 1), forces))
    return xp.concat([rows[j, :count] for j, count in enumerate(geometry.screws)])


def _along(chain: Chain, bodies: Bodies, step: Array) -> Array:
    """Return J δθ, (n, *batch): (16) summed over all steps. step: four numbers of each joint, (4, n)."""
    numbers, sums = _full(step, chain.origin[0, 0]), bodies.behind()
    screw = (numbers * chain.steps[0]).sum(1), (numbers * chain.steps[1]).sum(1)
    eta, zeta = _rates(chain.before, screw)
    turned = _sum(_changed(sums, eta, zeta), _force_cross(screw, sums.force))  # by each step, of the joints before it
    own = _changed(
        sums, (_ahead(eta[0]), _ahead(eta[1])), (_ahead(zeta[0]), _ahead(zeta[1]))
    )  # by all steps before a joint, and its own
    behind = _sum((_behind(turned[0]), _behind(turned[1])), _scaled(turned, -1.0))
    return _power(chain.screw, _sum(behind, own))


def _rates(before: tuple[Spatial, Spatial], screw: Spatial) -> tuple[Spatial, Spatial]:
    """Return η and ζ, the rates of screws that are fixed to bodies with velocity and acceleration `before`."""
    velocity, acceleration = before
    eta = _motion_cross(velocity, screw)
    return eta, _sum(_motion_cross(acceleration, screw), _motion_cross(velocity, eta))


def _changed(sums: Bodies, eta: Spatial, zeta: Spatial) -> Spatial:
    """Return I ζ + 2 B η, see (15) and (17)."""
    turning, _ = eta
    more = _times(sums.coriolis, turning), 2 * _cross(turning, sums.momentum)
    return _sum(_momentum(sums.mass, sums.first, sums.inertia, zeta), more)


def _momentum(mass: Array, first: Array, inertia: Array, motion: Spatial) -> Spatial:
    """Return the force I x of a motion x."""
    turning, moving = motion
    return (inertia * turning[None]).sum(1) + _cross(first, moving), mass * moving + _cross(turning, first)


def _motion_cross(one: Spatial, other: Spatial) -> Spatial:
    """Return a × b of two motions."""
    return _cross(one[0], other[0]), _cross(one[0], other[1]) + _cross(one[1], other[0])


def _force_cross(motion: Spatial, force: Spatial) -> Spatial:
    """Return a ×* b of a motion and a force."""
    return _cross(motion[0], force[0]) + _cross(motion[1], force[1]), _cross(motion[0], force[1])


def _power(motion: Spatial, force: Spatial) -> Array:
    return _dot(motion[0], force[0]) + _dot(motion[1], force[1])


def _sum(one: Spatial, *others: Spatial) -> Spatial:
    turning, moving = one
    for other in others:
        turning, moving = turning + other[0], moving + other[1]
    return turning, moving


def _scaled(motion: Spatial, factor: Array | float) -> Spatial:
    return motion[0] * factor, motion[1] * factor


def _stacked(parts: list[Spatial], axis: int) -> Spatial:
    xp = array_namespace(parts[0][0])
    return xp.stack([each[0] for each in parts], axis=axis), xp.stack([each[1] for each in parts], axis=axis)


def _behind(values: Array) -> Array:
    """Return sums over all bodies from each joint to the tip, (k, n, *batch)."""
    each = [values[:, j] for j in range(values.shape[1])]
    return array_namespace(values).stack(list(accumulate(reversed(each)))[::-1], axis=1)


def _ahead(values: Array) -> Array:
    """Return sums from the base to each joint, (k, n, *batch)."""
    return array_namespace(values).stack(list(accumulate(values[:, j] for j in range(values.shape[1]))), axis=1)


def _spread(parts: Any, axis: int) -> Any:
    """Return tuples of arrays with one more axis."""
    if isinstance(parts, tuple):
        return tuple(_spread(each, axis) for each in parts)
    return array_namespace(parts).expand_dims(parts, axis=axis)


def _joints_first(rows: Array) -> Array:
    """Return rows with their third axis first."""
    return array_namespace(rows).permute_dims(rows, (2, 0, 1, *range(3, rows.ndim)))


def _cross(one: Array, other: Array) -> Array:
    (a, b, c), (x, y, z) = one, other
    return array_namespace(one).stack([b * z - c * y, c * x - a * z, a * y - b * x])


def _dot(one: Array, other: Array) -> Array:
    return (one * other).sum(0)


def _outer(one: Array, other: Array) -> Array:
    return one[:, None] * other[None]


def _times(matrix: Array, vector: Array) -> Array:
    return (matrix * vector[None]).sum(1)


def _product(one: Array, other: Array) -> Array:
    return (one[:, :, None] * other[None]).sum(1)


def _full(values: Array, like: Array) -> Array:
    """Return numbers for a whole batch, (…, *batch)."""
    fixed = constant(values, like)
    return fixed.reshape(fixed.shape + (1,) * like.ndim) + array_namespace(like).zeros_like(like)
