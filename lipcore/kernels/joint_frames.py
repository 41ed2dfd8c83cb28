"""The torque of an arm in the frames of its joints, number by number, in as few operations as possible.

`newton_euler` computes the same in the frame of the base, whole arrays at a time. This form is for programs of single
operations, see `lipcore.kernels.graph`. The frames are chosen so that most of their numbers are zero:

- z is the joint's axis, and the frame before is turned about x only: R = Rx(α) exp(tilt×) Rz(q + φ);
- the origin is where the axis comes closest to the one before, so that its place has two numbers;
- masses on a joint's axis belong to the link before, so that a body has seven numbers.

Each number is computed together with its change by a step of the geometry or of the bodies, see `Dual`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lipcore.data.samples import Array
from lipcore.kernels.geometry import Geometry, skew

MIN_SINE = 0.2
"""Sine of the angle between two axes above which they are not treated as parallel."""
ROUNDING = 1e-14
"""Size, relative to one, below which a number of the geometry is zero."""

Pair = tuple[Array, Array]
"""Matrices, and their change."""


@dataclass(frozen=True)
class Dual:
    """A number and its change: a + ε b with ε² = 0. The parts are floats, or objects that calculate like them."""

    value: Any
    change: Any = 0.0

    def __add__(self, other: Dual) -> Dual:
        return Dual(self.value + other.value, self.change + other.change)

    def __sub__(self, other: Dual) -> Dual:
        return Dual(self.value - other.value, self.change - other.change)

    def __mul__(self, other: Dual) -> Dual:
        return Dual(self.value * other.value, self.change * other.value + self.value * other.change)


@dataclass(frozen=True)
class Link:
    """A joint and the body behind it, with their changes."""

    slides: bool
    angle: float
    """α, rad."""
    phase: float
    """φ, rad."""
    tilt: Array
    """Turn about x and y before the turn about z, (2,) rad. It is a step: only its first order counts."""
    place: Pair
    """Origin in the frame before, (3,) m."""
    body: Pair
    """∫ r rᵀ dm of r = (x, y, z, 1), (4, 4): second moments, first moment and mass."""
    gravity: Array | None
    """Gravity in the frame before, (3,) m/s², if this is the first link of an arm."""


def links_of(geometry: Geometry, step: Array, bodies: Array, change: Array) -> tuple[Link, ...]:
    """Return the links, base to tip and arm after arm, with torque Y π and change J δθ + Y δπ.

    step: δθ, (g,), empty for none; bodies: π, change: δπ, (n, 10). The last frame of an arm has the axes of `across`
    and `axis` of the geometry, and its origin.
    """
    arms = ((arm, step[numbers], bodies[joints], change[joints]) for joints, numbers, arm in geometry.arms)
    return tuple(link for parts in arms for link in _links_of_arm(*parts))


def _links_of_arm(geometry: Geometry, step: Array, bodies: Array, change: Array) -> list[Link]:
    n = geometry.n_joints
    numbers = geometry.numbers(step) if len(step) else np.zeros((n, 4))
    axes = np.concatenate([geometry.across, geometry.axis[:, None]], axis=1).mT
    before = np.concatenate([np.eye(3)[None], axes[:-1]])
    turns = before.mT @ geometry.rotation @ axes
    places = (before.mT @ geometry.translation[..., None])[..., 0]
    euler = [_euler(each) for each in turns] + [(0.0, 0.0, 0.0)]
    links, slid = [], 0.0
    for j, kind in enumerate(geometry.joint_types):
        (first, angle, last), following = euler[j], euler[j + 1][0]
        tilts, shifts = np.append(numbers[j, :2], 0.0), np.append(numbers[j, 2:], 0.0)
        own = _frame(turns[j], places[j]), _changed(turns[j] @ skew(tilts), turns[j] @ shifts)
        base = np.asarray(np.linalg.inv(_frame(_about_z(first), np.array([0.0, 0.0, slid]))))
        pair = _product(_fixed(base), _product(own, _fixed(_frame(_about_z(-last)))))
        sine, cosine, place = np.sin(angle), np.cos(angle), pair[0][:3, 3]
        slid = place[1] / sine if abs(sine) > MIN_SINE else -place[2] / cosine
        slid = slid if 0 < j < n - 1 and kind == "revolute" else 0.0
        pair = _product(pair, _fixed(_frame(np.eye(3), np.array([0.0, 0.0, slid]))))
        pair[0][np.abs(pair[0]) < ROUNDING] = 0.0
        tilt = _about_x(angle).T @ pair[1][:3, :3]
        to_own = np.linalg.inv(_frame(axes[j] @ _about_z(following), slid * geometry.axis[j]))
        body = to_own @ _moments(bodies[j]) @ to_own.T, to_own @ _moments(change[j]) @ to_own.T
        placed = pair[0][:3, 3], pair[1][:3, 3]
        tilted = np.array([tilt[2, 1], tilt[0, 2]])
        gravity = None if j else _about_z(first).T @ geometry.gravity
        links.append(Link(kind == "prismatic", angle, last + following, tilted, placed, body, gravity))
    return _grouped(links)


def torque(links: tuple[Link, ...], q: Any, dq: Any, ddq: Any, turn: Any, more: Any = None) -> list[Dual]:
    """Return the torques, (n,), base to tip.

    q, dq, ddq: (n,); turn: sine and cosine of q, (2, n). more: ten parameters of a body to add to the last one. All are
    sequences of floats, or of objects that calculate like them.
    """
    still = [Dual(0.0)] * 3
    turning = turned = moved = still
    at: list[tuple[Any, ...]] = []
    for j, link in enumerate(links):
        if link.gravity is not None:
            turning, turned, moved = still, still, [Dual(-float(each)) for each in link.gravity]
        place, rates = _pairs(link.place), _rates(turning, turned)
        sine, cosine = np.sin(link.phase), np.cos(link.phase)
        z = Dual(sine), Dual(cosine)
        if link.slides:
            place = _added(place, _out_of(link, (Dual(0.0), Dual(1.0)), [Dual(0.0), Dual(0.0), Dual(q[j])]))
        else:
            z = Dual(turn[0][j] * cosine + turn[1][j] * sine), Dual(turn[1][j] * cosine - turn[0][j] * sine)
        moved = _into(link, z, _added(moved, _applied(rates, place)))
        turning, turned = _into(link, z, turning), _into(link, z, turned)
        speed, gain = Dual(dq[j]), Dual(ddq[j])
        along = _cross(turning, [Dual(0.0), Dual(0.0), speed])
        if link.slides:
            moved = _added(moved, along, along, [Dual(0.0), Dual(0.0), gain])
        else:
            turned = _added(turned, along, [Dual(0.0), Dual(0.0), gain])
            turning = [turning[0], turning[1], turning[2] + speed]
        body = [_pairs((one, other)) for one, other in zip(*link.body, strict=True)]
        if more is not None and j == len(links) - 1:
            body = [_added(one, [Dual(each) for each in row]) for one, row in zip(body, _moments(more), strict=True)]
        at.append((link, z, place, *_force(body, turning, turned, moved)))
    out, moment, force = list[Dual](), still, still
    for link, z, place, own_moment, own_force in reversed(at):
        moment, force = _added(moment, own_moment), _added(force, own_force)
        out.append((force if link.slides else moment)[2])
        force = _out_of(link, z, force)
        moment = _added(_out_of(link, z, moment), _cross(place, force))
        if link.gravity is not None:
            moment, force = still, still
    return out[::-1]


def _force(body: Any, turning: Any, turned: Any, moved: Any) -> tuple[list[Dual], list[Dual]]:
    """Return the moment about the origin and the force that a body's motion needs."""
    first, mass, r = [row[3] for row in body[:3]], body[3][3], _rates(turning, turned)
    s, (xx, yy, zz) = body, [each * each for each in turning]
    x = r[2][0] * s[0][1] + r[2][1] * s[1][1] + (zz - yy) * s[1][2] - r[1][0] * s[0][2] - r[1][2] * s[2][2]
    y = r[0][1] * s[1][2] + r[0][2] * s[2][2] + (xx - zz) * s[0][2] - r[2][1] * s[0][1] - r[2][0] * s[0][0]
    z = r[1][2] * s[0][2] + r[1][0] * s[0][0] + (yy - xx) * s[0][1] - r[0][2] * s[1][2] - r[0][1] * s[1][1]
    force = _added([mass * each for each in moved], _applied(r, first))
    return _added([x, y, z], _cross(first, moved)), force


def _rates(turning: Any, turned: Any) -> list[list[Dual]]:
    """Return ω̇× + ω× ω×, (3, 3)."""
    (x, y, z), (a, b, c) = turning, turned
    xx, yy, zz, none = x * x, y * y, z * z, Dual(0.0)
    return [
        [none - (yy + zz), x * y - c, x * z + b],
        [x * y + c, none - (xx + zz), y * z - a],
        [x * z - b, y * z + a, none - (xx + yy)],
    ]


def _into(link: Link, z: Any, vector: Any) -> list[Dual]:
    """Return a vector of the previous frame in the frame of the link."""
    sine, cosine = Dual(np.sin(link.angle)), Dual(np.cos(link.angle))
    x, y = vector[0], cosine * vector[1] + sine * vector[2]
    part = [x, y, cosine * vector[2] - sine * vector[1]]
    x, y, last = (one - other for one, other in zip(part, _cross(_tilt(link), part), strict=True))
    return [z[1] * x + z[0] * y, z[1] * y - z[0] * x, last]


def _out_of(link: Link, z: Any, vector: Any) -> list[Dual]:
    """Return a vector of the frame of the link in the previous frame."""
    sine, cosine = Dual(np.sin(link.angle)), Dual(np.cos(link.angle))
    part = [z[1] * vector[0] - z[0] * vector[1], z[0] * vector[0] + z[1] * vector[1], vector[2]]
    x, y, last = _added(part, _cross(_tilt(link), part))
    return [x, cosine * y - sine * last, sine * y + cosine * last]


def _tilt(link: Link) -> list[Dual]:
    return [*(Dual(0.0, each) for each in link.tilt), Dual(0.0)]


def _pairs(pair: Pair) -> list[Dual]:
    return [Dual(*each) for each in zip(*pair, strict=True)]


def _added(one: Any, *others: Any) -> list[Dual]:
    for other in others:
        one = [a + b for a, b in zip(one, other, strict=True)]
    return list(one)


def _applied(matrix: Any, vector: Any) -> list[Dual]:
    x, y, z = vector
    return [row[0] * x + row[1] * y + row[2] * z for row in matrix]


def _cross(one: Any, other: Any) -> list[Dual]:
    (a, b, c), (x, y, z) = one, other
    return [b * z - c * y, c * x - a * z, a * y - b * x]


def _grouped(links: list[Link]) -> list[Link]:
    """Return the links with all masses on a joint's axis moved to the previous link. Torque stays the same.

    At a prismatic joint, the second moments are moved instead.
    """
    grouped = list[Link]()
    added: Pair = np.zeros((4, 4)), np.zeros((4, 4))
    for link in reversed(links):
        body = link.body[0] + added[0], link.body[1] + added[1]
        mask = np.zeros((4, 4))
        mask[slice(3) if link.slides else slice(2, 4), slice(3) if link.slides else slice(2, 4)] = 1.0
        if len(grouped) < len(links) - 1:
            turn = _about_x(link.angle) @ (_about_z(link.phase) if link.slides else np.eye(3))
            tilt = _about_x(link.angle) @ skew(np.append(link.tilt, 0.0)) @ _about_x(link.angle).T @ turn
            place = _frame(turn, link.place[0]), _changed(tilt, link.place[1])
            moved = body[0] * mask, body[1] * mask
            added = _product(_product(place, moved), (place[0].T, place[1].T))
            body = body[0] - moved[0], body[1] - moved[1]
        grouped.append(replace(link, body=body))
    return grouped[::-1]


def _product(one: Pair, other: Pair) -> Pair:
    return one[0] @ other[0], one[1] @ other[0] + one[0] @ other[1]


def _fixed(matrix: Array) -> Pair:
    return matrix, np.zeros_like(matrix)


def _moments(body: Any) -> Any:
    """Return ∫ r rᵀ dm, (4, 4), of ten parameters."""
    mass, x, y, z, xx, xy, yy, xz, yz, zz = body
    half = (xx + yy + zz) * 0.5
    rows = [[half - xx, -xy, -xz, x], [-xy, half - yy, -yz, y], [-xz, -yz, half - zz, z], [x, y, z, mass]]
    return np.array(rows)


def _frame(turn: Array, place: Array | None = None) -> Array:
    out = np.eye(4)
    out[:3, :3] = turn
    if place is not None:
        out[:3, 3] = place
    return out


def _changed(turn: Array, place: Array) -> Array:
    out = np.zeros((4, 4))
    out[:3, :3], out[:3, 3] = turn, place
    return out


def _euler(turn: Array) -> tuple[float, float, float]:
    """Return the angles of a rotation about z, then x, then z."""
    sine = float(np.hypot(turn[0, 2], turn[1, 2]))
    first = float(np.arctan2(turn[0, 2], -turn[1, 2])) if sine > ROUNDING else 0.0
    left = _about_z(first).T @ turn
    angle = float(np.arctan2(-left[1, 2], left[2, 2]))
    return first, angle, float(np.arctan2(-left[0, 1], left[0, 0]))


def _about_z(angle: float) -> Array:
    sine, cosine = np.sin(angle), np.cos(angle)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def _about_x(angle: float) -> Array:
    sine, cosine = np.sin(angle), np.cos(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, cosine, -sine], [0.0, sine, cosine]])
