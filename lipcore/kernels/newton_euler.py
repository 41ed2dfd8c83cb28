"""The torque of rigid bodies as a formula: Newton–Euler, section 5 of docs/method.md.

`kernels.fast.arm` computes the same torque and its derivatives for `ArmKernel`, compiled.
"""

from __future__ import annotations

from array_api_compat import array_namespace

from lipcore.data.motion import Array
from lipcore.kernels.base import State
from lipcore.kernels.geometry import Geometry


def rigid_body_torque(geometry: Geometry, bodies: Array, x: State) -> Array:
    """Return Y(θ; q, v, a) π at a batch of motions, (n, *batch) N·m, joints base to tip.

    A body has mass m, first moment h and inertia I about its joint's origin. The origin moves with ω, α and a, which is
    acceleration minus gravity. The body needs the force m a + α × h + ω × (ω × h) and the moment h × a + I α + ω × I ω;
    all in the base's frame.

    geometry: θ; bodies: π, (n, 10) base to tip; x: motion of the joints base to tip.
    """
    xp, n = array_namespace(bodies), geometry.n_joints
    rotation, translation, axes, turned = (
        xp.asarray(each) for each in (geometry.rotation, geometry.translation, geometry.axis, geometry.turn_parts)
    )
    still = xp.zeros((*x.q.shape[1:], 3), dtype=bodies.dtype)
    turn, omega, alpha, a = xp.eye(3, dtype=bodies.dtype), still, still, still - xp.asarray(geometry.gravity)
    along, places, forces, moments = [], [], [], []
    for j, kind in enumerate(geometry.joint_types):
        position, speed, rate = (each[j][..., None] for each in (x.q, x.v, x.a))
        place, turn = _times(turn, translation[j]), turn @ rotation[j]
        axis = _times(turn, axes[j])
        sliding = _cross(omega, axis) * speed
        if kind == "prismatic":
            place = place + axis * position
        a = a + _cross(alpha, place) + _cross(omega, _cross(omega, place))
        if kind == "prismatic":
            a = a + axis * rate + 2 * sliding
        else:
            omega, alpha = omega + axis * speed, alpha + axis * rate + sliding
        sine, cosine = xp.sin(position)[..., None], xp.cos(position)[..., None]
        turn = turn @ (turned[j, 0] + sine * turned[j, 1] + cosine * turned[j, 2])

        mass, h, (xx, xy, yy, xz, yz, zz) = bodies[j, 0], _times(turn, bodies[j, 1:4]), bodies[j, 4:]
        tensor = xp.reshape(xp.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz]), (3, 3))
        inertia = turn @ tensor @ turn.mT
        forces.append(mass * a + _cross(alpha, h) + _cross(omega, _cross(omega, h)))
        moments.append(_cross(h, a) + _times(inertia, alpha) + _cross(omega, _times(inertia, omega)))
        along.append(axis)
        places.append(place)
    force, moment, torques = forces[-1], moments[-1], []
    for j in range(n - 1, -1, -1):  # sums over all bodies from joint j to the tip, about its origin
        if j < n - 1:
            moment = moments[j] + moment + _cross(places[j + 1], force)
            force = forces[j] + force
        torques.append((along[j] * (force if geometry.joint_types[j] == "prismatic" else moment)).sum(-1))
    return xp.stack(torques[::-1])


def _times(matrix: Array, vector: Array) -> Array:
    return (matrix @ vector[..., None])[..., 0]


def _cross(one: Array, other: Array) -> Array:
    return array_namespace(one).linalg.cross(one, other)
