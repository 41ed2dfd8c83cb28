"""Parametrise physically possible bodies by ten free numbers, and find the most likely body.

A body has a positive mass and a positive definite second moment. Its ten parameters π are a function of ten free
numbers η: log mass, centre of mass, and the Cholesky factor of the spread about it. η has a Gaussian prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lipcore.data.samples import Array
from lipcore.model.body import Body
from lipcore.robots.urdf import PARAMETERS

ETA_MEAN = np.array([0.0, 0, 0, 0, *[np.log(0.04)] * 3, 0, 0, 0])
ETA_STD = np.array([1.2, 0.15, 0.15, 0.15, 0.7, 0.7, 0.7, 0.03, 0.03, 0.03])
"""Prior of η: log kg; m; log m; m. Nineteen of twenty payloads weigh 0.1 to 10 kg, lie within 0.3 m of the last link's
frame and spread over 1 to 16 cm."""
UNIT_BODY = np.array([1.0, *[0.13] * 3, *[0.14**2] * 6])
"""Parameters of a body of 1 kg, about 0.13 m away and with a radius of gyration of 0.14 m."""
CONTACT_SCALES = (1.0, 3.0)
"""Scales of a contact's torque, in units of `typical_torque`."""


def body(eta: Array) -> tuple[Array, Array]:
    """Return the ten parameters of η, (10,), and their derivative, (10, 10)."""
    mass, com, scale = np.exp(eta[0]), eta[1:4], np.exp(eta[4:7])
    root = np.zeros((3, 3))
    root[DIAGONAL], root[BELOW] = scale, eta[7:]
    inertia = INERTIA @ (root @ root.T + com[:, None] * com).reshape(-1)
    out = np.concatenate([[1.0], com, inertia]) * mass
    slope = np.zeros((PARAMETERS, PARAMETERS))
    slope[:, 0] = out
    slope[[1, 2, 3], [1, 2, 3]] = mass
    # the derivative of C Cᵀ + E Eᵀ is twice the symmetric part of that of its left factor
    slope[4:, 1:4] = 2 * mass * (INERTIA.reshape(6, 3, 3) @ com)
    rows, columns = np.concatenate([DIAGONAL, BELOW], axis=1)
    change = 2 * mass * (INERTIA.reshape(6, 3, 3) @ root)[:, rows, columns]
    change[:, :3] *= scale
    slope[4:, 4:] = change
    return out, slope


DIAGONAL, BELOW = (np.arange(3), np.arange(3)), (np.array([1, 2, 2]), np.array([0, 0, 1]))
INERTIA = np.array(
    [(np.trace(unit) * np.eye(3) - 0.5 * (unit + unit.T))[np.tril_indices(3)] for unit in np.eye(9).reshape(9, 3, 3)]
).T
"""Maps a flat second moment to xx, xy, yy, xz, yz, zz: tr(S) 1 − S, symmetrised, (6, 9)."""


@dataclass(frozen=True)
class PayloadPrior:
    """Prior of η: N(centre, precision⁻¹), (10,) and (10, 10)."""

    centre: Array
    precision: Array


ANY_PAYLOAD = PayloadPrior(ETA_MEAN, np.diag(ETA_STD**-2.0))
"""Prior of an unknown payload."""


def eta_of(carried: Body) -> Array:
    """Return η of a body, (10,). A body without extent gets a small one."""
    inertia = np.zeros((3, 3)) if carried.inertia is None else carried.inertia
    spread = (0.5 * np.trace(inertia) * np.eye(3) - inertia) / carried.mass
    root = np.linalg.cholesky(spread + 1e-6 * np.eye(3))  # (1 mm)²
    return np.concatenate([[np.log(carried.mass)], carried.com, np.log(root[DIAGONAL]), root[BELOW]])


def most_likely(
    information: Array, pull: Array, prior: PayloadPrior, start: Array
) -> tuple[Array, Array, Array, float]:
    """Return η that minimises ½ πᵀ Λ π − ξᵀ π + prior; its covariance, dπ/dη and the evidence gained, nats.

    information: Λ; pull: ξ.
    """

    def cost(eta: Array) -> float:
        payload, off = body(eta)[0], eta - prior.centre
        return float(0.5 * payload @ information @ payload - pull @ payload + 0.5 * off @ prior.precision @ off)

    eta, damping = start, 1e-3
    value = cost(eta)
    payload, slope = body(eta)
    for _ in range(50):
        gradient = slope.T @ (information @ payload - pull) + prior.precision @ (eta - prior.centre)
        curvature = slope.T @ information @ slope + prior.precision
        step = -np.linalg.solve(curvature + damping * np.diag(np.diagonal(curvature)), gradient)
        step = step * min(1.0, 2.0 / max(float(np.abs(step / ETA_STD).max()), 1e-300))
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
    curvature = slope.T @ information @ slope + prior.precision
    volume = np.linalg.slogdet(curvature)[1] - np.linalg.slogdet(prior.precision)[1]
    return eta, inverse(curvature), slope, -value - 0.5 * float(volume)


def inverse(matrix: Array) -> Array:
    """Return the inverse of a covariance or a precision."""
    return np.asarray(np.linalg.inv(matrix), np.float64)


def typical_torque(features: Array) -> float:
    """Return the torque of a payload of 1.5 kg on its most loaded joint, N·m. features: of its parameters, (10, n)."""
    return float(np.sqrt(((features * (1.5 * UNIT_BODY)[:, None]) ** 2).sum(axis=0).max()))


def evidence(gram: Array, pull: Array, scales: Sequence[Array]) -> Array:
    """Return the evidence gained by each of K sets of features, (K,) nats.

    The coefficients are N(0, diag scale²); the evidence is averaged over the scales. gram: Fᵀ C⁻¹ F, (K, p, p); pull:
    Fᵀ C⁻¹ r, (K, p), with the covariance C of the residuals r.
    """
    scale = np.array(scales)[:, None]  # (S, 1, p)
    total = np.eye(gram.shape[-1]) + scale[..., None] * gram * scale[..., None, :]
    scaled = scale * pull
    solved = np.linalg.solve(total, scaled[..., None])[..., 0]
    gained = 0.5 * (scaled * solved).sum(axis=-1) - 0.5 * np.linalg.slogdet(total)[1]
    return np.asarray(np.logaddexp.reduce(gained, axis=0) - np.log(len(scales)))
