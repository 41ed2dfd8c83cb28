"""The choice between estimators, by their predictions of held-out samples."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lipcore.data.metrics import TorqueDistribution, compare
from lipcore.data.samples import Array, Samples
from lipcore.data.splits import Mask
from lipcore.vocabulary import LOCAL


@dataclass(frozen=True)
class HeldOutSamples:
    """Held-out samples, for the evaluation of estimators."""

    samples: Samples
    edge: Mask
    """Rows at the edge of the data, (N,)."""

    def nmse(self, answer: TorqueDistribution) -> Array:
        """Return the mean squared error of each joint over the variance of its torque, (n,); NaN if that is zero."""
        return np.asarray(self._errors(answer).mean(axis=0))

    def edge_nmse(self, answer: TorqueDistribution) -> Array:
        """Return the mean squared error of the edge over the variance of all rows, (n,); NaN without edge rows."""
        errors = self._errors(answer)[self.edge]
        return errors.mean(axis=0) if len(errors) else np.full(self.samples.n_joints, np.nan)

    def _errors(self, answer: TorqueDistribution) -> Array:
        tau = self.samples.tau
        # rounding gives a constant column a variance above zero
        variance = np.where(np.ptp(tau, axis=0) > 0, tau.var(axis=0), np.nan)
        return np.asarray(np.square(tau - answer.mean) / variance)


def choose_estimator(held_out: HeldOutSamples, answers: Mapping[str, TorqueDistribution]) -> tuple[str, str]:
    """Return the name of the estimator to train on all samples, and the reason.

    The first is chosen unless a later one is surely better: its log density is higher beyond chance (95 %), and its
    error is not larger, on all rows and at the edge. LOCAL replaces an arm alone unless it is worse. The reason: it
    exists only if its own samples have shown a gain, and it changes nothing away from them. answers: predictions of the
    samples by at least one estimator, the simplest first.
    """
    first, *others = answers
    chosen, reasons = first, []
    for name in others:
        objection = _objection(held_out, answers[chosen], answers[name], surely=name != LOCAL)
        if objection is None:
            better = "no worse on the held-out rows" if name == LOCAL else "better, also at the edge of the data"
            reasons.append(f"{name} replaces {chosen}: it is {better}")
            chosen = name
        else:
            reasons.append(f"{name} does not replace {chosen}: {objection}")
    return chosen, "; ".join(reasons) or "no other estimator was trained"


def _objection(
    held_out: HeldOutSamples, simple: TorqueDistribution, other: TorqueDistribution, *, surely: bool
) -> str | None:
    """Return why another estimator should not replace a simpler one, None if it should.

    surely: it must be better beyond chance, and no worse at the edge.
    """
    total = compare(held_out.samples, simple, other).total
    if surely and not total.mean[0] < -total.half_width[0]:
        return "its log density is not significantly higher"
    if not total.mean[0] <= total.standard_error[0]:
        return "its log density is lower by more than one standard error"
    if surely and not held_out.edge.any():
        return "no rows at the edge of the data could be held out"
    places = ((held_out.nmse, ""), (held_out.edge_nmse, " at the edge of the data"))
    for nmse, place in places if held_out.edge.any() else places[:1]:
        if not _mean(nmse(other)) <= 1.02 * _mean(nmse(simple)):
            return f"its error is larger{place}"
    return None


def _mean(values: Array) -> float:
    """Return the mean of the values that are numbers, NaN if there are none."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else np.nan
