"""The verdict on a model: whether its torque can be used, by its figures on samples that it has not learnt."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from lipcore.data.metrics import LEVEL, quantile
from lipcore.data.motion import Motion
from lipcore.data.samples import Array
from lipcore.data.splits import Mask
from lipcore.model.torque_model import TrainingRange
from lipcore.vocabulary import JointType

Level = Literal["wrong", "too_uncertain", "not_judged", "usable_in_range", "usable"]
LEVELS: Final[tuple[Level, ...]] = ("wrong", "too_uncertain", "not_judged", "usable_in_range", "usable")
"""Levels of a verdict, the worst first."""
SERVING_LEVELS: Final[tuple[Level, ...]] = ("usable_in_range", "usable")
"""Levels at which a version serves without approval."""
JudgedOn = Literal["held_out", "recording", "stream", "training", "nothing"]
"""Samples behind a verdict: held-out part, another recording, rows of streams before they were learnt, the training
data, or no samples."""


@dataclass(frozen=True)
class VerdictOptions:
    """Thresholds of a verdict."""

    max_error: float = 0.9
    """Max mean squared error, as a share of that of the mean torque. The margin is a tenth."""
    min_coverage: float = 0.9
    """Min coverage of the 95 % intervals, within sampling error."""
    max_width: float = 1.0
    """Max width of the 95 % intervals, as a share of that of the mean torque, 2 · 1.96 · its standard deviation."""
    min_signal: float = 3.0
    """Min standard deviation of a measured torque, relative to its noise, that a model must explain."""
    confidence: float = 0.95
    """Probability that the error of a joint is below `max_error`."""
    min_outside: float = 10.0
    """Min effective samples outside the training range for a verdict on motion there."""
    min_moving: float = 0.1
    """Min share of the samples in motion for a verdict on motion."""
    min_seconds: float = 3.0
    """Min duration of the samples, s: 30 % of the shortest recording without a warning in its report."""


OPTIONS = VerdictOptions()
MOVING_SPEED: Final = 0.02
"""A joint moves above this speed, rad/s (m/s)."""
BEYOND: Final = 0.1
"""A state is outside the training range if a quantity of a joint is beyond it by this share of the range."""


def is_outside(motion: Motion, known: TrainingRange) -> Mask:
    """Return which of N states are outside a training range, (N,), see `BEYOND`."""
    out = np.zeros(len(motion.q), np.bool_)
    for name, values in (("q", motion.q), ("dq", motion.dq), ("ddq", motion.ddq)):
        low, high = (np.array(known[name][end]) for end in ("min", "max"))
        margin = BEYOND * (high - low)
        out |= ((values < low - margin) | (values > high + margin)).any(axis=1)
    return out


@dataclass(frozen=True)
class OutsideFigures:
    """Figures on the samples outside the training range, (n,) each."""

    share: float
    """Share of the samples."""
    squared: Array
    """Mean squared error, (N·m)² (N²); NaN without such samples."""
    coverage: Array
    """Coverage of the 95 % intervals; NaN without such samples."""


@dataclass(frozen=True)
class JudgedFigures:
    """Figures of a model on samples, (n,) each. NaN stands for an unknown value."""

    joint_names: tuple[str, ...]
    joint_types: tuple[JointType, ...]
    nmse: Array
    """Squared error divided by the variance of the measured torque; NaN if it does not vary."""
    rmse: Array
    """Root mean square error, N·m (N)."""
    torque_noise: Array
    """White noise of the measured torque, N·m (N), see `lipcore.data.signals.noise_level`."""
    coverage: Array
    """Coverage of the 95 % intervals."""
    coverage_low: Array
    """Lower end of the confidence interval of the coverage."""
    coverage_high: Array
    """Upper end of this interval."""
    independent: Array
    """Number of effective samples."""
    interval_width: Array
    """Mean width of the 95 % intervals, N·m (N)."""
    torque_range: Array
    """Max less min of the measured torque, N·m (N)."""
    torque_limit: Array
    """Rated torque of the actuator, N·m (N)."""
    serving_rmse: Array
    """Root mean square error of the serving version on the same samples, N·m (N)."""
    outside: OutsideFigures | None
    """None if the training range is unknown."""
    moving: float | None
    """Share of the samples in which a joint moves; None if unknown."""
    seconds: float | None
    """Duration of the samples, s; None if unknown."""

    @property
    def mean_rmse(self) -> Array:
        """Root mean square error of the mean torque, N·m (N): NaN if the torque does not vary."""
        return np.asarray(self.rmse / np.sqrt(np.where(self.nmse > 0, self.nmse, np.nan)))

    @property
    def width_over_need(self) -> Array:
        """Width of the intervals, relative to that of errors of the same root mean square; NaN without errors."""
        return np.asarray(self.interval_width / np.where(self.rmse > 0, 2 * quantile(LEVEL) * self.rmse, np.nan))


@dataclass(frozen=True)
class JointVerdict:
    """The verdict on a joint; torques in N·m, of prismatic joints in N. None stands for an unknown value."""

    joint: str
    level: Level
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


@dataclass(frozen=True)
class Verdict:
    """The verdict on a model: its level, why, and what to do."""

    level: Level
    reason: str
    """Why, in one sentence."""
    action: str
    """The one thing to do."""
    judged_on: JudgedOn
    joints: tuple[JointVerdict, ...] = ()
    outside: float | None = None
    """Share of the samples outside the training range; None if unknown."""
    repeats: float | None = None
    """Share of the samples that repeat the training motion; None if unknown."""

    @property
    def serves(self) -> bool:
        """Whether a version with this verdict may serve without approval."""
        return self.level in SERVING_LEVELS


@dataclass(frozen=True)
class Fault:
    """A fault of a recording, such as an inverted torque: what it is, and what to do."""

    text: str
    action: str
