"""Arms as they are built: axes at right angles to each other, at the zero pose and up to a turn about the vertical.

Of an axis that a recording leaves open, one of six directions is far more likely than any other. A *layout* names for
each joint the direction of its axis, or none. Given a layout the axes are expected within TURN_WIDTH of it, the free
ones anywhere; layouts are weighed by their evidence, with the geometry integrated out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.linalg import LinAlgError

from lipcore.arm.problem import ANGLE, LENGTH, Expected, Point, Problem
from lipcore.data.samples import Array
from lipcore.kernels.geometry import Geometry, aligned, rotation_of

DIRECTIONS = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float64)
TURN_WIDTH = 0.01
"""How far an axis at a right angle may lie from it, standard deviation in rad."""
NEAR_RAD = np.radians(12.0)
"""An axis within this angle of a direction is tried there at once."""
RIGHT_SHARE = 0.9
"""Share of all axes that lie at right angles."""
ROWS, BEAM, STEPS, SWEEPS, NEAR_NATS, GAIN_NATS = 80, 3, 5, 3, 7.0, 1.0

Layout = tuple[int | None, ...]


@dataclass(frozen=True)
class Candidate:
    """A geometry under a layout. evidence: −log, nats, with the geometry integrated out and the layout's own share."""

    layout: Layout
    problem: Problem
    point: Point
    evidence: float


def weigh(problem: Problem, point: Point, layout: Layout) -> Candidate:
    """Weigh a point of a problem under a layout; raise LinAlgError where that cannot be computed."""
    assert problem.expected is not None
    snapped = sum(each is not None for each in layout)
    share = snapped * np.log(RIGHT_SHARE / len(DIRECTIONS)) + (len(layout) - snapped) * np.log(1 - RIGHT_SHARE)
    occam = float(np.log(problem.expected.widths).sum())
    return Candidate(layout, problem, point, problem.laplace(point) + occam - share)


def likely(problem: Problem, ends: Sequence[Point], stop: Callable[[], bool] | None = None) -> list[Candidate]:
    """Layouts near some optima that are more likely than the first of these is without one: at most BEAM, best first.

    They are looked for on few rows of the problem, which count for all: axes near a direction are put there, then each
    joint in turn is tried in all directions, the surest first, until that gains nothing.
    """
    rows = np.unique(np.linspace(0, len(problem.tau) - 1, ROWS).round().astype(np.int64))
    few = problem.rows(rows)
    few = replace(few, counts=few.counts * (len(problem.tau) / len(rows)))
    sigma, found = ends[0].sigma, dict[Layout, Candidate]()

    def settled(geometry: Geometry, layout: Layout) -> Candidate:
        if layout not in found:
            found[layout] = _settled(few, geometry, layout, sigma)
        return found[layout]

    for end in ends[:BEAM]:
        geometry, off = _turned(end.geometry)
        nearest = (DIRECTIONS @ _axes(geometry).T).argmax(axis=0)
        best = settled(geometry, tuple(int(d) if angle < NEAR_RAD else None for d, angle in zip(nearest, off, strict=True)))
        for _ in range(SWEEPS):
            before = best.evidence
            for joint in np.argsort(off):
                for direction in (*range(len(DIRECTIONS)), None):
                    layout = (*best.layout[:joint], direction, *best.layout[joint + 1 :])
                    trial = settled(best.point.geometry, layout)
                    best = min(best, trial, key=lambda each: each.evidence)
                    if stop is not None and stop():
                        break
            if best.evidence > before - GAIN_NATS:
                break
    limit = weigh(few, few.at(ends[0].geometry, sigma), (None,) * problem.n_joints).evidence
    ranked = sorted(found.values(), key=lambda each: each.evidence)
    return [each for each in ranked[:BEAM] if each.evidence < min(limit, ranked[0].evidence + NEAR_NATS)]


def shares(found: Sequence[Candidate]) -> Array:
    """Probabilities of candidates, (K,)."""
    evidence = np.array([each.evidence for each in found])
    odds = np.exp(np.maximum(evidence.min() - evidence, -2 * NEAR_NATS))  # none of zero: a covariance is made of them
    return np.asarray(odds / odds.sum())


def certainty(found: Sequence[Candidate]) -> Array:
    """How probable it is that each axis lies at right angles, (n,)."""
    snapped = np.array([[direction is not None for direction in each.layout] for each in found])
    return np.asarray(shares(found) @ snapped)


def _settled(problem: Problem, geometry: Geometry, layout: Layout, sigma: Array, steps: int = STEPS) -> Candidate:
    """The optimum of a layout that a geometry leads to."""
    start = laid_out(geometry, layout)
    problem = replace(problem, expected=expected(start, layout))
    try:
        return weigh(problem, problem.descend(start, sigma, steps, noise=False), layout)
    except LinAlgError:
        return Candidate(layout, problem, problem.at(start, sigma), np.inf)


def expected(geometry: Geometry, layout: Layout) -> Expected:
    """What a layout expects around a geometry that has it: axes there, shifts within LENGTH of none."""
    turn = np.array([ANGLE if each is None else TURN_WIDTH for each in layout])
    joints = np.concatenate([np.full(count, joint) for joint, count in enumerate(geometry.screws)]).astype(int)
    around = replace(geometry, translation=np.zeros_like(geometry.translation))
    return Expected(np.where(geometry.turns, turn[joints], LENGTH), around)


def laid_out(geometry: Geometry, layout: Layout) -> Geometry:
    """The geometry with its axes turned into a layout; where they are, and free axes, stay."""
    turns, places = geometry.placements(np.zeros(geometry.n_joints))
    for joint, direction in enumerate(layout):
        if direction is not None:
            turns[joint] = aligned(DIRECTIONS[direction]) @ aligned(geometry.axis[joint]).T
    before = np.concatenate([np.eye(3)[None], turns[:-1]])
    rotation = before.mT @ turns
    steps = np.diff(places, axis=0, prepend=np.zeros((1, 3)))
    return replace(geometry, rotation=rotation, translation=(before.mT @ steps[..., None])[..., 0])


def _axes(geometry: Geometry) -> Array:
    """Directions of the axes in the base's frame at the zero pose, (n, 3)."""
    turns, _ = geometry.placements(np.zeros(geometry.n_joints))
    return np.asarray((turns @ geometry.axis[..., None])[..., 0])


def _turned(geometry: Geometry) -> tuple[Geometry, Array]:
    """The arm turned about the vertical so that most axes lie at right angles, and how far off each is, (n,) rad."""
    best, turned, off = np.inf, geometry, np.zeros(geometry.n_joints)
    for yaw in np.radians(np.arange(0.0, 90.0, 0.5)):
        turn = rotation_of(np.array([0.0, 0.0, yaw]))
        angle = np.arccos(np.clip((_axes(geometry) @ turn.T @ DIRECTIONS.T).max(axis=1), -1, 1))
        score = float(np.minimum(angle, np.radians(20)).sum())
        if score < best:
            best, off = score, angle
            rotation, translation = geometry.rotation.copy(), geometry.translation.copy()
            rotation[0], translation[0] = turn @ rotation[0], turn @ translation[0]
            turned = replace(geometry, rotation=rotation, translation=translation)
    return turned, off
