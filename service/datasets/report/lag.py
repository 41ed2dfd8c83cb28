"""How late torque is by its fit to motion.

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
from service.contract.datasets import Lag
from service.datasets.report.fit import FIT, Fit
from service.datasets.report.signals import Rows
from service.foundation.text import percent


@dataclass(frozen=True)
class LagOptions:
    """When a lag counts as known."""

    max_s: float = 0.25
    """Max lag that is tried, s."""
    max_shifts: int = 60
    """Max shifts to either side that are tried."""
    caution: float = 1.5
    """True error over that of leaving out an eighth at a time, which misses what the fit gets wrong everywhere: 0.8 to
    2.3 on a simulated Panda with known delays."""
    distinct: float = 1.2
    """Ratio of errors at either end of the shifts to the lowest; below it any shift would do."""
    min_std_s: float = 1e-3
    """Added to a joint's standard deviation where joints are combined, s: no joint outweighs all others."""
    stds: float = 3.0
    """Standard deviations by which a lag has to differ from 0."""
    max_std_s: float = 0.01
    """Max standard deviation of a known lag, s."""
    min_gain: float = 0.05
    """Share of the error on eighths held out that a shift has to remove."""
    gain_stds: float = 3.0
    """Standard deviations, between eighths, by which that has to differ from 0."""
    max_unexplained: float = 0.5
    """Max share of the torque's variance that is unexplained at the best shift."""


LAG = LagOptions()


def shifts(rate: float, longest_part: int) -> Rows | None:
    """Steps to shift by, ascending and symmetric about 0; None where the parts are too short for three."""
    most = min(int(LAG.max_s * rate), longest_part // 8)
    if most < 2:
        return None
    every = max(1, round(most / LAG.max_shifts))
    return np.asarray(every * np.arange(-(most // every), most // every + 1), np.int64)


class Lags:
    """Residuals over shifts, joint after joint."""

    def __init__(self, fit: Fit, steps: Rows, rate: float) -> None:
        self.fit, self.steps, self.rate = fit, steps, rate
        self._blocks = np.linspace(0, len(fit.rows), FIT.parts + 1).astype(np.int64)
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

    def lowers(self, tau: Array, seconds: float) -> bool:
        """Whether taking a joint's torque tau (M,) so much later clearly lowers its error on eighths held out."""
        at = self.fit.rows + np.clip(seconds * self.rate, self.steps[0], self.steps[-1])
        shifted = np.interp(at, np.arange(len(tau)), tau)
        here, there = self.fit.held_out(np.column_stack([tau[self.fit.rows], shifted])).T
        less = here - there
        often = less.mean() > LAG.gain_stds * less.std(ddof=1) / np.sqrt(FIT.parts)
        return bool(often and less.sum() > LAG.min_gain * here.sum())

    def of_all(self) -> Lag:
        """What the joints that tell a lag say together, as one clock would have it; less sure where they disagree."""
        if not self._known:
            return _unknown(None, "no joint tells")
        seconds, std = np.array(self._known).T
        weight = 1 / (std**2 + LAG.min_std_s**2)
        mean = float(weight @ seconds / weight.sum())
        misfit = float(weight @ (seconds - mean) ** 2) / max(1, len(seconds) - 1)
        return Lag(joint=None, seconds=mean, std_s=float(np.sqrt(max(1.0, misfit) / weight.sum())))

    def _judge(self, name: str, curves: Array, cost: float, unexplained: float) -> Lag:
        """curves: squared residuals over the shifts, of all rows first, then without an eighth each, (9, S)."""
        if unexplained > LAG.max_unexplained:
            return _unknown(name, f"motion explains only {percent(1 - unexplained)} of the torque")
        if min(curves[0, 0], curves[0, -1]) < LAG.distinct * curves[0].min():
            return _unknown(
                name, "one shift of time explains the torque about as well as another: record faster motion"
            )
        lowest = np.array([self._lowest(curve) for curve in curves])
        if np.isnan(lowest).any():
            return _unknown(name, "no shift of time is better than its neighbours: record faster motion")
        left_out = lowest[1:]
        std = LAG.caution * float(np.sqrt((FIT.parts - 1) / FIT.parts * np.sum((left_out - left_out.mean()) ** 2)))
        if std > LAG.max_std_s:
            return _unknown(name, f"parts of the recording differ by {1e3 * std:.0f} ms: record faster motion")
        return Lag(joint=name, seconds=float(lowest[0]), std_s=std, cost=cost)

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


def clear(lag: Lag) -> bool:
    """Whether a lag differs from 0."""
    return lag.seconds is not None and lag.std_s is not None and abs(lag.seconds) > LAG.stds * lag.std_s


def _unknown(name: str | None, reason: str) -> Lag:
    return Lag(joint=name, reason=reason)


def no_lags(names: tuple[str, ...], reason: str) -> list[Lag]:
    """The answer where lags cannot be looked for at all."""
    return [_unknown(name, reason) for name in (None, *names)]
