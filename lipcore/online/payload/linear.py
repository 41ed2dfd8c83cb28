"""Estimate a payload on an arm with known geometry, or with a posterior taken as linear.

Given the variables w of the arm, N(ŵ, Σ), torque is linear in the payload's ten parameters π around its mean (see
`lipcore.model.payload`). H = [F, b] are the features of rows and R their variance. Integrating w out gives

    V = (Σ⁻¹ + Fᵀ R⁻¹ F)⁻¹,    Λ = bᵀ R⁻¹ b − bᵀ R⁻¹ F V Fᵀ R⁻¹ b,    ξ = bᵀ R⁻¹ r − bᵀ R⁻¹ F V Fᵀ R⁻¹ r,

all information of the rows about π. `bodies.most_likely` finds the most likely body. The rows are relinearised around
it, at most six times, until it changes by less than 0.05 of its standard deviations.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_triangular

from lipcore.data.samples import Array
from lipcore.model.payload import Carrier, LinearisedCarrier, PayloadPosterior
from lipcore.online.batch import Rows
from lipcore.online.payload.bodies import PayloadPrior, body, inverse, most_likely
from lipcore.online.payload.errors import correlation_roots, excess_variance, whiten
from lipcore.online.payload.estimate import Estimate, explain_unloaded
from lipcore.robots.urdf import PARAMETERS


def linear(carrier: Carrier, rows: Rows, before: Rows | None, prior: PayloadPrior, start: Estimate | None) -> Estimate:
    """Return the payload of the rows; arguments as of `payload.estimate`."""
    before = before if before is not None and len(before) else None
    both = rows if before is None else Rows.concatenate([before, rows])
    roots, mean, size = correlation_roots(carrier, both), carrier.mean, len(carrier.mean)
    loaded = rows.motion(), carrier.rest(rows.motion())
    free = None if before is None else (before.motion(), carrier.rest(before.motion()))
    empty = carrier.known(np.zeros(PARAMETERS))
    eta = prior.centre if start is None else start.eta
    load = empty if start is None else carrier.known(body(eta)[0])
    root = carrier.covariance_root
    for _ in range(6):
        features, base = LinearisedCarrier(carrier, load).rows(*loaded)
        if free is not None:
            others, torque = LinearisedCarrier(carrier, empty).rows(*free)
            others[size:] = 0.0
            features, base = np.concatenate([others, features], axis=1), np.concatenate([torque, base])
        residual = both.tau - base - np.tensordot(mean, features[:size], axes=1)
        features, residual = whiten(roots, features, residual)
        information, score = features @ features.T, features @ residual
        arm, cross = information[:size, :size], information[:size, size:]
        inner = np.linalg.cholesky(np.eye(size) + root.T @ arm @ root)
        half = solve_triangular(inner, root.T, lower=True, check_finite=False)
        open_ = half.T @ half  # (Σ⁻¹ + Fᵀ R⁻¹ F)⁻¹
        precision = information[size:, size:] - cross.T @ open_ @ cross
        pull = score[size:] - cross.T @ open_ @ score[:size]
        last = eta
        eta, spread, slope, gain = most_likely(precision, pull, prior, eta)
        payload = body(eta)[0]
        of_payload = slope @ spread @ slope.T
        back = -open_ @ cross
        joint: Array = np.empty((size + PARAMETERS,) * 2)
        joint[:size, :size] = open_ + back @ of_payload @ back.T
        joint[:size, size:] = back @ of_payload
        joint[size:, :size] = joint[:size, size:].T
        joint[size:, size:] = of_payload
        room = PARAMETERS * np.diagonal(slope @ inverse(prior.precision) @ slope.T)
        w = mean + open_ @ score[:size] + back @ payload
        left = residual - features.T @ np.concatenate([w - mean, payload])
        load = PayloadPosterior(
            np.concatenate([w, payload]), joint, room, excess=excess_variance(roots, left, len(rows))
        )
        if np.sqrt(np.max((eta - last) ** 2 / np.diagonal(spread))) < 0.05:
            break
    contact = explain_unloaded(carrier, free, loaded, both.tau, roots)[2]
    misfit = float((left**2).mean())
    return Estimate(eta, max(1.0, misfit) * spread, load, gain, contact, misfit=misfit)
