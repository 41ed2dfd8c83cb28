"""Arms as they are built: axes at right angles to each other, in the zero pose and up to a turn about the vertical.

If a recording does not identify the direction of an axis, one of six directions is far more likely than any other. A
*layout* contains for each joint the direction of its axis, or None. Given a layout, the prior of these axes is near
their directions, and that of free axes is anywhere. Layouts are weighed by their evidence, with the geometry integrated
out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.linalg import LinAlgError

from lipcore.arm.problem import WIDTHS, GeometryPrior, Point, Problem
from lipcore.data.motion import spaced_rows
from lipcore.data.samples import Array
from lipcore.kernels.geometry import Geometry, rotation_of, rotation_to_axis

DIRECTIONS = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float64)
TYPICAL_LAYOUTS = {7: ("zyzyzyz", "zyzYzyz"), 6: ("zyyxyx", "zyyyzy")}
"""Axes of common arms in their zero pose, base to tip; capitals are negative directions."""


@dataclass(frozen=True)
class LayoutOptions:
    """Tolerance of right angles, and effort of the search for layouts."""

    turn_width_rad: float = 0.01
    """Standard deviation of an axis from its right angle."""
    near_rad: float = float(np.radians(12.0))
    """Max angle between an axis and a direction, at which the axis is set to it at once."""
    right_share: float = 0.9
    """Share of all axes that are built at right angles."""
    rows: int = 80
    """Rows of a problem on which layouts are compared."""
    steps: int = 5
    """Steps of each descent."""
    max_kept: int = 3
    max_improved: int = 2
    max_sweeps: int = 3
    """Max number of layouts that are kept, of layouts that are improved, and of passes over all joints."""
    near_nats: float = 7.0
    """Difference from the best candidate at which a candidate has a thousandth of its probability."""
    min_gain_nats: float = 1.0
    """Min gain of a pass over all joints that is followed by another one."""


OPTIONS = LayoutOptions()

Layout = tuple[int | None, ...]
"""For each joint, base to tip, the row of DIRECTIONS of its axis, or None for a free axis."""


@dataclass(frozen=True)
class Candidate:
    """A geometry under a layout.

    evidence: −log, nats, with the geometry integrated out and the probability of the layout included.
    """

    layout: Layout
    problem: Problem
    point: Point
    evidence: float


def weigh(problem: Problem, point: Point, layout: Layout) -> Candidate:
    """Return a candidate for a point of a problem under a layout.

    A fixed geometry is not integrated out. Raise LinAlgError if the evidence cannot be computed.
    """
    if problem.expected is None:
        return Candidate(layout, problem, point, point.value)
    snapped = sum(each is not None for each in layout)
    share = snapped * np.log(OPTIONS.right_share / len(DIRECTIONS)) + (len(layout) - snapped) * np.log(
        1 - OPTIONS.right_share
    )
    occam = float(np.log(problem.expected.widths).sum())
    return Candidate(layout, problem, point, problem.laplace(point) + occam - share)


def likely_layouts(
    problem: Problem,
    ends: Sequence[Point],
    known: Sequence[Geometry] = (),
    stop: Callable[[], bool] | None = None,
) -> list[Candidate]:
    """Return at most `max_kept` layouts that are more likely than the first of some optima without a layout.

    They are compared on few rows of the problem, weighted for all rows. A search starts at the optima, with axes near a
    direction set to it, at known geometries, and at TYPICAL_LAYOUTS. The best of these are improved: each joint in turn
    is tried in all directions, until a pass gains nothing or after `max_sweeps` passes.
    """
    rows = spaced_rows(len(problem.tau), OPTIONS.rows)
    few = problem.rows(rows)
    few = replace(few, counts=few.counts * (len(problem.tau) / len(rows)))
    search = _Search(few, ends[0].sigma, stop)
    typical = [tuple(map("xXyYzZ".index, axes)) for axes in TYPICAL_LAYOUTS.get(problem.n_joints, ())]
    starts = [
        *(search.nearest(end.geometry, OPTIONS.near_rad) for end in ends[: OPTIONS.max_kept]),
        *(search.nearest(geometry, np.inf) for geometry in known),
        *(search.settle(ends[0].geometry, layout) for layout in typical),
    ]
    for start in sorted({each.layout: each for each in starts}.values(), key=_evidence)[: OPTIONS.max_improved]:
        search.improve(start)
    limit = weigh(few, few.at(ends[0].geometry, ends[0].sigma), (None,) * problem.n_joints).evidence
    ranked = sorted(search.found.values(), key=_evidence)
    return [
        each
        for each in ranked[: OPTIONS.max_kept]
        if each.evidence < min(limit, ranked[0].evidence + OPTIONS.near_nats)
    ]


@dataclass
class _Search:
    """The layouts tried on some rows, with a noise of sigma, (n,) N·m."""

    problem: Problem
    sigma: Array
    stop: Callable[[], bool] | None
    found: dict[Layout, Candidate] = field(default_factory=dict)

    def settle(self, geometry: Geometry, layout: Layout) -> Candidate:
        """Return the optimum of a layout. The first call determines it, from a geometry."""
        if layout not in self.found:
            start = apply_layout(geometry, layout)
            posed = replace(self.problem, expected=expected_layout(start, layout))
            try:
                end = weigh(posed, posed.descend(start, self.sigma, OPTIONS.steps, noise=False), layout)
            except LinAlgError:
                end = Candidate(layout, posed, posed.at(start, self.sigma), np.inf)
            self.found[layout] = end
        return self.found[layout]

    def nearest(self, geometry: Geometry, within: float) -> Candidate:
        """Return the optimum after axes within an angle of a direction are set to it. within: rad."""
        turned, off = _turn_upright(geometry)
        nearest = (DIRECTIONS @ _axes(turned).T).argmax(axis=0)
        return self.settle(
            turned, tuple(int(at) if angle < within else None for at, angle in zip(nearest, off, strict=True))
        )

    def improve(self, best: Candidate) -> None:
        """Try each joint in all directions until a pass gains nothing."""
        for _ in range(OPTIONS.max_sweeps):
            before = best.evidence
            for joint in range(len(best.layout)):
                for direction in (*range(len(DIRECTIONS)), None):
                    if self.stop is not None and self.stop():
                        return
                    layout = (*best.layout[:joint], direction, *best.layout[joint + 1 :])
                    best = min(best, self.settle(best.point.geometry, layout), key=_evidence)
            if best.evidence > before - OPTIONS.min_gain_nats:
                return


def _evidence(candidate: Candidate) -> float:
    return candidate.evidence


def candidate_probabilities(found: Sequence[Candidate]) -> Array:
    """Return the probabilities of candidates, (K,)."""
    evidence = np.array([each.evidence for each in found])
    odds = np.exp(
        np.maximum(evidence.min() - evidence, -2 * OPTIONS.near_nats)
    )  # never zero, because a covariance is computed from them
    return np.asarray(odds / odds.sum())


def right_angle_probabilities(found: Sequence[Candidate]) -> Array:
    """Return the probability that each axis is at a right angle, (n,)."""
    snapped = np.array([[direction is not None for direction in each.layout] for each in found])
    return np.asarray(candidate_probabilities(found) @ snapped)


def expected_layout(geometry: Geometry, layout: Layout) -> GeometryPrior:
    """Return the prior of a layout around a geometry that has it: axes in its directions, shifts near zero."""
    turn = np.array([WIDTHS.angle if each is None else OPTIONS.turn_width_rad for each in layout]).repeat(
        geometry.screws
    )
    around = replace(geometry, translation=np.zeros_like(geometry.translation))
    return GeometryPrior(np.where(geometry.turns, turn, WIDTHS.length), around)


def apply_layout(geometry: Geometry, layout: Layout) -> Geometry:
    """Return the geometry with its axes turned into a layout. Free axes and the places of axes do not change."""
    turns, places = geometry.placements(np.zeros(geometry.n_joints))
    for joint, direction in enumerate(layout):
        if direction is not None:
            turns[joint] = rotation_to_axis(DIRECTIONS[direction]) @ rotation_to_axis(geometry.axis[joint]).T
    before = np.concatenate([np.eye(3)[None], turns[:-1]])
    rotation = before.mT @ turns
    steps = np.diff(places, axis=0, prepend=np.zeros((1, 3)))
    return replace(geometry, rotation=rotation, translation=(before.mT @ steps[..., None])[..., 0])


def _axes(geometry: Geometry) -> Array:
    """Return the directions of the axes in the base's frame in the zero pose, (n, 3)."""
    turns, _ = geometry.placements(np.zeros(geometry.n_joints))
    return np.asarray((turns @ geometry.axis[..., None])[..., 0])


def _turn_upright(geometry: Geometry) -> tuple[Geometry, Array]:
    """Return the arm turned about the vertical to put most axes at right angles, and the remaining angles, (n,) rad."""
    axes = _axes(geometry)
    turns = [rotation_of(np.array([0.0, 0.0, yaw])) for yaw in np.radians(np.arange(0.0, 90.0, 0.5))]
    angles = [np.arccos(np.clip((axes @ turn.T @ DIRECTIONS.T).max(axis=1), -1, 1)) for turn in turns]
    best = int(np.argmin([np.minimum(each, np.radians(20)).sum() for each in angles]))
    rotation, translation = geometry.rotation.copy(), geometry.translation.copy()
    rotation[0], translation[0] = turns[best] @ rotation[0], turns[best] @ translation[0]
    return replace(geometry, rotation=rotation, translation=translation), angles[best]
