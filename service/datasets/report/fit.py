"""Fit of torque to motion without a robot model.

Features of each joint are velocity, its smoothed sign, acceleration, cos q and sin q, without penalty. Further features
are random terms of the form of an arm's torque: gravity, inertia and velocity products, times cosines of sums of
neighbouring angles. Generalised cross-validation sets their penalty. On simulated arms with known delays, lags are
correct only with these terms.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lipcore.data.samples import Array
from lipcore.kernels.drive.terms import SIGN_WIDTH
from service.datasets.report.signals import Rows

OWN_FEATURES = ("dq", "sign dq", "ddq", "cos q", "sin q")
"""Features of each joint alone."""


@dataclass(frozen=True)
class MotionFitOptions:
    """Numbers of the fit of torque to motion."""

    products: int = 100
    """Random angles, with three features each."""
    max_neighbours: int = 3
    """Max joints with summed angles."""
    ridge: float = 1e-9
    """Penalty of the joints' own features, as a share of their variance, for collinear features."""
    max_used: float = 0.5
    """Max degrees of freedom of the fit, as a share of the independent rows."""
    min_spread: float = 1e-9
    """Spread, relative to the size, at which a feature is constant."""
    parts: int = 8
    """Parts of a recording that are held out one at a time."""


FIT = MotionFitOptions()


@dataclass(frozen=True)
class Fit:
    """Features of R rows of motion, factored once for any torque."""

    rows: Rows
    """Rows of the prepared recording, (R,)."""
    whitened: Array
    """Whitened features W, (p, R); the hat matrix is Wᵀ W."""
    covariance: Array
    """Covariance of the joints' own weights for noise variance 1 and scaled features, (5 n, 5 n)."""
    means: Array
    """Means of the joints' own features, (5 n,)."""
    scales: Array
    """Standard deviations of these features, infinite for a constant one, (5 n,)."""
    independent: float
    """Effective samples of the recording."""

    def residuals(self, y: Array) -> Array:
        """Return the residuals of torques y (R, k), means removed: (R, k)."""
        centred = y - y.mean(axis=0)
        return np.asarray(centred - self.whitened.T @ (self.whitened @ centred))

    def held_out(self, y: Array) -> Array:
        """Return the squared error of torques y (R, k) on each held-out eighth of the rows: (8, k).

        With the residual r and the hat matrix H of all rows, the held-out residual of a part B is (I − H_BB)⁻¹ r_B.
        """
        left, rows = self.residuals(y), len(y)
        hat = np.vstack([np.full(rows, rows**-0.5), self.whitened])
        out = []
        for first, last in pairwise(np.linspace(0, rows, FIT.parts + 1).astype(np.int64)):
            part, own = hat[:, first:last], left[first:last]
            inner = (1 + FIT.ridge) * np.eye(len(hat)) - part @ part.T
            out.append(np.sum((own + part.T @ np.linalg.solve(inner, part @ own)) ** 2, axis=0))
        return np.array(out)


def friction_terms(joint: int) -> tuple[int, int]:
    """Return the indices of a joint's velocity and its smoothed sign among the joints' own features."""
    return len(OWN_FEATURES) * joint, len(OWN_FEATURES) * joint + 1


def make_fit(rows: Rows, q: Array, dq: Array, ddq: Array, tau: Array, independent: float) -> Fit:
    """Factor the features of some rows, and choose the penalty by their torque; q, dq, ddq, tau: (R, n).

    independent: effective samples of the recording.
    """
    joints = q.shape[1]
    own, means, scales = _scaled([f for j in range(joints) for f in own_features(q[:, j], dq[:, j], ddq[:, j])])
    lower = np.linalg.cholesky(own.T @ own + FIT.ridge * len(rows) * np.eye(own.shape[1]))
    # the inverse of the product would be inaccurate for nearly collinear features
    inverse = np.asarray(np.linalg.inv(lower), np.float64)
    free, whitened = inverse.T @ inverse, inverse @ own.T
    products, _, _ = _scaled(_products(q, dq, ddq))
    shared = own.T @ products
    products -= own @ (free @ shared)
    values, vectors = np.linalg.eigh(products.T @ products)
    values = np.maximum(values, 0.0)
    centred = tau - tau.mean(axis=0)
    rest = centred - whitened.T @ (whitened @ centred)
    penalty = _penalty(values, vectors.T @ (products.T @ rest), rest, own.shape[1], min(independent, len(rows)))
    if penalty is None:
        return Fit(rows, whitened, free, means, scales, independent)
    weight = 1 / np.sqrt(values + penalty)
    spill = free @ shared @ (vectors * weight)
    return Fit(
        rows,
        np.vstack([whitened, (vectors * weight).T @ products.T]),
        free + spill @ spill.T,
        means,
        scales,
        independent,
    )


def own_features(q: Array, dq: Array, ddq: Array) -> tuple[Array, ...]:
    """Return one joint's velocity, its smoothed sign, acceleration, cos q and sin q, from columns (R,)."""
    return dq, np.tanh(dq / SIGN_WIDTH), ddq, np.cos(q), np.sin(q)


def _products(q: Array, dq: Array, ddq: Array) -> list[Array]:
    """Return random terms of an arm's torque with a fixed seed: three columns (R,) per angle."""
    rng = np.random.default_rng(5)
    joints = q.shape[1]
    out = []
    for _ in range(FIT.products):
        first, count = rng.integers(joints), rng.integers(1, FIT.max_neighbours + 1)
        neighbours = slice(first, first + count)
        signs = rng.choice([-1.0, 1.0], len(q[0, neighbours]))
        wave = np.cos(q[:, neighbours] @ signs + np.pi / 2 * rng.integers(2))
        i, k = rng.integers(joints, size=2)
        out += [wave, wave * ddq[:, i], wave * dq[:, i] * dq[:, k]]
    return out


def _scaled(columns: list[Array]) -> tuple[Array, Array, Array]:
    """Return columns with zero mean and unit variance, their means and scales; constant columns become zero."""
    raw = np.column_stack(columns)
    means: Array = raw.mean(axis=0)
    wide = raw.std(axis=0)
    scales: Array = np.where(wide > FIT.min_spread * (1 + np.abs(means)), wide, np.inf)
    raw -= means
    raw /= scales
    return raw, means, scales


def _penalty(values: Array, projected: Array, rest: Array, own: int, independent: float) -> float | None:
    """Return the best penalty by generalised cross-validation, None if there are too few rows for products.

    values: (p,) squared singular values of the products; projected: (p, n) torques along them; rest: (R, n) torques.
    """
    squares = np.sum(rest**2, axis=0)
    chosen, lowest = None, np.inf
    for penalty in len(rest) * 10.0 ** np.arange(-8.0, 3.0):  # shares of a feature's variance
        used = own + float(np.sum(values / (values + penalty)))
        if used > FIT.max_used * independent:
            continue
        share = 1 / (values + penalty) + penalty / (values + penalty) ** 2
        left = np.maximum(squares - share @ projected**2, 1e-12 * squares + 1e-300)
        score = float(np.sum(np.log(left))) - 2 * rest.shape[1] * np.log(1 - used / independent)
        if score < lowest:
            chosen, lowest = float(penalty), score
    return chosen
