"""A payload estimated from the rows since it was taken up, together with what they tell of the arm.

What is unknown are the arm's whitened variables w, with its geometry θ, and the payload's η (`bodies`). The most likely
ones minimise

    E = ½ |e|² + ½ |m(w, θ)|² + ½ (η − η₀)ᵀ P (η − η₀),

where e is what the rows' torque is off, whitened by the covariance of their errors, and m what the arm's training says
(`lipcore.model.memory`). Torque is linearised around each step (`lipcore.model.payload`), steps are Levenberg's and
Marquardt's, and the covariance is that of the linear model around the last one (Laplace).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import qr, solve_triangular

from lipcore.data.motion import Motion
from lipcore.data.samples import Array
from lipcore.kernels.arm_prior import Alternative
from lipcore.model.payload import Carrier, Load
from lipcore.online.batch import Rows
from lipcore.online.bodies import ANY, Known, body, inverse
from lipcore.online.draws import SEED, Draw, Place, Point, Training, arms, linearised_around, minimum
from lipcore.online.errors import correlation_roots, whitened
from lipcore.online.estimate import Estimate, Seen, alone, rows_of
from lipcore.online.linear import linear
from lipcore.robots.urdf import PARAMETERS

FIRST, ROUNDS, FEW = 30, 8, 4
"""Steps at most of an estimate from nothing, of one that begins at another, and of a draw from its posterior: an answer
waits for them."""
LINEAR, SOFT, FAR = 2.0, 3.0, 10.0
"""The mean square, in deviations of the linear posterior, up to which it is as good; and the energies above the least,
for each number that is unknown, nats, over which a draw counts e times less, as it has not come far enough yet, and
from which on rows have ruled it out."""
MEDIAN = 0.6745
"""Of the absolute value of what has a normal distribution, standard deviations."""


def estimate(
    carrier: Carrier,
    rows: Rows,
    before: Rows | None = None,
    prior: Known = ANY,
    start: Estimate | None = None,
    anew: bool = False,
) -> Estimate:
    """The payload that rows carry. before: rows that do not, whose errors tell those of the first that do; start:
    another estimate by the same carrier, or by another revision of its version, to begin at; anew: whether to draw
    from the posterior again, where it was as good as linear or rows have ruled draws out."""
    if not carrier.bends:
        return linear(carrier, rows, before, prior, start)
    problem, size = _Problem.of(carrier, rows, before, prior), len(carrier.mean)
    if start is not None and len(start.load.mean) != size + PARAMETERS:
        start = None
    draw = np.random.default_rng([SEED, len(rows)])
    at = minimum(problem, problem.at(problem.begin(start)), FIRST if start is None else ROUNDS)
    # with more rows, what was as good as linear stays so
    settled = start is not None and not start.draws and not anew
    drawn = [] if settled else _draws(problem, at, () if start is None else start.draws, draw, anew)
    if drawn:  # each of which is the minimum for other noise
        other = minimum(problem, min([point for point, _ in drawn], key=lambda each: each.energy), ROUNDS)
        at = min([at, other], key=lambda each: each.energy)
    # not from the curvature, of whose condition the root is enough: a covariance above the prior's is none
    root = solve_triangular(qr(at.derivative, mode="r")[0][: size + PARAMETERS], np.eye(size + PARAMETERS))
    eta = at.place.eta
    payload, slope = body(eta)
    outward = np.zeros((size + PARAMETERS, size + PARAMETERS))
    outward[:size, :size], outward[size:, size:] = carrier.memory.root, slope
    outward = outward @ root
    room = PARAMETERS * np.diagonal(slope @ inverse(prior.precision) @ slope.T)
    others, bent = _others(carrier, at, root, [point for point, _ in drawn])
    draws = tuple(Draw(point.place, noise) for point, noise in drawn) if bent else ()
    load = Load(np.concatenate([at.place.w, payload]), outward @ outward.T, room, at.place.geometry, others)
    of_eta = max(1.0, at.misfit) * root[size:] @ root[size:].T
    if others:
        wider = _wider(np.sqrt(np.diagonal(of_eta)), [point.place.eta - eta for point, _ in drawn])
        of_eta *= np.outer(wider, wider)
    return Estimate(eta, of_eta, load, *problem.gains(at), draws)


@dataclass(frozen=True, eq=False)
class _Problem:
    """What is minimised. loaded, free: motions with a payload, and without; tau: of both, the free ones first, (N, n)
    N·m; roots: see `correlation_roots`, of both."""

    carrier: Carrier
    training: Training
    loaded: Seen
    free: Seen | None
    tau: Array
    prior: Known
    roots: Array

    @classmethod
    def of(cls, carrier: Carrier, rows: Rows, before: Rows | None, prior: Known) -> _Problem:
        def seen(motion: Motion) -> Seen:
            return motion, carrier.rest(motion)

        before = before if before is not None and len(before) else None
        both = rows if before is None else Rows.concatenate([before, rows])
        return cls(
            carrier,
            Training.of(carrier),
            seen(rows.motion()),
            None if before is None else seen(before.motion()),
            both.tau,
            prior,
            correlation_roots(carrier, both),
        )

    def begin(self, start: Estimate | None) -> Place:
        """Where to begin."""
        geometry = None if start is None else start.load.geometry
        if geometry is None:
            geometry = self.carrier.term.arm.geometry.moved(self.carrier.step)
        if start is None:
            return Place(self.carrier.mean, geometry, self.prior.centre)
        return Place(start.load.mean[:-PARAMETERS], geometry, start.eta)

    def at(self, place: Place) -> Point:
        """The energy of a place."""
        trained, size = self.training.at(place), len(place.w)
        payload, slope = body(place.eta)
        features, torque = rows_of(linearised_around(self.carrier, place, payload), *self.loaded)
        if self.free is not None:
            others, torque_free = rows_of(linearised_around(self.carrier, place, np.zeros(PARAMETERS)), *self.free)
            others[-PARAMETERS:] = 0.0
            features, torque = np.concatenate([others, features], axis=1), np.concatenate([torque_free, torque])
        features, off = whitened(self.roots, features, torque - self.tau)
        root = np.linalg.cholesky(self.prior.precision).T
        by_rows = np.hstack([features[:size].T @ self.carrier.memory.root, features[size:].T @ slope])
        derivative = np.concatenate([trained.derivative, by_rows])
        derivative[len(trained.derivative) - PARAMETERS : len(trained.derivative), size:] = root
        residual = np.concatenate([trained.residual, off])
        residual[len(trained.residual) - PARAMETERS : len(trained.residual)] = root @ (place.eta - self.prior.centre)
        return Point(place, residual, derivative, float((off**2).mean()))

    def gains(self, at: Point) -> tuple[float, float]:
        """Nats by which a payload, and a contact of constant torque, explain the rows better than the arm does without
        either, which is linear then."""
        least, volume, contact = alone(self.carrier, self.free, self.loaded, self.tau, self.roots)
        curved = np.linalg.slogdet(at.derivative.T @ at.derivative)[1] - np.linalg.slogdet(self.prior.precision)[1]
        return self.training.alone + least - at.energy + 0.5 * (volume - float(curved)), contact


def _draws(
    problem: _Problem, at: Point, known: Sequence[Draw], draw: np.random.Generator, anew: bool
) -> list[tuple[Point, Array]]:
    """Draws from the posterior, with their noise: minima for other noise of the training, of what is known of payloads
    and of the rows (randomised maximum likelihood, Kitanidis 1995, Oliver et al. 1996). known: of fewer rows; anew:
    whether those that rows have ruled out begin again."""

    def sought(begin: Draw, rounds: int = FEW) -> tuple[Point, Array]:
        noise = np.append(begin.noise, draw.standard_normal(problem.tau.size))
        return minimum(problem, problem.at(begin.place), rounds, noise), begin.noise

    def carrying(arm: Draw) -> Draw:
        return replace(arm, place=replace(arm.place, eta=at.place.eta))

    # another revision of the training may know more, or less
    known = [each for each in known if len(each.noise) == len(at.residual) - problem.tau.size]
    draws = [sought(each) for each in known or [carrying(arm) for arm in arms(problem.carrier)]]
    if anew:
        out = _ruled_out(min([at, *(point for point, _ in draws)], key=lambda each: each.energy))
        for place, (point, _) in enumerate(draws):
            if point.energy > out:
                draws[place] = sought(carrying(problem.training.drawn(draw)), FIRST)
    return draws


def _wider(std: Array, off: Sequence[Array]) -> Array:
    """How many times wider than the linear posterior's std, (10,), draws lie about its mean, at least once; by the
    median, as some have not come far enough yet. off: of each draw, (10,)."""
    return np.maximum(1.0, np.median(np.abs(off), axis=0) / (MEDIAN * std))


def _ruled_out(least: Point) -> float:
    """Energy from which on a draw is ruled out, nats."""
    return least.energy + FAR * len(least.derivative.T)


def _others(carrier: Carrier, at: Point, root: Array, points: Sequence[Point]) -> tuple[tuple[Alternative, ...], bool]:
    """Arms all over the posterior where it is far from linear, the most likely one first; and whether it is.

    Few rows leave a curved valley open, along which a centre of mass and the geometry make up for each other, and the
    linear posterior is tangent to it at one place.
    """
    reached = [each for each in points if each.energy < _ruled_out(at)]
    known = [each.place for each in reached]
    if not known:
        return (), bool(points)
    off = [np.zeros(len(root))]
    for each in known:
        w = solve_triangular(carrier.memory.root, each.w - at.place.w, lower=True, check_finite=False)
        off.append(solve_triangular(root, np.append(w, each.eta - at.place.eta), check_finite=False))
    if np.square(off[1:]).mean() < LINEAR:
        return (), False
    excess = np.array([each.energy - at.energy for each in (at, *reached)])
    shares = np.exp(-excess / (SOFT * len(root)))
    return tuple(
        carrier.alternative(each.w, each.geometry, body(each.eta)[0], share)
        for each, share in zip((at.place, *known), shares / shares.sum(), strict=True)
    ), True
