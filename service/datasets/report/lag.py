"""Time lag of the torque behind the motion.

The lag is the time shift at which motion explains torque best. Torque of rows k steps away is fitted with the features
of motion, for shifts of up to 0.25 s. The features are factored once, so a shift costs one product. A parabola refines
the minimum of the residual. Its standard deviation comes from leaving out one eighth of the recording at a time. If
that is large, or motion does not explain the torque, the lag is unknown.

Measured on a simulated Panda with friction and noise, and a lag of 0 or 20 ms: the root-mean-square error of a joint's
lag is 0.6 to 2.8 ms after 60 s at 100 or 250 Hz, and 2 to 7 ms after 24 s at 30 Hz.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lipcore.data.samples import Array
from service.contract.datasets import Lag
from service.datasets.report import texts
from service.datasets.report.fit import FIT, Fit
from service.datasets.report.signals import Rows


@dataclass(frozen=True)
class LagOptions:
    """Thresholds of a known lag."""

    max_s: float = 0.25
    """Max lag that is tried, s."""
    max_shifts: int = 60
    """Max shifts to either side that are tried."""
    caution: float = 1.5
    """Factor on the standard deviation, which lacks errors that all fits share. On a simulated Panda with known delays,
    the true ratio is 0.8 to 2.3."""
    distinct: float = 1.2
    """Min ratio of the errors at both ends of the shifts to the lowest error; below it, any shift fits."""
    min_std_s: float = 1e-3
    """Added to a joint's standard deviation when joints are combined, s, so that no joint dominates."""
    stds: float = 3.0
    """Standard deviations by which a lag has to differ from 0."""
    max_std_s: float = 0.01
    """Max standard deviation of a known lag, s."""
    min_gain: float = 0.05
    """Min share of the error on held-out eighths that a shift removes."""
    gain_stds: float = 3.0
    """Standard errors, over the eighths, by which this share differs from 0."""
    max_unexplained: float = 0.5
    """Max share of the torque's variance that is unexplained at the best shift."""


LAG = LagOptions()


def shifts(rate: float, longest_part: int) -> Rows | None:
    """Return the shifts in rows, ascending and symmetric about 0; None if the parts are too short."""
    longest = min(int(LAG.max_s * rate), longest_part // 8)
    if longest < 2:
        return None
    every = max(1, round(longest / LAG.max_shifts))
    return np.asarray(every * np.arange(-(longest // every), longest // every + 1), np.int64)


class Lags:
    """Estimates of the lags of all joints, one joint at a time."""

    def __init__(self, fit: Fit, steps: Rows, rate: float) -> None:
        self.fit, self.steps, self.rate = fit, steps, rate
        self._blocks = np.linspace(0, len(fit.rows), FIT.parts + 1).astype(np.int64)
        self._known: list[tuple[float, float]] = []

    def estimate_joint(self, name: str, tau: Array) -> tuple[Lag, float]:
        """Return the lag of a joint with torque tau (M,), and the residual standard deviation at that lag."""
        shifted = tau[self.fit.rows[:, None] + self.steps]
        variance = float(tau[self.fit.rows].var())
        if variance == 0:
            return _unknown(name, texts.CONSTANT_TORQUE), 0.0
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

    def lowers_error(self, tau: Array, seconds: float) -> bool:
        """Return whether shifting a joint's torque tau (M,) clearly lowers its error on held-out eighths."""
        at = self.fit.rows + np.clip(seconds * self.rate, self.steps[0], self.steps[-1])
        shifted = np.interp(at, np.arange(len(tau)), tau)
        here, there = self.fit.held_out(np.column_stack([tau[self.fit.rows], shifted])).T
        less = here - there
        often = less.mean() > LAG.gain_stds * less.std(ddof=1) / np.sqrt(FIT.parts)
        return bool(often and less.sum() > LAG.min_gain * here.sum())

    def combine(self) -> Lag:
        """Return the mean of the known lags; its standard deviation grows if they disagree."""
        if not self._known:
            return _unknown(None, texts.NO_KNOWN_LAG)
        seconds, std = np.array(self._known).T
        weight = 1 / (std**2 + LAG.min_std_s**2)
        mean = float(weight @ seconds / weight.sum())
        misfit = float(weight @ (seconds - mean) ** 2) / max(1, len(seconds) - 1)
        return Lag(joint=None, seconds=mean, std_s=float(np.sqrt(max(1.0, misfit) / weight.sum())))

    def _judge(self, name: str, curves: Array, cost: float, unexplained: float) -> Lag:
        """Return the lag by squared residuals over the shifts, (9, S): of all rows, then without each eighth."""
        if unexplained > LAG.max_unexplained:
            return _unknown(name, texts.unexplained_torque(1 - unexplained))
        if min(curves[0, 0], curves[0, -1]) < LAG.distinct * curves[0].min():
            return _unknown(name, texts.ALL_SHIFTS_ALIKE)
        lowest = np.array([self._lowest(curve) for curve in curves])
        if np.isnan(lowest).any():
            return _unknown(name, texts.NO_BEST_SHIFT)
        left_out = lowest[1:]
        std = LAG.caution * float(np.sqrt((FIT.parts - 1) / FIT.parts * np.sum((left_out - left_out.mean()) ** 2)))
        if std > LAG.max_std_s:
            return _unknown(name, texts.parts_differ(std))
        return Lag(joint=name, seconds=float(lowest[0]), std_s=std, cost=cost)

    def _lowest(self, curve: Array) -> float:
        """Return the lag at the minimum of a curve over the shifts, s; NaN if it is at an end."""
        k = int(curve.argmin())
        if k in (0, len(curve) - 1):
            return float("nan")
        before, here, after = curve[k - 1 : k + 2]
        bend = before - 2 * here + after
        part = 0.5 * (before - after) / bend if bend > 0 else 0.0
        every = float(self.steps[1] - self.steps[0])
        return (float(self.steps[k]) + part * every) / self.rate


def is_nonzero(lag: Lag) -> bool:
    """Return whether a lag is known and differs from 0."""
    return lag.seconds is not None and lag.std_s is not None and abs(lag.seconds) > LAG.stds * lag.std_s


def _unknown(name: str | None, reason: str) -> Lag:
    return Lag(joint=name, reason=reason)


def unknown_lags(names: tuple[str, ...], reason: str) -> list[Lag]:
    """Return the lags of a recording that does not allow an estimate."""
    return [_unknown(name, reason) for name in (None, *names)]
