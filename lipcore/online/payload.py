"""A payload estimated from the rows since it was taken up, together with what they tell of the arm.

Given the variables w of the arm, N(ŵ, Σ), torque is linear in the payload's ten parameters π around its mean (see
`lipcore.model.payload`). With H = [F, b] the features of rows and R their variance, w is integrated out:

    V = (Σ⁻¹ + Fᵀ R⁻¹ F)⁻¹,    Λ = bᵀ R⁻¹ b − bᵀ R⁻¹ F V Fᵀ R⁻¹ b,    ξ = bᵀ R⁻¹ r − bᵀ R⁻¹ F V Fᵀ R⁻¹ r,

is all that the rows say of π. A body that can exist has a positive mass and a positive definite second moment: π is a
function of ten free numbers η, log mass, centre of mass and the Cholesky factor of the spread about it, which have a
Gaussian prior. The most likely η is found by Levenberg's and Marquardt's method; its covariance is Laplace's; the rows
are linearised anew around it until it stays.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.linalg import solve_triangular

from lipcore.data.motion import Motion
from lipcore.data.samples import Array
from lipcore.model.payload import Body, Carrier, Linearised, Load
from lipcore.online.batch import Rows
from lipcore.robots.urdf import PARAMETERS

CENTRE = np.array([0.0, 0, 0, 0, *[np.log(0.04)] * 3, 0, 0, 0])
WIDTH = np.array([1.2, 0.15, 0.15, 0.15, 0.7, 0.7, 0.7, 0.03, 0.03, 0.03])
"""Prior of η: log kg; m; log m; m. Nineteen of twenty payloads weigh 0.1 to 10 kg, lie within 0.3 m of the last
link's frame and spread over 1 to 16 cm."""
ROUNDS, STILL = 6, 0.05
"""Linearisations at most, and the change in standard deviations from which on there is no other."""
STEPS, DAMPING = 50, 1e-3
LIKE = 0.3, 0.3
"""See `likeness`. Chosen on the dirty Panda of seed 50 among three pairs."""
LEAST_EXTENT = 1e-3
"""Of a body, m: none is a point."""
LEAST_WHITE = 1e-3
"""Share of the noise's variance that is new in every row at least."""


def body(eta: Array) -> tuple[Array, Array]:
    """The ten parameters of η, (10,), and their derivative, (10, 10)."""
    mass, com, scale = np.exp(eta[0]), eta[1:4], np.exp(eta[4:7])
    root = np.zeros((3, 3))
    root[DIAGONAL], root[BELOW] = scale, eta[7:]
    inertia = INERTIA @ (root @ root.T + com[:, None] * com).reshape(-1)
    out = np.concatenate([[1.0], com, inertia]) * mass
    slope = np.zeros((PARAMETERS, PARAMETERS))
    slope[:, 0] = out
    slope[[1, 2, 3], [1, 2, 3]] = mass
    # of C Cᵀ + E Eᵀ, twice the symmetric part of what its left factor changes by
    slope[4:, 1:4] = 2 * mass * (INERTIA.reshape(6, 3, 3) @ com)
    rows, columns = np.concatenate([DIAGONAL, BELOW], axis=1)
    change = 2 * mass * (INERTIA.reshape(6, 3, 3) @ root)[:, rows, columns]
    change[:, :3] *= scale
    slope[4:, 4:] = change
    return out, slope


DIAGONAL, BELOW = (np.arange(3), np.arange(3)), (np.array([1, 2, 2]), np.array([0, 0, 1]))
_UNITS = np.eye(9).reshape(9, 3, 3)
INERTIA = np.array([(np.trace(unit) * np.eye(3) - 0.5 * (unit + unit.T))[np.tril_indices(3)] for unit in _UNITS]).T
"""What makes xx, xy, yy, xz, yz, zz of a second moment, flat: tr(S) 1 − S, symmetrised, (6, 9)."""


@dataclass(frozen=True)
class Known:
    """What is known of η before the rows: N(centre, precision⁻¹), (10,) and (10, 10)."""

    centre: Array
    precision: Array


ANY = Known(CENTRE, np.diag(WIDTH**-2.0))
"""Of a payload of which nothing is known."""


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
    spread = _inverse(prior.precision)
    return Estimate(prior.centre, spread, carrier.known(payload, slope @ spread @ slope.T), 0.0)


def eta_of(carried: Body) -> Array:
    """η of a body, (10,): one without extent has a little."""
    inertia = np.zeros((3, 3)) if carried.inertia is None else carried.inertia
    spread = (0.5 * np.trace(inertia) * np.eye(3) - inertia) / carried.mass
    root = np.linalg.cholesky(spread + LEAST_EXTENT**2 * np.eye(3))
    return np.concatenate([[np.log(carried.mass)], carried.com, np.log(root[DIAGONAL]), root[BELOW]])


def estimate(
    carrier: Carrier, rows: Rows, before: Rows | None = None, prior: Known = ANY, start: Array | None = None
) -> Estimate:
    """The payload that rows carry. before: rows that do not, whose errors tell those of the first that do; start: η to
    begin at, where it is known roughly."""
    everything = rows if before is None or not len(before) else Rows.concatenate([before, rows])
    free = len(everything) - len(rows)
    roots = correlation_roots(carrier, everything)
    mean, size = carrier.mean, len(carrier.mean)
    root = carrier.covariance_root
    empty = carrier.known(np.zeros(PARAMETERS))
    unloaded = _Rows.of(carrier, empty, everything.take(slice(0, free)), mean) if free else None
    if unloaded is not None:
        unloaded.features[size:] = 0.0
    eta = prior.centre if start is None else start
    load = empty if start is None else carrier.known(body(eta)[0])
    for _ in range(ROUNDS):
        loaded = _Rows.of(carrier, load, rows, mean)
        features, residual = _whitened(roots, loaded if unloaded is None else unloaded.then(loaded))
        information, score = features @ features.T, features @ residual
        arm, cross = information[:size, :size], information[:size, size:]
        inner = np.linalg.cholesky(np.eye(size) + root.T @ arm @ root)
        half = solve_triangular(inner, root.T, lower=True, check_finite=False)
        open_ = half.T @ half  # (Σ⁻¹ + Fᵀ R⁻¹ F)⁻¹
        told = information[size:, size:] - cross.T @ open_ @ cross
        pull = score[size:] - cross.T @ open_ @ score[:size]
        last = eta
        eta, spread, slope, gain = most_likely(told, pull, prior, eta)
        payload = body(eta)[0]
        of_payload = slope @ spread @ slope.T
        back = -open_ @ cross
        joint = np.empty((size + PARAMETERS,) * 2)
        joint[:size, :size] = open_ + back @ of_payload @ back.T
        joint[:size, size:] = back @ of_payload
        joint[size:, :size] = joint[:size, size:].T
        joint[size:, size:] = of_payload
        room = PARAMETERS * np.diagonal(slope @ np.linalg.inv(prior.precision) @ slope.T)
        w = mean + open_ @ score[:size] + back @ payload
        left = residual - features.T @ np.concatenate([w - mean, payload])
        load = Load(np.concatenate([w, payload]), joint, room)
        if np.sqrt(np.max((eta - last) ** 2 / np.diagonal(spread))) < STILL:
            break
    # what an arm that is linear in its geometry gets wrong, its posterior does not say
    bent = Linearised(carrier, load).bend(rows.motion())
    load = replace(load, floor=(bent**2).mean(axis=0))
    return Estimate(eta, max(1.0, float((left**2).mean())) * spread, load, gain)


@dataclass(frozen=True)
class _Rows:
    """Features of rows around a load, (M + 10, N, n), and what the mean of the arm leaves of their torque, (N, n)."""

    features: Array
    residual: Array

    @classmethod
    def of(cls, carrier: Carrier, load: Load, rows: Rows, mean: Array) -> _Rows:
        features, base = Linearised(carrier, load).rows(rows.motion())
        return cls(features, rows.tau - base - np.tensordot(mean, features[: len(mean)], axes=1))

    def then(self, other: _Rows) -> _Rows:
        return _Rows(
            np.concatenate([self.features, other.features], axis=1), np.concatenate([self.residual, other.residual])
        )


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


def _whitened(roots: Array, rows: _Rows) -> tuple[Array, Array]:
    """Features (M + 10, N n) and residuals (N n,) whose errors are independent, of variance one."""
    both = np.concatenate([rows.features, rows.residual[None]]).transpose(2, 1, 0)
    solved = torch.linalg.solve_triangular(
        torch.from_numpy(roots), torch.from_numpy(np.ascontiguousarray(both)), upper=False
    )
    flat = solved.numpy().reshape(-1, both.shape[2]).T
    return flat[:-1], flat[-1]


def most_likely(told: Array, pull: Array, prior: Known, start: Array) -> tuple[Array, Array, Array, float]:
    """η that minimises ½ πᵀ Λ π − ξᵀ π + prior; its covariance, the slope there, and the evidence gained, nats."""

    def cost(eta: Array) -> float:
        payload, off = body(eta)[0], eta - prior.centre
        return float(0.5 * payload @ told @ payload - pull @ payload + 0.5 * off @ prior.precision @ off)

    eta, damping = start, DAMPING
    value = cost(eta)
    payload, slope = body(eta)
    for _ in range(STEPS):
        gradient = slope.T @ (told @ payload - pull) + prior.precision @ (eta - prior.centre)
        curvature = slope.T @ told @ slope + prior.precision
        step = -np.linalg.solve(curvature + damping * np.diag(np.diagonal(curvature)), gradient)
        step = step * min(1.0, 2.0 / max(float(np.abs(step / WIDTH).max()), 1e-300))
        trial = cost(eta + step)
        if trial > value:
            damping *= 10.0
            if damping > 1e8:
                break
            continue
        done = value - trial < 1e-9 * (1 + abs(value))
        eta, value, damping = eta + step, trial, max(0.1 * damping, 1e-9)
        payload, slope = body(eta)
        if done:
            break
    curvature = slope.T @ told @ slope + prior.precision
    volume = np.linalg.slogdet(curvature)[1] - np.linalg.slogdet(prior.precision)[1]
    return eta, _inverse(curvature), slope, -value - 0.5 * float(volume)


def _inverse(matrix: Array) -> Array:
    return np.asarray(np.linalg.inv(matrix), np.float64)
