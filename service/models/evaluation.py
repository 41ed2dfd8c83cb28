"""Figures of prediction quality: of an evaluation, and of the judged fit in a version's lineage."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np

from lipcore.data import metrics
from lipcore.data.coverage import CoverageInterval, coverage_interval
from lipcore.data.metrics import LEVELS, RELIABILITY_LEVELS, Metrics, TorqueDistribution
from lipcore.data.samples import Array, Samples
from lipcore.model.torque_model import TrainingRange
from lipcore.model.verdict import MOVING_SPEED, is_outside
from service.contract.holdout import Interval, Reliability, Stretches
from service.foundation.fields import finite

MAX_EVALUATION_SAMPLES = 5000
"""Maximum samples of one evaluation; more are thinned evenly."""


def stretches(samples: Samples, mean: Array) -> Stretches:
    """Return the normalised mean squared error of each stretch; mean: (N, n) N·m.

    The variance is that of the measured torque over all samples. While a joint rests, the variance of the stretch alone
    is near zero and any error would look enormous.
    """
    episodes = samples.episodes()
    by_episode = 5 <= len(episodes) <= 200  # fewer make no box plot; more have only a few samples each
    if not by_episode:
        edges = np.linspace(0, len(samples), min(10, len(samples)) + 1).astype(np.int64).tolist()
        episodes = [slice(first, last) for first, last in pairwise(edges)]
    squared = (samples.tau - mean) ** 2
    varies = np.ptp(samples.tau, axis=0) > 0  # not `variance > 0`: rounding gives a constant column a positive variance
    variance = samples.tau.var(axis=0)
    means = np.array([squared[each].mean(axis=0) for each in episodes])
    return Stretches(
        kind="episodes" if by_episode else "equal",
        samples=[each.stop - each.start for each in episodes],
        nmse=[
            (column / variance[joint]).tolist() if varies[joint] else [None] * len(episodes)
            for joint, column in enumerate(means.T)
        ],
    )


def range_figures(samples: Samples, answer: TorqueDistribution, known: TrainingRange) -> dict[str, Any]:
    """Return the range of the torque of samples, and the quality of an answer outside the training range."""
    outside = is_outside(samples.motion(), known)
    squared = ((samples.tau - answer.mean) ** 2)[outside]
    figures = {"squared": squared, "coverage": answer.contains(samples.tau)[outside]}
    means = {name: values.mean(axis=0).tolist() if len(values) else None for name, values in figures.items()}
    unknown = [None] * samples.n_joints
    steps = np.diff(samples.t)
    return {
        "seconds": len(samples) * float(np.median(steps[steps > 0])) if (steps > 0).any() else None,
        "moving": float((np.abs(samples.dq) > MOVING_SPEED).any(axis=1).mean()),
        "torque_range": np.ptp(samples.tau, axis=0).tolist(),
        "outside": {"share": float(outside.mean()), **{name: each or unknown for name, each in means.items()}},
    }


def evaluation(samples: Samples, answer: TorqueDistribution, known: TrainingRange) -> dict[str, Any]:
    """Return the fields of `Evaluation` for an answer at samples. known: training range of the model."""
    found = metrics.evaluate(samples.tau, *answer)
    return {
        "samples_used": len(samples),
        "level": found.level,
        **joint_figures(found),
        **coverage_fields(coverage_interval(samples, answer)),
        "coverages": [
            Interval(level=each, coverage=coverage.tolist(), interval_width=width.tolist())
            for each, coverage, width in zip(LEVELS, found.coverages, found.widths, strict=True)
        ],
        "reliability": Reliability(nominal=list(RELIABILITY_LEVELS), observed=found.reliability.T.tolist()),
        "stretches": stretches(samples, answer.mean),
        **range_figures(samples, answer, known),
    }


def joint_figures(metrics: Metrics) -> dict[str, Any]:
    """Return the figures of each joint; nmse is null if the joint's torque is constant."""
    per_joint = {name: getattr(metrics, name).tolist() for name in ("rmse", "coverage", "nlpd")}
    return {"nmse": finite(metrics.nmse), **per_joint, "interval_width": metrics.width.tolist()}


def coverage_fields(interval: CoverageInterval) -> dict[str, list[float]]:
    """Return the confidence interval of coverages under the names of the API and of lineages."""
    return {
        "independent": interval.independent.tolist(),
        "coverage_low": interval.low.tolist(),
        "coverage_high": interval.high.tolist(),
    }
