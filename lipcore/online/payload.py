"""A payload estimated from the rows since it was taken up, together with what they tell of the arm.

What is unknown are the arm's whitened variables w, with its geometry θ, and the payload's η (`bodies`). The most likely
ones minimise

    E = ½ |e|² + ½ |m(w, θ)|² + ½ (η − η₀)ᵀ P (η − η₀),

where e is what the rows' torque is off, whitened by the covariance of their errors, and m what the arm's training says
(`lipcore.model.memory`). Torque is linearised around each step (`lipcore.model.payload`), steps are Levenberg's and
Marquardt's, and the covariance is that of the linear model around the last one (Laplace).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.linalg import qr, solve_triangular

from lipcore.data.motion import Motion
from lipcore.data.samples import Array
from lipcore.kernels.arm_prior import Alternative
from lipcore.kernels.geometry import Geometry
from lipcore.model.payload import Carrier, Linearised, Load
from lipcore.online.batch import Rows
from lipcore.online.bodies import ANY, WIDTH, Known, body, inverse
from lipcore.robots.urdf import PARAMETERS

FIRST, ROUNDS, STILL = 30, 8, 1e-3
"""Steps at most of an estimate from nothing, and of one that begins at another; and the least that one gains, nats."""
DAMPING, LESS, MORE = 1e-3, 0.15, 8.0
"""At first, as a share of the curvature; its factors after a step that gains, and after one that does not."""
LEAST_DAMPING, WORST = 1e-9, 1e8
"""It is not less; and from which on nothing is gained."""
REACH = 0.5
"""Longest step of the geometry, rad or m."""
DRAWS, SEED, LINEAR = 6, 0, 2.0
"""Places in the posterior by which it is judged how far it is from linear; and up to which mean square of theirs, in
deviations of the linear one, it is as good as that."""
LIKE = 0.3, 0.3
"""See `likeness`. Chosen on the dirty Panda of seed 50 among three pairs."""
LEAST_WHITE = 1e-3
"""Share of the noise's variance that is new in every row at least."""


@dataclass(frozen=True)
class Estimate:
    """A payload as rows have it. eta, (10,): most likely; covariance: (10, 10) of it; load: with the arm's variables;
    gain: nats by which it explains the rows better than the arm without a payload."""

    eta: Array
    covariance: Array
    load: Load
    gain: float

    @property
    def mass(self) -> tuple[float, float]:
        """Mean and standard deviation of the mass, kg."""
        return float(np.exp(self.eta[0])), float(np.exp(self.eta[0]) * np.sqrt(self.covariance[0, 0]))


def known(carrier: Carrier, prior: Known) -> Estimate:
    """A payload of which no more is known than beforehand."""
    payload, slope = body(prior.centre)
    spread = inverse(prior.precision)
    return Estimate(prior.centre, spread, carrier.known(payload, slope @ spread @ slope.T), 0.0)


def estimate(
    carrier: Carrier,
    rows: Rows,
    before: Rows | None = None,
    prior: Known = ANY,
    start: Estimate | None = None,
    renew: bool = True,
) -> Estimate:
    """The payload that rows carry. before: rows that do not, whose errors tell those of the first that do; start:
    another estimate by the same carrier, or by another revision of its version, to begin at; renew: whether to begin
    from nothing, too, and to see how far from linear the posterior is, which else is as of the start."""
    problem = _Problem.of(carrier, rows, before, prior)
    renew = renew or start is None or start.load.geometry is None
    found = [] if start is None else [_minimum(problem, problem.start(start), ROUNDS)]
    if renew:
        found.append(_minimum(problem, problem.start(None), FIRST))
    at = min(found, key=lambda each: each.energy)
    size = len(carrier.mean)
    # not from the curvature, of whose condition the root is enough: a covariance above the prior's is none
    root = solve_triangular(qr(at.derivative, mode="r")[0][: size + PARAMETERS], np.eye(size + PARAMETERS))
    payload, slope = body(at.eta)
    outward = np.zeros((size + PARAMETERS, size + PARAMETERS))
    outward[:size, :size], outward[size:, size:] = carrier.memory.root, slope
    outward = outward @ root
    room = PARAMETERS * np.diagonal(slope @ inverse(prior.precision) @ slope.T)
    load = Load(np.concatenate([at.w, payload]), outward @ outward.T, room, at.geometry)
    if at.geometry is not None:
        load = replace(load, others=_others(problem, at, root) if renew or start is None else start.load.others)
    of_eta = max(1.0, at.misfit) * root[size:] @ root[size:].T
    return Estimate(at.eta, of_eta, load, problem.gain(at))


def _minimum(problem: _Problem, at: _Point, rounds: int, shift: Array | float = 0.0) -> _Point:
    """Where the energy is least, or what is reached in so many steps; shift: what the residuals should be."""
    damping, carrier = DAMPING, problem.carrier
    for _ in range(rounds):
        off = at.residual - shift
        energy = 0.5 * float(off @ off)
        curvature, gradient = at.derivative.T @ at.derivative, at.derivative.T @ off
        while damping < WORST:
            step = np.asarray(np.linalg.solve(curvature + damping * np.diag(np.diagonal(curvature)), -gradient))
            trial = problem.at(*at.moved(carrier, step))
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
class _Point:
    """An arm and its payload. w: (M,); geometry: of the arm; eta: (10,); residual, derivative: of the energy, by the
    arm's whitened steps and η; misfit: mean square of the rows' part."""

    w: Array
    geometry: Geometry | None
    eta: Array
    residual: Array
    derivative: Array
    misfit: float

    @property
    def energy(self) -> float:
        return 0.5 * float(self.residual @ self.residual)

    def moved(self, carrier: Carrier, step: Array) -> tuple[Array, Geometry | None, Array]:
        """w, geometry and η a step away, or as far in its direction as they go at once."""
        size, steps = len(self.w), carrier.steps
        by, eta = carrier.memory.root @ step[:size], step[size:]
        longest = np.abs(eta / WIDTH).max() / 2
        if steps.stop > steps.start:
            longest = max(longest, np.abs(carrier.root[steps] * by[steps]).max() / REACH)
        by, eta = by / max(1.0, longest), eta / max(1.0, longest)
        w, arm, geometry = self.w + by, carrier.term.arm, self.geometry
        if geometry is not None:
            geometry = geometry.moved(carrier.root[steps] * by[steps])
            w[steps] = (arm.geometry.towards(geometry) - arm.expected) / carrier.root[steps]
        return w, geometry, self.eta + eta


@dataclass(frozen=True, eq=False)
class _Problem:
    """What is minimised. roots: see `correlation_roots`, of both kinds of rows."""

    carrier: Carrier
    rows: Rows
    before: Rows | None
    prior: Known
    roots: Array

    @classmethod
    def of(cls, carrier: Carrier, rows: Rows, before: Rows | None, prior: Known) -> _Problem:
        before = before if before is not None and len(before) else None
        roots = correlation_roots(carrier, rows if before is None else Rows.concatenate([before, rows]))
        return cls(carrier, rows, before, prior, roots)

    def start(self, start: Estimate | None) -> _Point:
        """Where to begin."""
        carrier = self.carrier
        if start is None or start.load.geometry is None or len(start.load.mean) != len(carrier.mean) + PARAMETERS:
            geometry = carrier.term.arm.geometry.moved(carrier.step) if carrier.term.arm.steps else None
            return self.at(carrier.mean, geometry, self.prior.centre if start is None else start.eta)
        return self.at(start.load.mean[:-PARAMETERS], start.load.geometry, start.eta)

    def at(self, w: Array, geometry: Geometry | None, eta: Array) -> _Point:
        """The energy of an arm and its payload."""
        carrier, memory = self.carrier, self.carrier.memory
        payload, slope = body(eta)
        loaded, free = (_around(carrier, w, geometry, carried) for carried in (payload, np.zeros(PARAMETERS)))
        features, torque = _rows(loaded, self.rows.motion())
        off = torque - self.rows.tau
        if self.before is not None:
            others, torque = _rows(free, self.before.motion())
            others[-PARAMETERS:] = 0.0
            features, off = np.concatenate([others, features], axis=1), np.concatenate([torque - self.before.tau, off])
        features, off = _whitened(self.roots, features, off)
        remembered, torque = _rows(free, Motion.from_arrays(*memory.motions.swapaxes(0, 1)))
        root, size = np.linalg.cholesky(self.prior.precision).T, len(w)
        by_arm = np.concatenate([memory.derivative(remembered[:size]), features[:size].T @ memory.root])
        derivative = np.zeros((len(by_arm) + len(eta), size + len(eta)))
        derivative[: len(by_arm), :size] = by_arm
        derivative[len(by_arm) - len(off) : len(by_arm), size:] = features[size:].T @ slope
        derivative[len(by_arm) :, size:] = root
        residual = np.concatenate([memory.residual(w, torque), off, root @ (eta - self.prior.centre)])
        return _Point(w, geometry, eta, residual, derivative, float((off**2).mean()))

    def gain(self, at: _Point) -> float:
        """Nats by which a payload explains the rows better than the arm does without one, that is linear then."""
        carrier, memory = self.carrier, self.carrier.memory
        free = Linearised(carrier, carrier.known(np.zeros(PARAMETERS)))
        parts = [_rows(free, each.motion()) for each in (self.before, self.rows) if each is not None]
        features, torque = (np.concatenate(each, axis=-2) for each in zip(*parts, strict=True))
        tau = np.concatenate([each.tau for each in (self.before, self.rows) if each is not None])
        features, off = _whitened(self.roots, features, torque - tau)
        along = features[: len(at.w)].T @ memory.root
        curvature = np.eye(len(at.w)) + along.T @ along
        explained = along.T @ off
        alone = memory.residual(carrier.mean, memory.base + np.tensordot(carrier.mean, memory.features, axes=1))
        free_energy = 0.5 * float(alone @ alone + off @ off - explained @ np.linalg.solve(curvature, explained))
        volume = np.linalg.slogdet(at.derivative.T @ at.derivative)[1] - np.linalg.slogdet(self.prior.precision)[1]
        return free_energy - at.energy + 0.5 * float(np.linalg.slogdet(curvature)[1] - volume)


def _around(carrier: Carrier, w: Array, geometry: Geometry | None, payload: Array) -> Linearised:
    nothing = np.zeros((0, 0))
    return Linearised(carrier, Load(np.concatenate([w, payload]), nothing, np.ones(PARAMETERS), geometry))


def _rows(around: Linearised, motion: Motion) -> tuple[Array, Array]:
    """Features of (w, π) at N instants, (M + 10, N, n), and the torque of the load's mean, (N, n) N·m."""
    features, base = around.rows(motion)
    return features, base + np.tensordot(around.load.mean, features, axes=1)


def _others(problem: _Problem, at: _Point, root: Array) -> tuple[Alternative, ...]:
    """Places in the posterior where it is far from linear, with the most likely one; none where it is not.

    Few rows leave a curved valley open, along which a centre of mass and the geometry make up for each other, and the
    linear posterior is tangent to it at one place. Others are the minima for other noise (randomised maximum
    likelihood, Kitanidis 1995, Oliver et al. 1996). root: of the covariance of whitened steps.
    """
    carrier, draw = problem.carrier, np.random.default_rng(SEED)
    off, found = [], [at]
    for _ in range(DRAWS):
        begin = problem.at(*at.moved(carrier, root @ draw.standard_normal(len(root))))
        there = _minimum(problem, begin, ROUNDS, draw.standard_normal(len(at.residual)))
        step = np.append(
            solve_triangular(carrier.memory.root, there.w - at.w, lower=True, check_finite=False), there.eta - at.eta
        )
        off.append(float((solve_triangular(root, step, check_finite=False) ** 2).mean()))
        found.append(there)
    if carrier.model.posterior.basis.term is not None or np.mean(off) < LINEAR:
        return ()
    arms = []
    for each in found:
        assert each.geometry is not None
        arms.append(carrier.alternative(each.w, each.geometry, body(each.eta)[0], 1 / len(found)))
    return tuple(arms)


def noise_parts(carrier: Carrier, motion: Motion) -> tuple[Array, Array, Array]:
    """Variance of the torques at N instants, (N·m)²: what is new in every row, (n,); what is not, as errors that last
    are, and those of faster motion, (N, n); and that of joints at rest, (N, n), which may break away at any time."""
    posterior = carrier.model.posterior
    noise, misfit = posterior.noise_variance, posterior.misfit
    white = torch.maximum(noise - misfit.lasting, LEAST_WHITE * noise)
    rest = misfit.at_rest(motion.dq)
    return white.numpy(), (misfit.lasting + misfit.variance(motion) - rest).numpy(), rest.numpy()


def likeness(carrier: Carrier, q: Array, dq: Array, speed: float, pose: float) -> Array:
    """Correlation of the errors of N instants that are not new in each, joint by joint: (n, N, N).

    They are functions of motion, as friction is, and not of time: alike where a joint moves alike in a pose that is
    alike, whether just before or long ago. q, dq: (N, n); speed, pose: differences over which they become others, of
    the joint's velocity in units of its usual one, and of the pose, root mean square over joints, rad (m).
    """
    faster = np.abs(dq[:, None] - dq[None]) / carrier.model.posterior.misfit.speed.numpy()
    apart = np.sqrt(((q[:, None] - q[None]) ** 2).mean(axis=-1, keepdims=True))
    return np.asarray(np.exp(-faster / speed - apart / pose).transpose(2, 0, 1))


def correlation_roots(carrier: Carrier, rows: Rows) -> Array:
    """Cholesky roots of the covariance of the errors of N rows, joint by joint: (n, N, N) N·m."""
    white, lasting, rest = noise_parts(carrier, rows.motion())
    deviation = np.sqrt((lasting + rest).T)
    covariance = deviation[:, :, None] * deviation[:, None, :] * likeness(carrier, rows.q, rows.dq, *LIKE)
    covariance[:, np.arange(len(rows)), np.arange(len(rows))] += white[:, None]
    return np.asarray(np.linalg.cholesky(covariance))


def _whitened(roots: Array, features: Array, residual: Array) -> tuple[Array, Array]:
    """Features (M + 10, N n) and residuals (N n,) whose errors are independent, of variance one."""
    both = np.concatenate([features, residual[None]]).transpose(2, 1, 0)
    solved = torch.linalg.solve_triangular(
        torch.from_numpy(roots), torch.from_numpy(np.ascontiguousarray(both)), upper=False
    )
    flat = solved.numpy().reshape(-1, both.shape[2]).T
    return flat[:-1], flat[-1]
