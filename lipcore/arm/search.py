"""The search for an arm's geometry: many starts, then hops from the best optima."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.linalg import LinAlgError

from lipcore.arm.problem import Point, Problem
from lipcore.data.samples import Array
from lipcore.extras import MissingExtraError
from lipcore.kernels.geometry import STANDARD_GRAVITY, Geometry, rotation_of, rotation_to_axis
from lipcore.robots.library import ROBOTS, list_installed_robots
from lipcore.robots.urdf import JointMismatchError, RigidBody
from lipcore.robots.urdf_text import UrdfError
from lipcore.vocabulary import JointType

RIGHT_ANGLE_DIRECTIONS = np.array([[0, 0, 1], [0, 0, -1], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]], np.float64)


@dataclass(frozen=True)
class SearchOptions:
    """Distribution of random arms, and effort of the search."""

    direction_shares: tuple[float, ...] = (0.25, 0.05, 0.175, 0.175, 0.175, 0.175)
    """Shares of axes parallel to the one before, antiparallel or across it, ordered as `RIGHT_ANGLE_DIRECTIONS`."""
    upright_share: float = 0.5
    """Share of arms with an upright first axis."""
    right_base_share: float = 0.7
    """Share of arms with the first axis upright, upside down or horizontal."""
    across_m: float = 0.2
    along_m: float = 0.3
    """Standard deviations of the next axis' place, across and along the one before."""
    screened: int = 400
    """Random arms with a computed evidence."""
    starts: int = 20
    """Number of the best random arms that the search starts from."""
    max_idle: int = 60
    max_idle_at_noise: int = 15
    """Max successive hops without a gain: while residuals exceed the sensor's noise, and when they no longer do."""
    explained_ratio: float = 1.3
    """Max ratio of explained residuals to the sensor's noise."""
    min_gain_nats: float = 1.0
    """Min improvement that counts as a gain."""
    same_nats: float = 0.5
    same_noise: float = 3.0
    check_motions: int = 40
    """Two optima are the same if they differ by at most this many nats, and by this many noise levels of torque at
    these motions."""
    max_kept: int = 6
    """Max number of optima that are kept."""
    steps: int = 25
    """Max steps of a descent."""
    hop_noise: float = 3.0
    min_hop_noise_share: float = 0.02
    """Noise at the start of a hop: this many times that of the optimum, and at least this share of the torque's
    spread."""
    rank_scale: float = 1.5
    """Scale of the exponential distribution of the rank of the optimum that a hop starts from."""


OPTIONS = SearchOptions()


def draw(rng: np.random.Generator, joint_types: tuple[JointType, ...], gravity: bool) -> Geometry:
    """Return a random arm with right angles, its first axis mostly upright, sometimes in any direction.

    joint_types: (n,), base to tip; gravity: whether torques contain it.
    """
    n = len(joint_types)
    rotation, translation = np.empty((n, 3, 3)), np.zeros((n, 3))
    for j in range(n):
        kind = rng.uniform()
        if j or kind >= OPTIONS.upright_share:
            direction = RIGHT_ANGLE_DIRECTIONS[rng.choice(6, p=OPTIONS.direction_shares)]
            if not j:
                direction = RIGHT_ANGLE_DIRECTIONS[rng.integers(6)] if kind < OPTIONS.right_base_share else _unit(rng)
        else:
            direction = RIGHT_ANGLE_DIRECTIONS[0]
        rotation[j] = rotation_to_axis(direction) @ rotation_of(np.array([0.0, 0.0, rng.integers(4) * np.pi / 2]))
        if not j:  # the zero of the first joint relative to a tilt is unknown
            rotation[j] = rotation[j] @ rotation_of(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))
        elif joint_types[j] == "revolute":
            translation[j] = rng.normal(0, [OPTIONS.across_m, OPTIONS.across_m, OPTIONS.along_m])
    axis = np.tile([0.0, 0.0, 1.0], (n, 1))
    return Geometry(joint_types, rotation, translation, axis, weight(gravity)).canonical()


def hop(rng: np.random.Generator, geometry: Geometry) -> Geometry:
    """Return another arm near an optimum: one or two joints turned, mirrored, reversed, moved, perturbed or redrawn."""
    rotation, translation, n = geometry.rotation.copy(), geometry.translation.copy(), geometry.n_joints
    for j in rng.choice(n, min(int(rng.integers(1, 3)), n), replace=False):
        axis, kind = geometry.axis[j], rng.integers(7)
        if kind == 0:  # turns the rest of the arm by a quarter or half about this axis
            rotation[j] = rotation[j] @ rotation_of(axis * rng.choice([0.5, 1.0, -0.5]) * np.pi)
        elif kind == 1:  # sets the axis to a right angle
            rotation[j] = rotation_to_axis(RIGHT_ANGLE_DIRECTIONS[rng.integers(6)]) @ rotation_to_axis(axis).T
        elif kind == 2:  # mirrors the joint about the axis before
            half = rotation_of(np.pi * (geometry.axis[j - 1] if j else np.array([0.0, 0.0, 1.0])))
            rotation[j] = half @ rotation[j] @ half
        elif kind == 3:  # draws the joint again
            rotation[j] = rotation_to_axis(_unit(rng)) @ rotation_of(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))
            translation[j] = rng.normal(0, OPTIONS.along_m, 3)
        elif kind == 4:  # moves the joint to the other side
            translation[j] = -translation[j]
        elif kind == 5:  # reverses the direction of rotation
            rotation[j] = rotation[j] @ rotation_of(np.pi * geometry.across[j, rng.integers(2)])
        else:  # perturbs the joint
            rotation[j] = rotation[j] @ rotation_of(rng.normal(0, 0.5, 3))
            translation[j] = translation[j] + rng.normal(0, OPTIONS.across_m, 3)
    return replace(geometry, rotation=rotation, translation=translation).canonical()


def weight(gravity: bool) -> Array:
    """Return gravity in the base's frame, or zero, (3,) m/s²."""
    return np.array([0.0, 0.0, -STANDARD_GRAVITY if gravity else 0.0])


def _unit(rng: np.random.Generator) -> Array:
    vector = rng.standard_normal(3)
    return np.asarray(vector / np.linalg.norm(vector))


@lru_cache(maxsize=16)
def known_geometries(joint_types: tuple[JointType, ...], gravity: bool) -> tuple[Geometry, ...]:
    """Return the geometries of the robots of ROBOTS with these joints; empty if no URDFs are installed.

    joint_types: (n,), from base to tip; gravity: whether torques contain it. Robots that are no serial arm of such
    joints are skipped.
    """
    geometries = []
    for name in list_installed_robots():
        joints = ROBOTS[name].free
        if len(joints) == len(joint_types):
            with suppress(JointMismatchError, UrdfError, MissingExtraError):
                geometries.append(Geometry.from_robot(RigidBody.from_profile(name, joints, joint_types), gravity))
    return tuple(geometries)


@dataclass(frozen=True)
class SearchResult:
    """Optima and effort of a search."""

    points: tuple[Point, ...]
    """Distinct optima, the best first."""
    starts: int
    """Descents from starts."""
    hops: int
    """Descents from hops."""
    distinct: int
    """Number of distinct optima found."""
    times_best: int
    """Descents that ended in the best optimum."""
    explained: bool
    """Whether the residuals of the best optimum are at the level of the sensor's noise."""
    ended: str
    """`idle`, or `time` if the time limit was reached first."""
    seconds: float
    """Processor time, s."""


def search(
    problem: Problem,
    joint_types: tuple[JointType, ...],
    gravity: bool,
    sensor_noise: Array,
    seconds: float,
    seed: int = 0,
    known: Sequence[Geometry] = (),
    step: Callable[[float, float], None] | None = None,
) -> SearchResult:
    """Return the geometries of the best evidence. `problem` contains few rows, some eighty.

    sensor_noise: (n,) N·m, white noise of the signals; seconds: limit of processor time, which other processes of the
    machine do not use up; known: additional start geometries; step: called with the best value and the fraction of the
    work after each descent, may raise to end the search. Raise LinAlgError if the evidence of no start can be computed.
    """
    rng = np.random.default_rng(seed)
    pool = Pool(problem.recombined(OPTIONS.check_motions))
    spread = problem.tau.std(0)
    wide = 0.3 * spread + problem.floor
    drawn = [draw(rng, joint_types, gravity) for _ in range(OPTIONS.screened)]
    with suppress(LinAlgError):
        problem.descend(drawn[0], wide, 1)  # compiles missing code, which must not count as search time
    began = time.thread_time()
    ranked = sorted(drawn, key=lambda each: _value(problem, each, wide))
    begin = [*known, *ranked[: OPTIONS.starts]]

    def spent() -> float:
        return time.thread_time() - began

    def descend(geometry: Geometry, sigma: Array) -> None:
        try:
            pool.add(problem.descend(geometry, sigma, OPTIONS.steps))
        except LinAlgError:
            pool.failed += 1

    for number, geometry in enumerate(begin):
        descend(geometry, wide)
        if step is not None:
            step(pool.best, 0.4 * (number + 1) / len(begin))
        if spent() > seconds and pool.points:
            break
    if not pool.points:
        raise LinAlgError("the evidence cannot be computed at any start of the search")
    starts, hops, quiet = pool.descents, 0, 0
    while spent() <= seconds and quiet < (
        OPTIONS.max_idle_at_noise if _explained(pool.points[0], sensor_noise, problem.floor) else OPTIONS.max_idle
    ):
        before = pool.best
        chosen = pool.points[min(int(rng.exponential(OPTIONS.rank_scale)), len(pool.points) - 1)]
        descend(
            hop(rng, chosen.geometry),
            np.maximum(OPTIONS.hop_noise * chosen.sigma, OPTIONS.min_hop_noise_share * spread),
        )
        hops += 1
        quiet = 0 if pool.best < before - OPTIONS.min_gain_nats else quiet + 1
        if step is not None:
            step(pool.best, 0.4 + 0.6 * max(quiet / OPTIONS.max_idle, spent() / seconds))
    best = pool.points[0]
    return SearchResult(
        tuple(pool.points),
        starts,
        hops,
        pool.distinct,
        sum(1 for value in pool.ends if value < best.value + OPTIONS.same_nats),
        _explained(best, sensor_noise, problem.floor),
        "time" if spent() > seconds else "idle",
        spent(),
    )


class Pool:
    """Distinct optima, the best first.

    They differ in evidence or, at `checks`, in torque. Mirror images are one optimum.
    """

    def __init__(self, checks: Problem) -> None:
        self.checks = checks
        self.points: list[Point] = []
        self.torques: list[Array] = []
        self.distinct = 0
        self.ends: list[float] = []
        self.failed = 0

    @property
    def best(self) -> float:
        """The lowest value, nats."""
        return self.points[0].value if self.points else np.inf

    @property
    def descents(self) -> int:
        """Number of descents."""
        return len(self.ends) + self.failed

    def add(self, point: Point) -> None:
        """Add the end of a descent, unless a better optimum of the same arm exists."""
        self.ends.append(point.value)
        torque = self.checks.mean(point)
        for place, (other, its) in enumerate(zip(self.points, self.torques, strict=True)):
            error = np.sqrt(np.mean((torque - its) ** 2, axis=0))
            if (
                abs(point.value - other.value) <= OPTIONS.same_nats
                and (error <= OPTIONS.same_noise * point.sigma).all()
            ):
                if point.value < other.value:
                    self._keep(place, point, torque)
                return
        self.distinct += 1
        self._keep(None, point, torque)

    def _keep(self, place: int | None, point: Point, torque: Array) -> None:
        """Insert a point, replacing another one if `place` is given."""
        pairs = [*zip(self.points, self.torques, strict=True)]
        if place is not None:
            del pairs[place]
        pairs = sorted([*pairs, (point, torque)], key=lambda each: each[0].value)[: OPTIONS.max_kept]
        self.points, self.torques = [each for each, _ in pairs], [each for _, each in pairs]


def _explained(point: Point, sensor_noise: Array, floor: Array) -> bool:
    return bool(np.all(point.sigma <= OPTIONS.explained_ratio * np.maximum(sensor_noise, floor)))


def _value(problem: Problem, geometry: Geometry, sigma: Array) -> float:
    try:
        return problem.at(geometry, sigma).value
    except LinAlgError:
        return np.inf
