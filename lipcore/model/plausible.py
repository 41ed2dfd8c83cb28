"""Physically possible bodies: which ten parameters are plausible, and the plausible ones nearest to an estimate."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array
from lipcore.robots.urdf import PARAMETERS


def pseudo_inertia(body: Array) -> Array:
    """Return the pseudo-inertia [[Σ, h], [hᵀ, m]] of ten parameters, (4, 4): positive definite for every real body."""
    mass, moment = body[0], body[1:4]
    xx, xy, yy, xz, yz, zz = body[4:]
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    out = np.empty((4, 4))
    out[:3, :3] = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    out[:3, 3] = out[3, :3] = moment
    out[3, 3] = mass
    return out


def is_plausible(body: Array) -> bool:
    """Return whether ten parameters belong to a body that can exist: its pseudo-inertia is positive definite."""
    return bool(np.linalg.eigvalsh(pseudo_inertia(body))[0] > 0)


def nearest_solid(body: Array, least: float) -> Array:
    """Return the ten parameters of the nearest body with a second moment of at least `least` kg·m² along every axis.

    Mass, which must be positive, and centre of mass stay. The distance is that of the second moments about the centre
    of mass (Frobenius norm). A body that has them is returned as it is.
    """
    mass, centre = body[0], body[1:4] / body[0]
    spread = pseudo_inertia(body)[:3, :3] - mass * np.outer(centre, centre)
    values, vectors = np.linalg.eigh(spread)
    if values[0] >= least:
        return body
    spread = (vectors * np.maximum(values, least)) @ vectors.T + mass * np.outer(centre, centre)
    inertia = np.trace(spread) * np.eye(3) - spread
    return np.concatenate([body[:4], inertia[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]])


def nearest_plausible(
    mean: Array,
    scale: Array,
    metric: Array,
    n: int,
    start: Array | None = None,
    positive: NDArray[np.int64] | None = None,
    last: float = 1e-3,
    spread: Array | None = None,
) -> Array:
    """Return the weights (p,) nearest to a mean (p,) that describe plausible bodies in their first 10 n elements.

    metric: (p, p), of weights in units of `scale` (p,). This is a convex problem: ½ |w − μ|² in that metric, subject to
    each body's pseudo-inertia being at least that of a tiny real one. Newton's method follows the central path of a
    barrier, −t Σ log det, as in Boyd & Vandenberghe, § 11. start: (n, 10), a plausible guess; balls replace bodies that
    cannot exist. positive: places of weights that cannot be negative, such as rotors and friction. last:
    barrier, after which at most 4 n times its value of the squared distance remain. spread: min second moment of each
    body about its centre of mass along every axis, relative to its mass, (n,) m².
    """
    signed = np.zeros(0, np.int64) if positive is None else positive
    size = PARAMETERS * n
    given = np.zeros((n, PARAMETERS)) if start is None else start
    total = max(float(mean[:size:PARAMETERS].sum()), float(given[:, 0].sum()), 1e-3)
    # at least a ten-thousandth of the arm's mass, spread by 1 mm along each axis, since no real body is a point
    least = 1e-4 * total * np.diag([1e-6, 1e-6, 1e-6, 1.0])
    centre = mean / scale
    wide = np.zeros(n) if spread is None else spread
    basis = np.tile(np.array([pseudo_inertia(unit) for unit in np.eye(PARAMETERS)]), (n, 1, 1, 1))
    basis[:, 0, :3, :3] -= wide[:, None, None] * np.eye(3)

    def matrices(point: Array) -> Array:
        bodies = (point * scale)[:size].reshape(n, PARAMETERS)
        return np.asarray(np.einsum("nk,nkij->nij", bodies, basis) - least)

    def value(point: Array, barrier: float) -> float:
        signs, logs = np.linalg.slogdet(matrices(point))
        if (signs <= 0).any() or (np.linalg.eigvalsh(matrices(point))[:, 0] <= 0).any():
            return np.inf
        if (point[signed] <= 0).any():
            return np.inf
        off = point - centre
        return float(0.5 * off @ metric @ off - barrier * (logs.sum() + np.log(point[signed]).sum()))

    point = centre.copy()
    begin = [_replace_impossible(body, total / n, least, each) for body, each in zip(given, wide, strict=True)]
    point[:size] = np.concatenate(begin) / scale[:size]
    point[signed] = np.maximum(point[signed], 1e-3)
    for barrier in 10.0 ** np.arange(3, np.log10(last) - 0.5, -1):
        for _ in range(30):
            inverse = np.linalg.inv(matrices(point))
            turned = np.einsum("nij,nkjl->nkil", inverse, basis)  # P⁻¹ E_k
            slope = np.einsum("nkii->nk", turned).reshape(-1) * scale[:size]
            bend = np.einsum("nkij,nlji->nkl", turned, turned)
            gradient = metric @ (point - centre)
            gradient[:size] -= barrier * slope
            gradient[signed] -= barrier / point[signed]
            hessian = metric.copy()
            for body in range(n):
                part = slice(PARAMETERS * body, PARAMETERS * (body + 1))
                hessian[part, part] += barrier * bend[body] * np.outer(scale[part], scale[part])
            hessian[signed, signed] += barrier / point[signed] ** 2
            try:
                step = -np.linalg.solve(hessian, gradient)
            except np.linalg.LinAlgError:  # the point is at the boundary to rounding, and still plausible
                break
            slack, length, now = float(-gradient @ step), 1.0, value(point, barrier)
            while length > 1e-8 and value(point + length * step, barrier) > now - 0.1 * length * slack:
                length *= 0.5
            if length <= 1e-8:
                break
            point = point + length * step
            if slack < 1e-3 * barrier:
                break
    return np.asarray(point * scale)


def _replace_impossible(body: Array, usual_mass: float, least: Array, wide: float) -> Array:
    """Return the body, or a ball of the usual mass if the body cannot exist. wide: see `spread`."""
    bound = least + body[0] * wide * np.diag([1.0, 1.0, 1.0, 0.0])
    if np.linalg.eigvalsh(pseudo_inertia(body) - 2 * bound)[0] > 0:
        return body
    ball = max(0.4 * usual_mass * 0.05**2, 5 * (least[0, 0] + usual_mass * wide))
    return np.array([usual_mass, 0, 0, 0, ball, 0, ball, 0, 0, ball])
