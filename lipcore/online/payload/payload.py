"""A payload estimated from the rows since it was taken up, together with what they tell of the arm.

What is unknown are the arm's whitened variables w, with its geometry θ, and the payload's η (`bodies`). The most likely
ones minimise

    E = ½ |e|² + ½ |m(w, θ)|² + ½ (η − η₀)ᵀ P (η − η₀),

where e is what the rows' torque is off, whitened by the covariance of their errors, and m what the arm's training says
(`lipcore.model.memory`). Torque is linearised around each step (`lipcore.model.payload`), steps are Levenberg's and
Marquardt's, and the covariance is that of the linear model around the last one (Laplace): `estimate`, which takes
milliseconds. Where few rows leave a bent valley open, that is too sure of itself: `refine` draws from the posterior,
which takes a hundred times as long.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import qr, solve_triangular

from lipcore.data.motion import Motion
from lipcore.data.samples import Array
from lipcore.kernels.arm_prior import Alternative
from lipcore.model.payload import Carrier, Load
from lipcore.online.batch import Rows
from lipcore.online.payload.bodies import ANY, Known, body, inverse
from lipcore.online.payload.draws import DRAWS, Draw, Place, Point, Training, arms, descent, linearised_around, minimum
from lipcore.online.payload.errors import correlation_roots, whitened
from lipcore.online.payload.estimate import Estimate, Seen, alone, rows_of
from lipcore.online.payload.linear import linear
from lipcore.robots.urdf import PARAMETERS


@dataclass(frozen=True)
class EstimateOptions:
    """Steps of an estimate, and how far its draws and its errors are trusted."""

    first_steps: int = 30
    next_steps: int = 2
    refined_steps: int = 8
    draw_steps: int = 2
    """Max steps of an estimate from nothing, of one that begins at another, of a refined one, and of a draw from its
    posterior."""
    max_square: float = 2.0
    """Mean square of draws, in deviations of the linear posterior, up to which that is as good."""
    hot_nats: float = 30.0
    """Energy by which a draw counts e times less: what the training is taken to say of arms far away is off by as
    much."""
    far_nats: float = 100.0
    """Energy from which on rows have ruled a draw out."""
    doubt: float = 5.0
    """Factor by which an estimate takes its rows and the arm's training for less exact than they are, without draws and
    where the last axis is open: linear posteriors of bent valleys are too narrow, and draws come into few valleys.
    Tuned on simulated arms (seed 1 of `benchmarks.online.arms`): after 10, 30 and 100 rows 95 % intervals hold 98, 96
    and 80 % of an unseen motion's torques on the worst of three arms (with 1: 89, 77 and 57); those of the next rows
    are 1.8 to 2.3, 1.5 to 1.7 and 1.2 to 1.3 times as wide."""


OPTIONS = EstimateOptions()


def estimate(
    carrier: Carrier, rows: Rows, before: Rows | None = None, prior: Known = ANY, start: Estimate | None = None
) -> Estimate:
    """The payload that rows carry, in a few milliseconds. before: rows that do not, whose errors tell those of the
    first that do; start: another estimate by the same carrier, or by another revision of its version, to begin at."""
    if not carrier.bends:
        return linear(carrier, rows, before, prior, start)
    problem = _Problem.of(carrier, rows, before, prior)
    start = problem.usable(start)
    at = minimum(
        problem, problem.at(problem.begin(start)), OPTIONS.first_steps if start is None else OPTIONS.next_steps
    )
    return problem.estimate(at)


def refine(
    carrier: Carrier,
    rows: Rows,
    before: Rows | None = None,
    prior: Known = ANY,
    start: Estimate | None = None,
    anew: bool = False,
) -> Generator[None, None, Estimate]:
    """The same estimate with draws from the posterior, for an arm that bends; it yields after each step, so that
    something else can be done meanwhile. anew: whether draws that rows have ruled out begin again."""
    problem = _Problem.of(carrier, rows, before, prior)
    start = problem.usable(start)
    at = yield from descent(
        problem, problem.at(problem.begin(start)), OPTIONS.first_steps if start is None else OPTIONS.refined_steps
    )
    known = () if start is None else start.draws
    # another revision of the training may know more, or less
    known = tuple(each for each in known if each.usable(len(at.residual) - problem.tau.size))
    if not known:
        begun = yield from arms(carrier)
        known = tuple(_carrying(each, at) for each in begun)
    found = []
    for number, each in enumerate(known):
        point = yield from problem.sought(each, number, OPTIONS.draw_steps)
        found.append(_Found(point, each.noise))
    at = min([at, *(each.point for each in found)], key=_energy)
    if anew:
        for number in [number for number, each in enumerate(found) if each.excess(at) > OPTIONS.far_nats]:
            draw = np.random.default_rng([DRAWS.seed, number, len(rows)])
            again = _carrying((yield from problem.training.begun(number, draw)), at)
            point = yield from problem.sought(again, number, OPTIONS.first_steps)
            found[number] = min(found[number], _Found(point, again.noise), key=lambda each: each.point.energy)
    # each draw is the minimum for other noise
    other = yield from descent(problem, min((each.point for each in found), key=_energy), OPTIONS.refined_steps)
    return problem.estimate(min(at, other, key=_energy), found)


def _energy(at: Point) -> float:
    return at.energy


def _carrying(arm: Draw, at: Point) -> Draw:
    """An arm that carries what is most likely."""
    return replace(arm, place=replace(arm.place, eta=at.place.eta))


@dataclass(frozen=True, eq=False)
class _Found:
    """The point that a draw has reached. noise: see `Draw`."""

    point: Point
    noise: Array | None

    def excess(self, least: Point) -> float:
        """Energy above the usual one of a draw, nats: that exceeds the least by half the number of unknowns."""
        usual = 0.0 if self.noise is None else 0.5 * least.derivative.shape[1]
        return self.point.energy - least.energy - usual


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

    def usable(self, start: Estimate | None) -> Estimate | None:
        """An estimate to begin at, None where that is of other variables."""
        known = start is not None and len(start.load.mean) == len(self.carrier.mean) + PARAMETERS
        return start if known else None

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
        root = np.linalg.cholesky(self.prior.precision).T
        _, off = whitened(self.roots, features[:0], torque - self.tau)
        first = len(trained.residual) - PARAMETERS

        def derivative() -> Array:
            along, _ = whitened(self.roots, features, torque - self.tau)
            by_rows = np.hstack([along[:size].T @ self.carrier.memory.root, along[size:].T @ slope])
            out = np.concatenate([trained.derivative, by_rows])
            out[first : len(trained.residual), size:] = root
            return out

        residual = np.concatenate([trained.residual, off])
        residual[first : len(trained.residual)] = root @ (place.eta - self.prior.centre)
        return Point(place, residual, float((off**2).mean()), derivative)

    def sought(self, begin: Draw, number: int, rounds: int) -> Generator[None, None, Point]:
        """A draw from the posterior: the minimum for other noise of the training, of what is known of payloads and of
        the rows (randomised maximum likelihood, Kitanidis 1995, Oliver et al. 1996). number: of the draw, which has the
        same noise of the same rows each time, and is near where it was."""
        of_rows, noise = np.random.default_rng([DRAWS.seed, number]).standard_normal(self.tau.size), begin.noise
        yield
        return (
            yield from descent(self, self.at(begin.place), rounds, 0.0 if noise is None else np.append(noise, of_rows))
        )

    def estimate(self, at: Point, found: Sequence[_Found] = ()) -> Estimate:
        """What is known with the most likely place, and draws."""
        carrier, size = self.carrier, len(self.carrier.mean)
        derivative, first = at.derivative, len(at.residual) - self.tau.size
        sure = bool(found) and not carrier.open_tip
        if not sure:
            doubt = np.full(len(derivative), OPTIONS.doubt)
            doubt[:size] = doubt[first - PARAMETERS : first] = 1.0  # what was expected before anything was seen
            derivative = derivative / doubt[:, None]
        # not from the curvature, of whose condition the root is enough: a covariance above the prior's is none
        root = solve_triangular(qr(derivative, mode="r")[0][: size + PARAMETERS], np.eye(size + PARAMETERS))
        eta = at.place.eta
        payload, slope = body(eta)
        outward = np.zeros((size + PARAMETERS, size + PARAMETERS))
        outward[:size, :size], outward[size:, size:] = carrier.memory.root, slope
        outward = outward @ root
        room = PARAMETERS * np.diagonal(slope @ inverse(self.prior.precision) @ slope.T)
        others, bent = _others(carrier, at, root, found)
        draws = tuple(Draw(each.point.place, each.noise) for each in found) if bent else ()
        load = Load(np.concatenate([at.place.w, payload]), outward @ outward.T, room, at.place.geometry, others)
        of_eta = max(1.0, at.misfit) * root[size:] @ root[size:].T
        if others:
            wider = _wider(np.sqrt(np.diagonal(of_eta)), [each.point.place.eta - eta for each in found])
            of_eta *= np.outer(wider, wider)
        return Estimate(eta, of_eta, load, *self.gains(at), draws, 1.0 if sure else OPTIONS.doubt)

    def gains(self, at: Point) -> tuple[float, float]:
        """Nats by which a payload, and a contact of constant torque, explain the rows better than the arm does without
        either, which is linear then."""
        least, volume, contact = alone(self.carrier, self.free, self.loaded, self.tau, self.roots)
        curved = np.linalg.slogdet(at.derivative.T @ at.derivative)[1] - np.linalg.slogdet(self.prior.precision)[1]
        return self.training.alone + least - at.energy + 0.5 * (volume - float(curved)), contact


def _wider(std: Array, off: Sequence[Array]) -> Array:
    """How many times wider than the linear posterior's std, (10,), draws lie about its mean, at least once; by the
    median, as some have not come far enough yet. off: of each draw, (10,)."""
    # the median of the absolute value of what has a normal distribution is 0.6745 standard deviations
    return np.maximum(1.0, np.median(np.abs(off), axis=0) / (0.6745 * std))


def _others(carrier: Carrier, at: Point, root: Array, found: Sequence[_Found]) -> tuple[tuple[Alternative, ...], bool]:
    """Arms all over the posterior where it is far from linear, the most likely one first; and whether it is.

    Few rows leave a curved valley open, along which a centre of mass and the geometry make up for each other, and the
    linear posterior is tangent to it at one place.
    """
    reached = [each for each in found if each.excess(at) < OPTIONS.far_nats and each.point is not at]
    known = [each.point.place for each in reached]
    if not known:
        return (), bool(found)
    off = [np.zeros(len(root))]
    for each in known:
        w = solve_triangular(carrier.memory.root, each.w - at.place.w, lower=True, check_finite=False)
        off.append(solve_triangular(root, np.append(w, each.eta - at.place.eta), check_finite=False))
    if np.square(off[1:]).mean() < OPTIONS.max_square and not carrier.open_tip:
        return (), False
    shares = np.exp(-np.array([0.0, *(max(0.0, each.excess(at)) for each in reached)]) / OPTIONS.hot_nats)
    return tuple(
        carrier.alternative(each.w, each.geometry, body(each.eta)[0], share)
        for each, share in zip((at.place, *known), shares / shares.sum(), strict=True)
    ), True
