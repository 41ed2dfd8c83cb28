"""Whether a model may answer by itself, judged by what its training held out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import fdtri

from lipcore.data.samples import Array
from lipcore.data.splits import Mask


@dataclass(frozen=True)
class AcceptanceOptions:
    """What a model must achieve on held-out samples."""

    min_coverage: float = 0.9
    """Min coverage of the 95 % intervals."""
    max_error: float = 0.9
    """Max squared error, as a share of that of answering the mean torque: the margin is a tenth."""
    min_signal: float = 3.0
    """Standard deviation of a measured torque, in units of its noise, from which on a model has to explain it."""
    level: float = 0.95
    """Probability with which the error of a joint is below `max_error`."""


OPTIONS = AcceptanceOptions()


@dataclass(frozen=True)
class HeldOutFigures:
    """How a fit predicts samples that it has not learnt, (n,) each.

    nmse: squared error / variance of the measured torque, NaN where it does not vary; rmse, torque_noise: N·m, the
    latter the white noise of the measured torque, see `lipcore.data.signals.noise_level`; coverage: of its 95 %
    intervals; coverage_high: upper end of its confidence interval; independent: errors that count.
    """

    joint_names: tuple[str, ...]
    nmse: Array
    rmse: Array
    torque_noise: Array
    coverage: Array
    coverage_high: Array
    independent: Array


@dataclass(frozen=True)
class Acceptance:
    """What speaks against a model, what is too little to tell, and what speaks for it, in sentences."""

    against: tuple[str, ...] = ()
    unknown: tuple[str, ...] = ()
    speaks_for: tuple[str, ...] = ()

    def __add__(self, other: Acceptance) -> Acceptance:
        return Acceptance(
            self.against + other.against, self.unknown + other.unknown, self.speaks_for + other.speaks_for
        )

    @property
    def passed(self) -> bool | None:
        """Whether the model may answer by itself; None: too little was held out to judge."""
        if self.against:
            return False
        return None if self.unknown else True

    @property
    def reason(self) -> str:
        """All sentences, the gravest first."""
        return "; ".join(self.against + self.unknown + self.speaks_for)


def accept(figures: HeldOutFigures) -> Acceptance:
    """Judge a model by its figures on samples held out.

    Example:
        >>> two = np.array([0.01, 0.98]), np.array([0.1, 1.0]), np.full(2, 0.05)
        >>> many = np.array([0.95, 0.95]), np.array([0.97, 0.97]), np.full(2, 60.0)
        >>> accept(HeldOutFigures(("hip", "knee"), *two, *many)).against
        ('its error is not below that of the mean torque: knee 0.98 of its variance (60 independent errors)',)

    """
    return _error(figures) + _coverage(figures)


def _error(figures: HeldOutFigures) -> Acceptance:
    """Whether the error is below the mean's, on every joint whose torque stands out of its noise.

    Both errors, of N independent samples each, have a ratio below `nmse` times the `level` quantile of F(N, N) with
    that probability: where this is below `max_error`, it is.
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
    against, unknown = (_listed(figures.joint_names, texts, which) for which in (large, open_))
    if against:
        return Acceptance(against=(f"its error is not below that of the mean torque: {against}",))
    if unknown:
        return Acceptance(unknown=(f"too little was held out to tell its error from that of the mean: {unknown}",))
    return Acceptance(speaks_for=(f"its error is at most {nmse[judged].max():.2g} of the variance of the torque",))


def _coverage(figures: HeldOutFigures) -> Acceptance:
    """Whether the intervals hold `min_coverage`, as far as so few errors can tell."""
    least = f"{100 * OPTIONS.min_coverage:.0f} %"
    texts = [
        f"{100 * share:.0f} % (at most {100 * high:.0f} %, from {count:.0f} independent errors)"
        for share, high, count in zip(figures.coverage, figures.coverage_high, figures.independent, strict=True)
    ]
    narrow = _listed(figures.joint_names, texts, figures.coverage_high < OPTIONS.min_coverage)
    if narrow:
        return Acceptance(against=(f"the 95 % intervals hold less than {least} of what was held out: {narrow}",))
    return Acceptance(speaks_for=(f"its 95 % intervals hold {least} of what was held out, as far as that can tell",))


def _listed(names: Sequence[str], texts: Sequence[str], which: Mask, most: int = 8) -> str:
    chosen = [f"{name} {text}" for name, text, taken in zip(names, texts, which, strict=True) if taken]
    return ", ".join([*chosen[:most], "…"] if len(chosen) > most else chosen)
