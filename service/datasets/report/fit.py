"""A fit of torque to motion that needs no robot.

Of each joint the fit has velocity, its smoothed sign, acceleration, cos q and sin q, unpenalised; and random products
of the kind that an arm's torque is made of, gravity, inertia and velocities' products under cosines of sums of
neighbouring angles, penalised by as much as generalised cross-validation asks for. On simulated arms with known delays
it is the second kind that makes lags right.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lipcore.data.samples import Array
from lipcore.kernels.friction import SIGN_WIDTH
from service.datasets.report.signals import Rows

OWN_FEATURES = ("dq", "sign dq", "ddq", "cos q", "sin q")
"""Features of each joint alone."""


@dataclass(frozen=True)
class MotionFitOptions:
    """Numbers of the fit of torque to motion."""

    products: int = 100
    """Random angles, with three features each."""
    max_neighbours: int = 3
    """Max joints whose angles are summed."""
    ridge: float = 1e-9
    """Penalty of the joints' own features, as a share of their variance: collinear features stay harmless."""
    max_used: float = 0.5
    """Max share of the independent rows that the weights use up."""
    min_spread: float = 1e-9
    """Spread, relative to the size, at which a feature is constant."""
    parts: int = 8
    """Parts of a recording that are held out one at a time."""


FIT = MotionFitOptions()


@dataclass(frozen=True)
class Fit:
    """Features of R rows of motion, factored once for any torque.

    rows: (R,) of the prepared recording; whitened: (p, R), its product with itself is the hat matrix; covariance:
    (5 n, 5 n) of the joints' own weights, noise variance 1, features scaled; means, scales: (5 n,) of these features,
    scale infinite where one is constant; independent: how many samples of the recording count as independent.
    """

    rows: Rows
    whitened: Array
    covariance: Array
    means: Array
    scales: Array
    independent: float

    def residuals(self, y: Array) -> Array:
        """What the fit leaves of torques y (R, k), means taken out: (R, k)."""
        centred = y - y.mean(axis=0)
        return np.asarray(centred - self.whitened.T @ (self.whitened @ centred))

    def held_out(self, y: Array) -> Array:
        """Squared error on each eighth of the rows of fits without it, of torques y (R, k): (8, k).

        With the residual r and the hat matrix H of all rows, that on a part B is (I − H_BB)⁻¹ r_B.
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
    """Places of a joint's velocity and of its smoothed sign among the joints' own features."""
    return len(OWN_FEATURES) * joint, len(OWN_FEATURES) * joint + 1


def make_fit(rows: Rows, q: Array, dq: Array, ddq: Array, tau: Array, independent: float) -> Fit:
    """Factor the features of some rows; q, dq, ddq, tau: (R, n) of these, the last to choose the penalty by.

    independent: how many samples of the recording count as independent.
    """
    joints = q.shape[1]
    own, means, scales = _scaled([f for j in range(joints) for f in own_features(q[:, j], dq[:, j], ddq[:, j])])
    lower = np.linalg.cholesky(own.T @ own + FIT.ridge * len(rows) * np.eye(own.shape[1]))
    inverse = np.asarray(np.linalg.inv(lower), np.float64)  # not that of the product: features may be nearly collinear
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
    """One joint's velocity, smoothed sign of it, acceleration, cos q and sin q, from columns (R,)."""
    return dq, np.tanh(dq / SIGN_WIDTH), ddq, np.cos(q), np.sin(q)


def _products(q: Array, dq: Array, ddq: Array) -> list[Array]:
    """Random terms of an arm's torque, the same every time: three columns (R,) a product."""
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
    """Columns with zero mean and unit variance, their means and scales; constant ones become zero."""
    raw = np.column_stack(columns)
    means: Array = raw.mean(axis=0)
    wide = raw.std(axis=0)
    scales: Array = np.where(wide > FIT.min_spread * (1 + np.abs(means)), wide, np.inf)
    raw -= means
    raw /= scales
    return raw, means, scales


def _penalty(values: Array, projected: Array, rest: Array, own: int, independent: float) -> float | None:
    """The penalty that generalised cross-validation likes best; None where there are rows for no products at all.

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
