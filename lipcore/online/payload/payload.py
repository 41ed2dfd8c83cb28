"""Estimate a payload from the rows since it was picked up, together with what they show about the arm.

The unknowns are the arm's whitened variables w, with its geometry θ, and the payload's η (`bodies`). The most likely
ones minimise

    E = ½ |e|² + ½ |m(w, θ)|² + ½ (η − η₀)ᵀ P (η − η₀),

e is the error of the rows' torque, whitened by its covariance, and m the residual of the arm's training
(`lipcore.model.memory`). Torque is linearised around each step (`lipcore.model.payload`), steps are Levenberg's and
Marquardt's, and the covariance is that of the linear model around the last step (Laplace): `estimate`, which takes
milliseconds. If few rows leave a bent valley open, that is too certain: `refine` draws from the posterior, which takes
a hundred times as long. If the arm does not explain the rows, it also tries other directions of the last axes (`axes`).
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import qr, solve_triangular

from lipcore.data.motion import Motion
from lipcore.data.samples import Array
from lipcore.kernels.arm_prior import Alternative
from lipcore.model.payload import Carrier, PayloadPosterior
from lipcore.online.batch import Rows
from lipcore.online.payload.axes import OPTIONS as AXES
from lipcore.online.payload.axes import turn_axes
from lipcore.online.payload.bodies import ANY_PAYLOAD, PayloadPrior, body, inverse
from lipcore.online.payload.draws import (
    DRAWS,
    ArmWithPayload,
    Draw,
    Point,
    Training,
    descent,
    draw_arms,
    linearised_around,
    minimum,
)
from lipcore.online.payload.errors import correlation_roots, excess_variance, whiten
from lipcore.online.payload.estimate import Estimate, Instants, explain_unloaded, rows_of
from lipcore.online.payload.linear import linear
from lipcore.robots.urdf import PARAMETERS


@dataclass(frozen=True)
class EstimateOptions:
    """Steps of an estimate, and the certainty of its draws and its errors."""

    first_steps: int = 30
    next_steps: int = 2
    refined_steps: int = 8
    draw_steps: int = 2
    """Max steps of a first estimate, of one that starts from another, of a refined one, and of a draw from its
    posterior."""
    max_square: float = 2.0
    """Max mean square of draws, in deviations of the linear posterior, at which the linear one suffices."""
    hot_nats: float = 30.0
    """Energy by which a draw counts e times less: the stored training is as inexact for arms far away."""
    far_nats: float = 100.0
    """Energy at which rows have ruled a draw out."""
    doubt: float = 5.0
    """Factor on the errors of the rows and of the arm's training, without draws and if the last axis is open. Linear
    posteriors of bent valleys are too narrow, and draws reach few valleys. Tuned on simulated arms (seed 1 of
    `benchmarks.online.arms`). After 10, 30 and 100 rows the coverage of the 95 % intervals on an unseen motion is 98,
    96 and 80 % on the worst of three arms (with 1: 89, 77 and 57). Intervals of the next rows are 1.8 to 2.3, 1.5 to
    1.7 and 1.2 to 1.3 times as wide."""


OPTIONS = EstimateOptions()


def estimate(
    carrier: Carrier,
    rows: Rows,
    before: Rows | None = None,
    prior: PayloadPrior = ANY_PAYLOAD,
    start: Estimate | None = None,
) -> Estimate:
    """Return the payload of the rows, within a few milliseconds.

    before: rows without it, whose errors correlate with those of the first rows with it; start: another estimate to
    start from, by the same carrier or another revision of its version.
    """
    if not carrier.is_nonlinear:
        return linear(carrier, rows, before, prior, start)
    problem = _Problem.of(carrier, rows, before, prior)
    start = problem.select_start(start)
    at = minimum(
        problem, problem.at(problem.make_start(start)), OPTIONS.first_steps if start is None else OPTIONS.next_steps
    )
    return problem.estimate(at)


def refine(
    carrier: Carrier,
    rows: Rows,
    before: Rows | None = None,
    prior: PayloadPrior = ANY_PAYLOAD,
    start: Estimate | None = None,
    anew: bool = False,
) -> Generator[None, None, Estimate]:
    """Return the same estimate with draws from the posterior, for an arm that bends; yield after each step.

    anew: whether draws that rows have ruled out start again.
    """
    problem = _Problem.of(carrier, rows, before, prior)
    start = problem.select_start(start)
    at = yield from descent(
        problem, problem.at(problem.make_start(start)), OPTIONS.first_steps if start is None else OPTIONS.refined_steps
    )
    known = () if start is None else start.draws
    # another revision may have another number of residuals
    known = tuple(each for each in known if each.is_usable(len(at.residual) - problem.tau.size))
    fresh = not known
    if fresh:
        begun = yield from draw_arms(carrier)
        known = tuple(_add_payload(each, at) for each in begun)
    turned = (yield from problem.search_axes(at)) if fresh or anew else []
    if turned:
        at = turned[0]
        known = tuple(_move_draw(each, number, turned) for number, each in enumerate(known))
    found = []
    for number, each in enumerate(known):
        point = yield from problem.follow_draw(each, number, OPTIONS.first_steps if turned else OPTIONS.draw_steps)
        found.append(_DrawResult(point, each.noise))
    at = min([at, *(each.point for each in found)], key=_energy)
    if anew and not turned:
        for number in [number for number, each in enumerate(found) if each.excess(at) > OPTIONS.far_nats]:
            draw = np.random.default_rng([DRAWS.seed, number, len(rows)])
            again = _add_payload((yield from problem.training.start_draw(number, draw)), at)
            point = yield from problem.follow_draw(again, number, OPTIONS.first_steps)
            found[number] = min(found[number], _DrawResult(point, again.noise), key=lambda each: each.point.energy)
    # each draw is the minimum for other noise
    other = yield from descent(problem, min((each.point for each in found), key=_energy), OPTIONS.refined_steps)
    return problem.estimate(min(at, other, key=_energy), found)


def _energy(at: Point) -> float:
    return at.energy


def _add_payload(arm: Draw, at: Point) -> Draw:
    """Return an arm with the most likely payload."""
    return replace(arm, place=replace(arm.place, eta=at.place.eta))


def _move_draw(draw: Draw, number: int, arms: Sequence[Point]) -> Draw:
    """Return a draw that starts at one of these arms, or at the first with another last axis if it has no noise."""
    if draw.noise is None:
        return replace(draw, place=arms[0].place.with_axis(arms[0].place.geometry.n_joints - 1, number))
    return replace(draw, place=arms[number % len(arms)].place)


@dataclass(frozen=True, eq=False)
class _DrawResult:
    """The point that a draw has reached. noise: see `Draw`."""

    point: Point
    noise: Array | None

    def excess(self, least: Point) -> float:
        """Return the energy above a draw's usual one, nats, which is the min plus half the number of unknowns."""
        usual = 0.0 if self.noise is None else 0.5 * least.derivative.shape[1]
        return self.point.energy - least.energy - usual


@dataclass(frozen=True, eq=False)
class _Problem:
    """The energy of rows with a payload.

    loaded, free: motions with it and without; tau: of both, the free ones first, (N, n) N·m; roots: of both, see
    `correlation_roots`.
    """

    carrier: Carrier
    training: Training
    loaded: Instants
    free: Instants | None
    tau: Array
    prior: PayloadPrior
    roots: Array

    @classmethod
    def of(cls, carrier: Carrier, rows: Rows, before: Rows | None, prior: PayloadPrior) -> _Problem:
        def seen(motion: Motion) -> Instants:
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

    def select_start(self, start: Estimate | None) -> Estimate | None:
        """Return an estimate to start from, None if its variables are others."""
        known = start is not None and len(start.load.mean) == len(self.carrier.mean) + PARAMETERS
        return start if known else None

    def make_start(self, start: Estimate | None) -> ArmWithPayload:
        """Return the arm to start from."""
        geometry = None if start is None else start.load.geometry
        if geometry is None:
            geometry = self.carrier.term.arm.geometry.moved(self.carrier.step)
        if start is None:
            return ArmWithPayload(self.carrier.mean, geometry, self.prior.centre)
        return ArmWithPayload(start.load.mean[:-PARAMETERS], geometry, start.eta)

    def at(self, place: ArmWithPayload) -> Point:
        """Return the point of an arm."""
        trained, size = self.training.at(place), len(place.w)
        payload, slope = body(place.eta)
        features, torque = rows_of(linearised_around(self.carrier, place, payload), *self.loaded)
        if self.free is not None:
            others, torque_free = rows_of(linearised_around(self.carrier, place, np.zeros(PARAMETERS)), *self.free)
            others[-PARAMETERS:] = 0.0
            features, torque = np.concatenate([others, features], axis=1), np.concatenate([torque_free, torque])
        root = np.linalg.cholesky(self.prior.precision).T
        _, off = whiten(self.roots, features[:0], torque - self.tau)
        first = len(trained.residual) - PARAMETERS

        def derivative() -> Array:
            along, _ = whiten(self.roots, features, torque - self.tau)
            by_rows = np.hstack([along[:size].T @ self.carrier.memory.root, along[size:].T @ slope])
            out = np.concatenate([trained.derivative, by_rows])
            out[first : len(trained.residual), size:] = root
            return out

        residual = np.concatenate([trained.residual, off])
        residual[first : len(trained.residual)] = root @ (place.eta - self.prior.centre)
        return Point(place, residual, float((off**2).mean()), derivative)

    def search_axes(self, at: Point) -> Generator[None, None, list[Point]]:
        """Return arms with other axes if `at`, the most likely known, does not explain the rows; see `turn_axes`."""
        if at.misfit <= AXES.max_misfit or self.carrier.term.arm.mode != "learn":
            return []
        learnt = yield from descent(self, self.at(self.make_start(None)), OPTIONS.first_steps)
        return (yield from turn_axes(self, learnt, at.energy))

    def follow_draw(self, begin: Draw, number: int, rounds: int) -> Generator[None, None, Point]:
        """Return the point of a draw from the posterior: the minimum for other noise.

        Noise is added to the training, the prior of payloads and the rows (randomised maximum likelihood, Kitanidis
        1995, Oliver et al. 1996). number: of the draw. It has the same noise for the same rows each time, so that it
        stays near its place.
        """
        of_rows, noise = np.random.default_rng([DRAWS.seed, number]).standard_normal(self.tau.size), begin.noise
        yield
        return (
            yield from descent(self, self.at(begin.place), rounds, 0.0 if noise is None else np.append(noise, of_rows))
        )

    def estimate(self, at: Point, found: Sequence[_DrawResult] = ()) -> Estimate:
        """Return the estimate of the most likely arm, and of draws."""
        carrier, size = self.carrier, len(self.carrier.mean)
        derivative, first = at.derivative, len(at.residual) - self.tau.size
        sure = bool(found) and not carrier.is_tip_unidentified
        if not sure:
            doubt = np.full(len(derivative), OPTIONS.doubt)
            doubt[:size] = doubt[first - PARAMETERS : first] = 1.0  # the priors
            derivative = derivative / doubt[:, None]
        # the curvature squares the condition number, and the covariance could exceed the prior's
        root = solve_triangular(qr(derivative, mode="r")[0][: size + PARAMETERS], np.eye(size + PARAMETERS))
        eta = at.place.eta
        payload, slope = body(eta)
        outward = np.zeros((size + PARAMETERS, size + PARAMETERS))
        outward[:size, :size], outward[size:, size:] = carrier.memory.root, slope
        outward = outward @ root
        room = PARAMETERS * np.diagonal(slope @ inverse(self.prior.precision) @ slope.T)
        others, bent = _find_alternatives(carrier, at, root, found)
        draws = tuple(Draw(each.point.place, each.noise) for each in found) if bent else ()
        excess = excess_variance(self.roots, at.residual[-self.tau.size :], len(self.loaded[0]))
        load = PayloadPosterior(
            np.concatenate([at.place.w, payload]), outward @ outward.T, room, at.place.geometry, others, excess
        )
        of_eta = max(1.0, at.misfit) * root[size:] @ root[size:].T
        if others:
            wider = _compute_widening(np.sqrt(np.diagonal(of_eta)), [each.point.place.eta - eta for each in found])
            of_eta *= np.outer(wider, wider)
        return Estimate(eta, of_eta, load, *self.gains(at), draws, 1.0 if sure else OPTIONS.doubt, at.misfit)

    def gains(self, at: Point) -> tuple[float, float]:
        """Return the nats by which a payload, and a constant torque, explain the rows better than the arm alone.

        The arm is linear then.
        """
        least, volume, contact = explain_unloaded(self.carrier, self.free, self.loaded, self.tau, self.roots)
        curved = np.linalg.slogdet(at.derivative.T @ at.derivative)[1] - np.linalg.slogdet(self.prior.precision)[1]
        return self.training.learnt_energy + least - at.energy + 0.5 * (volume - float(curved)), contact


def _compute_widening(std: Array, off: Sequence[Array]) -> Array:
    """Return how many times wider than std, (10,), draws lie about the mean, at least 1. off: of each draw, (10,).

    It uses the median, because some draws have not converged yet.
    """
    # the median of the absolute value of a normal variable is 0.6745 standard deviations
    return np.maximum(1.0, np.median(np.abs(off), axis=0) / (0.6745 * std))


def _find_alternatives(
    carrier: Carrier, at: Point, root: Array, found: Sequence[_DrawResult]
) -> tuple[tuple[Alternative, ...], bool]:
    """Return arms spread over the posterior if it is far from linear, the most likely first; and whether it is.

    Few rows leave a curved valley open, along which centre of mass and geometry compensate each other. The linear
    posterior is tangent to it at one place.
    """
    reached = [each for each in found if each.excess(at) < OPTIONS.far_nats and each.point is not at]
    known = [each.point.place for each in reached]
    if not known:
        return (), bool(found)
    off = [np.zeros(len(root))]
    for each in known:
        w = solve_triangular(carrier.memory.root, each.w - at.place.w, lower=True, check_finite=False)
        off.append(solve_triangular(root, np.append(w, each.eta - at.place.eta), check_finite=False))
    if np.square(off[1:]).mean() < OPTIONS.max_square and not carrier.is_tip_unidentified:
        return (), False
    shares = np.exp(-np.array([0.0, *(max(0.0, each.excess(at)) for each in reached)]) / OPTIONS.hot_nats)
    return tuple(
        carrier.alternative(each.w, each.geometry, body(each.eta)[0], share)
        for each, share in zip((at.place, *known), shares / shares.sum(), strict=True)
    ), True
