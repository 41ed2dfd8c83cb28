"""Acceptance of a model for serving without approval, by its figures on held-out samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import fdtri

from lipcore.data import metrics
from lipcore.data.metrics import quantile
from lipcore.data.samples import Array
from lipcore.data.splits import Mask
from lipcore.model import texts


@dataclass(frozen=True)
class AcceptanceOptions:
    """Requirements on a model's figures on held-out samples."""

    min_coverage: float = 0.9
    """Min coverage of the 95 % intervals."""
    max_error: float = 0.9
    """Max squared error, as a share of that of the mean torque. The margin is a tenth."""
    max_width: float = 2.0
    """Max width of the 95 % intervals, relative to that of errors with the same root mean square, without a note."""
    min_signal: float = 3.0
    """Min standard deviation of a measured torque, relative to its noise, that a model must explain."""
    level: float = 0.95
    """Probability that the error of a joint is below `max_error`."""


OPTIONS = AcceptanceOptions()


@dataclass(frozen=True)
class HeldOutFigures:
    """Figures of a fit on held-out samples, (n,) each."""

    joint_names: tuple[str, ...]
    """Names of the joints."""
    nmse: Array
    """Squared error divided by the variance of the measured torque; NaN if it does not vary."""
    rmse: Array
    """Root mean square error, N·m."""
    torque_noise: Array
    """White noise of the measured torque, N·m, see `lipcore.data.signals.noise_level`."""
    coverage: Array
    """Coverage of the 95 % intervals."""
    coverage_high: Array
    """Upper end of the confidence interval of the coverage."""
    independent: Array
    """Number of effective samples."""
    interval_width: Array
    """Mean width of the 95 % intervals, N·m."""


@dataclass(frozen=True)
class Acceptance:
    """Result of the acceptance of a model, in sentences."""

    against: tuple[str, ...] = ()
    """Reasons to reject the model."""
    unknown: tuple[str, ...] = ()
    """Checks that the held-out samples are too few to decide."""
    speaks_for: tuple[str, ...] = ()
    """Reasons to accept the model."""
    notes: tuple[str, ...] = ()
    """Findings that decide nothing."""

    def __add__(self, other: Acceptance) -> Acceptance:
        return Acceptance(
            self.against + other.against,
            self.unknown + other.unknown,
            self.speaks_for + other.speaks_for,
            self.notes + other.notes,
        )

    @property
    def passed(self) -> bool | None:
        """Whether the model may serve without approval; None if too little was held out to decide."""
        if self.against:
            return False
        return None if self.unknown else True

    @property
    def reason(self) -> str:
        """All sentences, the most severe first."""
        return "; ".join(self.against + self.unknown + self.speaks_for + self.notes)


def accept(figures: HeldOutFigures) -> Acceptance:
    """Return the acceptance of a model from its figures on held-out samples.

    Example:
        >>> two = np.array([0.01, 0.98]), np.array([0.1, 1.0]), np.full(2, 0.05)
        >>> many = np.array([0.95, 0.95]), np.array([0.97, 0.97]), np.full(2, 60.0), np.full(2, 4.0)
        >>> accept(HeldOutFigures(("hip", "knee"), *two, *many)).against
        ('the error is not below that of the mean torque: knee at 0.98 of the variance (60 effective samples)',)

    """
    return _check_error(figures) + _check_coverage(figures) + _check_width(figures)


def _check_error(figures: HeldOutFigures) -> Acceptance:
    """Check that the error is below that of the mean torque, on every joint with a torque above its noise.

    Both errors are of N independent samples each. With probability `level`, their ratio is below `nmse` times the
    quantile of F(N, N). If this product is below `max_error`, the check has passed.
    """
    nmse, count = figures.nmse, np.maximum(figures.independent, 1.0)
    varies = np.isfinite(nmse) & (nmse > 0)
    spread = figures.rmse / np.sqrt(np.where(varies, nmse, 1.0))
    judged = varies & (spread >= OPTIONS.min_signal * figures.torque_noise)
    if not judged.any():
        return Acceptance(unknown=(texts.NO_SIGNAL,))
    large = judged & (nmse >= OPTIONS.max_error)
    open_ = judged & ~large & (nmse * fdtri(count, count, OPTIONS.level) >= OPTIONS.max_error)
    joints = [texts.describe_joint_error(*each) for each in zip(nmse, count, strict=True)]
    against, unknown = (_list_joints(figures.joint_names, joints, which) for which in (large, open_))
    if against:
        return Acceptance(against=(texts.describe_error_against(against),))
    if unknown:
        return Acceptance(unknown=(texts.describe_error_unknown(unknown),))
    return Acceptance(speaks_for=(texts.describe_error(nmse[judged].max()),))


def _check_coverage(figures: HeldOutFigures) -> Acceptance:
    """Check that the intervals have a coverage of `min_coverage`, within sampling error."""
    each = zip(figures.coverage, figures.coverage_high, figures.independent, strict=True)
    joints = [texts.describe_joint_coverage(*joint) for joint in each]
    narrow = _list_joints(figures.joint_names, joints, figures.coverage_high < OPTIONS.min_coverage)
    if narrow:
        return Acceptance(against=(texts.describe_coverage_against(OPTIONS.min_coverage, narrow),))
    return Acceptance(speaks_for=(texts.describe_coverage(OPTIONS.min_coverage),))


def _check_width(figures: HeldOutFigures) -> Acceptance:
    """Note joints with intervals that are wider than their errors need."""
    need = 2 * quantile(metrics.LEVEL) * figures.rmse
    ratio = np.divide(figures.interval_width, need, out=np.zeros_like(need), where=need > 0)
    wide = _list_joints(figures.joint_names, [f"{each:.2g} times" for each in ratio], ratio > OPTIONS.max_width)
    return Acceptance(notes=(texts.describe_width(wide),)) if wide else Acceptance()


def _list_joints(names: Sequence[str], joints: Sequence[str], which: Mask) -> str:
    chosen = [f"{name} at {text}" for name, text, taken in zip(names, joints, which, strict=True) if taken]
    return texts.list_joints(chosen)
