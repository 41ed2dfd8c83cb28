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
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np
from scipy.linalg import qr, solve_triangular

from lipcore.data.motion import Motion
from lipcore.data.samples import Array
from lipcore.kernels.arm import ArmKernel
from lipcore.kernels.arm_prior import Alternative
from lipcore.kernels.geometry import Geometry
from lipcore.model.payload import Carrier, Linearised, Load
from lipcore.online.batch import Rows
from lipcore.online.bodies import ANY, WIDTH, Known, body, inverse
from lipcore.online.errors import correlation_roots, whitened
from lipcore.online.estimate import Estimate, Seen, alone, rows_of
from lipcore.online.linear import linear
from lipcore.robots.urdf import PARAMETERS

FIRST, ROUNDS, FEW, STILL = 30, 8, 4, 0.01
"""Steps at most of an estimate from nothing, of one that begins at another, and of a draw from its posterior: an answer
waits for them; and the least that one gains, nats."""
DAMPING, LESS, MORE = 1e-3, 0.15, 8.0
"""At first, as a share of the curvature; its factors after a step that gains, and after one that does not."""
LEAST_DAMPING, WORST = 1e-9, 1e8
"""It is not less; and from which on nothing is gained."""
REACH = 0.5
"""Longest step of the geometry, rad or m."""
DRAWS, WIDE, RELAXED, SEED = 10, (1.0, 6.0), 20, 0
"""Draws from the posterior by which it is judged how far it is from linear, followed from estimate to estimate; how
many deviations of the linear posterior wide they begin, from and to, as where it is bent it is wider; steps in which
they become arms that the training allows; and what they are drawn by."""
LINEAR, SOFT, FAR = 2.0, 3.0, 10.0
"""The mean square, in deviations of the linear posterior, up to which it is as good; and the energies above the least,
for each number that is unknown, nats, over which a draw counts e times less, as it has not come far enough yet, and
from which on rows have ruled it out."""

MEDIAN = 0.6745
"""Of the absolute value of what has a normal distribution, standard deviations."""


def arms(carrier: Carrier) -> tuple[Draw, ...]:
    """Draws from what the training alone says, with any payload; made once a version, by the revision that asks first,
    and again where another has learnt more directions."""
    training, draw = _Training.of(carrier), np.random.default_rng(SEED)
    size = len(carrier.memory.slope) + len(carrier.memory.outside) + len(carrier.mean) + PARAMETERS
    known = _ARMS.get(carrier.term, ())
    if not known or len(known[0].noise) != size:
        known = _ARMS[carrier.term] = tuple(training.drawn(draw) for _ in range(DRAWS))
    return known


_ARMS: WeakKeyDictionary[ArmKernel, tuple[Draw, ...]] = WeakKeyDictionary()


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
    at = _minimum(problem, problem.at(problem.begin(start)), FIRST if start is None else ROUNDS)
    # with more rows, what was as good as linear stays so
    settled = start is not None and not start.draws and not anew
    drawn = [] if settled else _draws(problem, at, () if start is None else start.draws, draw, anew)
    if drawn:  # each of which is the minimum for other noise
        other = _minimum(problem, min([point for point, _ in drawn], key=lambda each: each.energy), ROUNDS)
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
class Place:
    """An arm and its payload. w: (M,); geometry: of the arm; eta: (10,)."""

    w: Array
    geometry: Geometry
    eta: Array

    def moved(self, carrier: Carrier, step: Array) -> Place:
        """The place a whitened step away, (M + 10,), or as far in its direction as is gone at once."""
        size, steps = len(self.w), carrier.steps
        by, eta = carrier.memory.root @ step[:size], step[size:]
        longest = max(np.abs(eta / WIDTH).max() / 2, np.abs(carrier.root[steps] * by[steps]).max() / REACH)
        by, eta = by / max(1.0, longest), eta / max(1.0, longest)
        w, arm, geometry = self.w + by, carrier.term.arm, self.geometry.moved(carrier.root[steps] * by[steps])
        w[steps] = (arm.geometry.towards(geometry) - arm.expected) / carrier.root[steps]
        return Place(w, geometry, self.eta + eta)


@dataclass(frozen=True, eq=False)
class Draw:
    """A draw from the posterior: the place of least energy for other noise. noise: of what is known beforehand."""

    place: Place
    noise: Array


@dataclass(frozen=True, eq=False)
class _Point:
    """The energy of a place. residual, derivative: of it, by whitened steps; misfit: mean square of the rows' part."""

    place: Place
    residual: Array
    derivative: Array
    misfit: float

    @property
    def energy(self) -> float:
        """Nats."""
        return 0.5 * float(self.residual @ self.residual)


def _minimum(problem: _Training | _Problem, at: _Point, rounds: int, shift: Array | float = 0.0) -> _Point:
    """Where the energy is least, or what is reached in so many steps; shift: what the residuals should be."""
    damping, carrier = DAMPING, problem.carrier
    for _ in range(rounds):
        off = at.residual - shift
        energy = 0.5 * float(off @ off)
        curvature, gradient = at.derivative.T @ at.derivative, at.derivative.T @ off
        while damping < WORST:
            step = np.asarray(np.linalg.solve(curvature + damping * np.diag(np.diagonal(curvature)), -gradient))
            trial = problem.at(at.place.moved(carrier, step))
            left = trial.residual - shift
            gained = energy - 0.5 * float(left @ left)
            if gained >= 0:
                break
            damping *= MORE
        else:
            break
        at, damping = trial, max(LESS * damping, LEAST_DAMPING)
        if gained < STILL:
            break
    return at


@dataclass(frozen=True, eq=False)
class _Training:
    """What the training of an arm says. virtual: motions of its memory."""

    carrier: Carrier
    virtual: Seen

    @classmethod
    def of(cls, carrier: Carrier) -> _Training:
        motion = Motion.from_arrays(*carrier.memory.motions.swapaxes(0, 1))
        return cls(carrier, (motion, carrier.rest(motion)))

    def at(self, place: Place) -> _Point:
        """The energy of a place, whose payload is left as it is."""
        memory, size = self.carrier.memory, len(place.w)
        features, torque = rows_of(_around(self.carrier, place, np.zeros(PARAMETERS)), *self.virtual)
        by_arm = memory.derivative(features[:size])
        derivative = np.zeros((len(by_arm) + PARAMETERS, size + PARAMETERS))
        derivative[: len(by_arm), :size] = by_arm
        derivative[len(by_arm) :, size:] = np.eye(PARAMETERS)
        residual = np.concatenate([memory.residual(place.w, torque), np.zeros(PARAMETERS)])
        return _Point(place, residual, derivative, 0.0)

    def drawn(self, draw: np.random.Generator) -> Draw:
        """One of the arms that the training allows, with any payload."""
        carrier, geometry = self.carrier, self.carrier.term.arm.geometry.moved(self.carrier.step)
        steps, root = carrier.steps, carrier.root
        by = draw.uniform(*WIDE) * carrier.memory.root @ draw.standard_normal(len(carrier.mean))
        w, arm, geometry = carrier.mean + by, carrier.term.arm, geometry.moved(root[steps] * by[steps])
        w[steps] = (arm.geometry.towards(geometry) - arm.expected) / root[steps]
        at = self.at(Place(w, geometry, ANY.centre))
        noise = draw.standard_normal(len(at.residual))
        still = np.concatenate([noise[:-PARAMETERS], np.zeros(PARAMETERS)])
        return Draw(_minimum(self, at, RELAXED, still).place, noise)

    @cached_property
    def alone(self) -> float:
        """Energy of the arm as it was learnt, nats."""
        memory, mean = self.carrier.memory, self.carrier.mean
        alone = memory.residual(mean, memory.base + np.tensordot(mean, memory.features, axes=1))
        return 0.5 * float(alone @ alone)


@dataclass(frozen=True, eq=False)
class _Problem:
    """What is minimised. loaded, free: motions with a payload, and without; tau: of both, the free ones first, (N, n)
    N·m; roots: see `correlation_roots`, of both."""

    carrier: Carrier
    training: _Training
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
            _Training.of(carrier),
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

    def at(self, place: Place) -> _Point:
        """The energy of a place."""
        trained, size = self.training.at(place), len(place.w)
        payload, slope = body(place.eta)
        features, torque = rows_of(_around(self.carrier, place, payload), *self.loaded)
        if self.free is not None:
            others, torque_free = rows_of(_around(self.carrier, place, np.zeros(PARAMETERS)), *self.free)
            others[-PARAMETERS:] = 0.0
            features, torque = np.concatenate([others, features], axis=1), np.concatenate([torque_free, torque])
        features, off = whitened(self.roots, features, torque - self.tau)
        root = np.linalg.cholesky(self.prior.precision).T
        by_rows = np.hstack([features[:size].T @ self.carrier.memory.root, features[size:].T @ slope])
        derivative = np.concatenate([trained.derivative, by_rows])
        derivative[len(trained.derivative) - PARAMETERS : len(trained.derivative), size:] = root
        residual = np.concatenate([trained.residual, off])
        residual[len(trained.residual) - PARAMETERS : len(trained.residual)] = root @ (place.eta - self.prior.centre)
        return _Point(place, residual, derivative, float((off**2).mean()))

    def gains(self, at: _Point) -> tuple[float, float]:
        """Nats by which a payload, and a contact of constant torque, explain the rows better than the arm does without
        either, which is linear then."""
        least, volume, contact = alone(self.carrier, self.free, self.loaded, self.tau, self.roots)
        curved = np.linalg.slogdet(at.derivative.T @ at.derivative)[1] - np.linalg.slogdet(self.prior.precision)[1]
        return self.training.alone + least - at.energy + 0.5 * (volume - float(curved)), contact


def _around(carrier: Carrier, place: Place, payload: Array) -> Linearised:
    nothing = np.zeros((0, 0))
    return Linearised(carrier, Load(np.append(place.w, payload), nothing, np.ones(PARAMETERS), place.geometry))


def _draws(
    problem: _Problem, at: _Point, known: Sequence[Draw], draw: np.random.Generator, anew: bool
) -> list[tuple[_Point, Array]]:
    """Draws from the posterior, with their noise: minima for other noise of the training, of what is known of payloads
    and of the rows (randomised maximum likelihood, Kitanidis 1995, Oliver et al. 1996). known: of fewer rows; anew:
    whether those that rows have ruled out begin again."""

    def sought(begin: Draw, rounds: int = FEW) -> tuple[_Point, Array]:
        noise = np.append(begin.noise, draw.standard_normal(problem.tau.size))
        return _minimum(problem, problem.at(begin.place), rounds, noise), begin.noise

    def carrying(arm: Draw) -> Draw:
        return replace(arm, place=replace(arm.place, eta=at.place.eta))

    # another revision of the training may know more, or less
    known = [each for each in known if len(each.noise) == len(at.residual) - problem.tau.size]
    found = [sought(each) for each in known or [carrying(arm) for arm in arms(problem.carrier)]]
    if anew:
        out = _ruled_out(min([at, *(point for point, _ in found)], key=lambda each: each.energy))
        for place, (point, _) in enumerate(found):
            if point.energy > out:
                found[place] = sought(carrying(problem.training.drawn(draw)), FIRST)
    return found


def _wider(std: Array, off: Sequence[Array]) -> Array:
    """How many times wider than the linear posterior's std, (10,), draws lie about its mean, at least once; by the
    median, as some have not come far enough yet. off: of each draw, (10,)."""
    return np.maximum(1.0, np.median(np.abs(off), axis=0) / (MEDIAN * std))


def _ruled_out(least: _Point) -> float:
    """Energy from which on a draw is ruled out, nats."""
    return least.energy + FAR * len(least.derivative.T)


def _others(
    carrier: Carrier, at: _Point, root: Array, points: Sequence[_Point]
) -> tuple[tuple[Alternative, ...], bool]:
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
