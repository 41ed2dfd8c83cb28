"""A fit of torque to motion that needs no robot, and how late by it the torque is.

Of each joint the fit has velocity, its smoothed sign, acceleration, cos q and sin q, unpenalised; and random products
of the kind that an arm's torque is made of, gravity, inertia and velocities' products under cosines of sums of
neighbouring angles, penalised by as much as generalised cross-validation asks for. On simulated arms with known delays
it is the second kind that makes lags right.

A lag is the shift of time at which motion explains torque best. Torque is fitted with the features of rows k steps
away, for every k up to a quarter of a second: the features are factored once, so that a shift costs one product. The
smallest residual is refined by a parabola. Leaving out an eighth of the recording at a time tells how sure that is;
where it is not, or the torque is not explained, the answer is that the data cannot tell. On a simulated Panda with
friction and noise, torque late by 0 or 20 ms, a joint's lag was wrong by 0.6 to 2.8 ms (root mean square) after 60 s at
100 or 250 Hz, and by 2 to 7 ms after 24 s at 30 Hz.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lipcore.data.samples import Array
from lipcore.kernels.friction import SIGN_WIDTH
from service.datasets.report.signals import Rows
from service.datasets.schema import Lag

OWN = 5
"""Features of each joint alone."""
PRODUCTS = 100
"""Random angles, with three features each."""
NEIGHBOURS = 3
"""Most joints whose angles are summed."""
PENALTIES = 10.0 ** np.arange(-8.0, 3.0)
"""Tried, as shares of a feature's variance."""
RIDGE = 1e-9
"""The same for what is not penalised: features that depend on each other stay harmless."""
USABLE = 0.5
"""Share of the independent rows that may be used up by weights."""
STILL = 1e-9
"""Spread below which a feature is constant."""
SEED = 5


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


def friction_terms(joint: int) -> tuple[int, int]:
    """Places of a joint's velocity and of its smoothed sign among the joints' own features."""
    return OWN * joint, OWN * joint + 1


def make_fit(rows: Rows, q: Array, dq: Array, ddq: Array, tau: Array, independent: float) -> Fit:
    """Factor the features of some rows; q, dq, ddq, tau: (R, n) of these, the last to choose the penalty by.

    independent: how many samples of the recording count as independent.
    """
    joints = q.shape[1]
    own, means, scales = _scaled([f for j in range(joints) for f in own_features(q[:, j], dq[:, j], ddq[:, j])])
    lower = np.linalg.cholesky(own.T @ own + RIDGE * len(rows) * np.eye(own.shape[1]))
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
    """Random terms of an arm's torque, the same every time: 3 PRODUCTS columns (R,)."""
    rng = np.random.default_rng(SEED)
    joints = q.shape[1]
    out = []
    for _ in range(PRODUCTS):
        first, count = rng.integers(joints), rng.integers(1, NEIGHBOURS + 1)
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
    scales: Array = np.where(wide > STILL * (1 + np.abs(means)), wide, np.inf)
    raw -= means
    raw /= scales
    return raw, means, scales


def _penalty(values: Array, projected: Array, rest: Array, own: int, independent: float) -> float | None:
    """The penalty that generalised cross-validation likes best; None where there are rows for no products at all.

    values: (p,) squared singular values of the products; projected: (p, n) torques along them; rest: (R, n) torques.
    """
    squares = np.sum(rest**2, axis=0)
    chosen, lowest = None, np.inf
    for penalty in len(rest) * PENALTIES:
        used = own + float(np.sum(values / (values + penalty)))
        if used > USABLE * independent:
            continue
        share = 1 / (values + penalty) + penalty / (values + penalty) ** 2
        left = np.maximum(squares - share @ projected**2, 1e-12 * squares + 1e-300)
        score = float(np.sum(np.log(left))) - 2 * rest.shape[1] * np.log(1 - used / independent)
        if score < lowest:
            chosen, lowest = float(penalty), score
    return chosen


LARGEST_S = 0.25
"""Largest lag looked for, s."""
MOST_SHIFTS = 60
"""Shifts to either side that are tried."""
EIGHTHS = 8
CAUTION = 1.5
"""How many times larger errors are than leaving out an eighth at a time says: on a simulated Panda with known delays
0.8 to 2.3 times, as it cannot tell what the fit gets wrong everywhere."""
DISTINCT = 1.2
"""How many times worse the fit has to be at either end of the shifts than at its best: else any shift would do."""
FINEST_S = 1e-3
"""Added to a joint's standard deviation where joints are taken together, s: none is to outweigh all others."""
UNSURE_S = 0.01
"""Standard deviation from which on a lag cannot be told, s."""
UNEXPLAINED = 0.5
"""Share of the torque's variance that may be left unexplained at the best shift."""


def shifts(rate: float, longest_part: int) -> Rows | None:
    """Steps to shift by, ascending and symmetric about 0; None where the parts are too short for three."""
    most = min(int(LARGEST_S * rate), longest_part // 8)
    if most < 2:
        return None
    every = max(1, round(most / MOST_SHIFTS))
    return np.asarray(every * np.arange(-(most // every), most // every + 1), np.int64)


class Lags:
    """Residuals over shifts, joint after joint."""

    def __init__(self, fit: Fit, steps: Rows, rate: float) -> None:
        self.fit, self.steps, self.rate = fit, steps, rate
        self._blocks = np.linspace(0, len(fit.rows), EIGHTHS + 1).astype(np.int64)
        self._known: list[tuple[float, float]] = []

    def of_joint(self, name: str, tau: Array) -> tuple[Lag, float]:
        """Lag of a joint with torque tau (M,) at all rows, and the fit's residual standard deviation at that."""
        shifted = tau[self.fit.rows[:, None] + self.steps]
        variance = float(tau[self.fit.rows].var())
        if variance == 0:
            return _unknown(name, "the torque is constant"), 0.0
        squares = self.fit.residuals(shifted) ** 2
        block = np.add.reduceat(squares, self._blocks[:-1], axis=0)
        total = block.sum(axis=0)
        curves = np.vstack([total, total - block])  # all rows, then all but one eighth
        best = total.min() / len(squares)
        middle = len(self.steps) // 2
        cost = max(0.0, total[middle] / len(squares) - best) / variance
        lag = self._judge(name, curves, cost, best / variance)
        if lag.seconds is not None and lag.std_s is not None:
            self._known.append((lag.seconds, lag.std_s))
        return lag, float(np.sqrt(best))

    def of_all(self) -> Lag:
        """What the joints that tell a lag say together, as one clock would have it; less sure where they disagree."""
        if not self._known:
            return _unknown(None, "no joint tells")
        seconds, std = np.array(self._known).T
        weight = 1 / (std**2 + FINEST_S**2)
        mean = float(weight @ seconds / weight.sum())
        misfit = float(weight @ (seconds - mean) ** 2) / max(1, len(seconds) - 1)
        return Lag(
            joint=None, seconds=mean, std_s=float(np.sqrt(max(1.0, misfit) / weight.sum())), cost=None, reason=None
        )

    def _judge(self, name: str, curves: Array, cost: float, unexplained: float) -> Lag:
        """curves: squared residuals over the shifts, of all rows first, then without an eighth each, (9, S)."""
        if unexplained > UNEXPLAINED:
            return _unknown(name, f"motion explains only {1 - unexplained:.0%} of the torque")
        if min(curves[0, 0], curves[0, -1]) < DISTINCT * curves[0].min():
            return _unknown(
                name, "one shift of time explains the torque about as well as another: record faster motion"
            )
        lowest = np.array([self._lowest(curve) for curve in curves])
        if np.isnan(lowest).any():
            return _unknown(name, "no shift of time is better than its neighbours: record faster motion")
        left_out = lowest[1:]
        std = CAUTION * float(np.sqrt((EIGHTHS - 1) / EIGHTHS * np.sum((left_out - left_out.mean()) ** 2)))
        if std > UNSURE_S:
            return _unknown(name, f"parts of the recording differ by {1e3 * std:.0f} ms: record faster motion")
        return Lag(joint=name, seconds=float(lowest[0]), std_s=std, cost=cost, reason=None)

    def _lowest(self, curve: Array) -> float:
        """Lowest point of a curve over the shifts, s; NaN at its ends."""
        k = int(curve.argmin())
        if k in (0, len(curve) - 1):
            return float("nan")
        before, here, after = curve[k - 1 : k + 2]
        bend = before - 2 * here + after
        part = 0.5 * (before - after) / bend if bend > 0 else 0.0
        every = float(self.steps[1] - self.steps[0])
        return (float(self.steps[k]) + part * every) / self.rate


def _unknown(name: str | None, reason: str) -> Lag:
    return Lag(joint=name, seconds=None, std_s=None, cost=None, reason=reason)


def no_lags(names: tuple[str, ...], reason: str) -> list[Lag]:
    """The answer where lags cannot be looked for at all."""
    return [_unknown(name, reason) for name in (None, *names)]
