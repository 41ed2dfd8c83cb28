"""Acceptance of a model for serving without approval, by its figures on held-out samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import fdtri

from lipcore.data.samples import Array
from lipcore.data.splits import Mask


@dataclass(frozen=True)
class AcceptanceOptions:
    """Requirements on a model's figures on held-out samples."""

    min_coverage: float = 0.9
    """Min coverage of the 95 % intervals."""
    max_error: float = 0.9
    """Max squared error, as a share of that of the mean torque. The margin is a tenth."""
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
    """Number of independent errors."""


@dataclass(frozen=True)
class Acceptance:
    """Result of the acceptance of a model, in sentences."""

    against: tuple[str, ...] = ()
    """Reasons to reject the model."""
    unknown: tuple[str, ...] = ()
    """Checks that the held-out samples are too few to decide."""
    speaks_for: tuple[str, ...] = ()
    """Reasons to accept the model."""

    def __add__(self, other: Acceptance) -> Acceptance:
        return Acceptance(
            self.against + other.against, self.unknown + other.unknown, self.speaks_for + other.speaks_for
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
        return "; ".join(self.against + self.unknown + self.speaks_for)


def accept(figures: HeldOutFigures) -> Acceptance:
    """Return the acceptance of a model from its figures on held-out samples.

    Example:
        >>> two = np.array([0.01, 0.98]), np.array([0.1, 1.0]), np.full(2, 0.05)
        >>> many = np.array([0.95, 0.95]), np.array([0.97, 0.97]), np.full(2, 60.0)
        >>> accept(HeldOutFigures(("hip", "knee"), *two, *many)).against
        ('its error is not below that of the mean torque: knee 0.98 of its variance (60 independent errors)',)

    """
    return _check_error(figures) + _check_coverage(figures)


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
        return Acceptance(unknown=("no torque of what was held out stands out of its noise",))
    large = judged & (nmse >= OPTIONS.max_error)
    open_ = judged & ~large & (nmse * fdtri(count, count, OPTIONS.level) >= OPTIONS.max_error)
    texts = [
        f"{value:.2g} of its variance ({number:.0f} independent errors)"
        for value, number in zip(nmse, count, strict=True)
    ]
    against, unknown = (_list_joints(figures.joint_names, texts, which) for which in (large, open_))
    if against:
        return Acceptance(against=(f"its error is not below that of the mean torque: {against}",))
    if unknown:
        return Acceptance(unknown=(f"too little was held out to tell its error from that of the mean: {unknown}",))
    return Acceptance(speaks_for=(f"its error is at most {nmse[judged].max():.2g} of the variance of the torque",))


def _check_coverage(figures: HeldOutFigures) -> Acceptance:
    """Check that the intervals have a coverage of `min_coverage`, within the sampling error of so few errors."""
    least = f"{100 * OPTIONS.min_coverage:.0f} %"
    texts = [
        f"{100 * share:.0f} % (at most {100 * high:.0f} %, from {count:.0f} independent errors)"
        for share, high, count in zip(figures.coverage, figures.coverage_high, figures.independent, strict=True)
    ]
    narrow = _list_joints(figures.joint_names, texts, figures.coverage_high < OPTIONS.min_coverage)
    if narrow:
        return Acceptance(against=(f"the 95 % intervals hold less than {least} of what was held out: {narrow}",))
    return Acceptance(speaks_for=(f"its 95 % intervals hold {least} of what was held out, as far as that can tell",))


def _list_joints(names: Sequence[str], texts: Sequence[str], which: Mask, most: int = 8) -> str:
    chosen = [f"{name} {text}" for name, text, taken in zip(names, texts, which, strict=True) if taken]
    return ", ".join([*chosen[:most], "…"] if len(chosen) > most else chosen)
