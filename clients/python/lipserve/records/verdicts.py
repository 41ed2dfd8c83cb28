"""Verdicts on models. Written by `python clients/python/records.py`."""

from __future__ import annotations

from typing import Literal

from lipserve.records import Record


class JointVerdict(Record, frozen=True, kw_only=True):
    """Verdict on one joint. Null stands for an unknown value.

    unit: Unit of the torques: N·m, or N for a prismatic joint
    rmse: Root mean squared error
    range_share: `rmse` divided by the range of the measured torque
    limit_share: `rmse` divided by the rated torque of the robot's actuator
    mean_rmse: Root mean squared error of the mean torque
    serving_rmse: That of the serving version on the same samples
    coverage: Share of measurements inside the 95 % interval
    coverage_low: Lower end of the 95 % confidence interval of the coverage
    coverage_high: Upper end of this confidence interval
    effective_samples: Effective samples; neighbouring errors are correlated
    interval_width: Mean width of the 95 % interval
    width_over_need: This width, relative to that of errors as large as `rmse`
    """

    joint: str
    level: Literal["wrong", "too_uncertain", "not_judged", "usable_in_range", "usable"]
    unit: str
    rmse: float
    range_share: float | None
    limit_share: float | None
    mean_rmse: float | None
    serving_rmse: float | None
    coverage: float
    coverage_low: float | None
    coverage_high: float | None
    effective_samples: float | None
    interval_width: float | None
    width_over_need: float | None


class Verdict(Record, frozen=True, kw_only=True):
    """Verdict on the torque of a version.

    level: `usable`; `usable_in_range`: unknown or wrong outside the recorded range; `not_judged`: too few samples that
        it has not learnt; `too_uncertain`: intervals no narrower than without a model; `wrong`: errors no smaller than
        without a model, intervals that are too narrow, or faulty training data
    serves: Whether a version serves without approval: if it is usable, or usable in range
    label: The level in words
    reason: Why, in one sentence
    action: What to do
    judged_on: `held_out`: the held-out part of its training; `recording`: another data set; `stream`: rows of streams
        before they were learnt; `training`: samples that it has learnt; `nothing`
    outside: Share of the samples outside the training range; null if unknown
    repeats: Share of the samples that repeat the training motion; null if unknown
    """

    level: Literal["wrong", "too_uncertain", "not_judged", "usable_in_range", "usable"]
    serves: bool
    label: str
    reason: str
    action: str
    judged_on: Literal["held_out", "recording", "stream", "training", "nothing"]
    outside: float | None
    repeats: float | None
    joints: list[JointVerdict]


class Thresholds(Record, frozen=True, kw_only=True):
    """Thresholds of the verdicts on the versions of a model.

    max_error: Max mean squared error of a joint / variance of its torque. Above, the version is `wrong`
    min_coverage: Min coverage of the 95 % intervals, within sampling error. If it is below, the version is `wrong`
    max_width: Max width of the 95 % intervals / that of the mean torque. If it is above, the version is `too_uncertain`
    """

    max_error: float = 0.9
    min_coverage: float = 0.9
    max_width: float = 1.0
