"""How well a version predicts a data set, and how two of them differ."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lipserve.results import Array, Plain, figure, html_table, reading, text_table
from lipserve.states import Outcome
from lipserve.wording import percent


@dataclass(frozen=True, eq=False)
class Interval(Plain):
    """What the central intervals of one probability hold. level: that probability; coverage: (n) share of measurements
    inside, noise included; interval_width: (n) mean width, N·m."""

    level: float
    coverage: Array
    interval_width: Array


@dataclass(frozen=True, eq=False)
class Reliability(Plain):
    """nominal: (K) probabilities that intervals promise; observed: (n, K) shares of measurements inside."""

    nominal: Array
    observed: Array


@dataclass(frozen=True, eq=False)
class Stretches(Plain):
    """How the error is spread over the recording. kind: stretches are `episodes`, or ten `equal` ones; samples: (S)
    compared of each; nmse: (n, S) mean squared error within the stretch / variance of the torque over all samples."""

    kind: str
    samples: NDArray[np.int64]
    nmse: Array


@dataclass(frozen=True, eq=False)
class Evaluation(Plain):
    """Figures per joint, (n) each; `print` shows them as a table, `rows` lists them.

    samples: of the data set or the part; samples_used: that were compared; nmse: mean squared error / variance of the
    measured torque, NaN where that does not vary; rmse: N·m; coverage: share of measurements inside the interval of
    probability `level`, noise included; independent: errors that it stands on; coverage_low, coverage_high: its 95 %
    confidence interval; nlpd: mean negative log predictive density, nats; interval_width: N·m; in_training: whether the
    version has learnt these samples: then the figures flatter; repeats_training: share of them that repeat motion it
    was trained on, and period_s: after which that repeats itself, s, None where not known; warnings: what else
    flatters; judged: whether the figures are of the judged fit, which was trained without these samples.
    """

    model: str
    version: int
    revision: int
    dataset: str
    part: str
    joint_names: tuple[str, ...]
    samples: int
    samples_used: int
    level: float
    nmse: Array
    rmse: Array
    coverage: Array
    nlpd: Array
    interval_width: Array
    coverages: tuple[Interval, ...]
    reliability: Reliability
    stretches: Stretches
    independent: Array
    coverage_low: Array
    coverage_high: Array
    in_training: bool
    repeats_training: float | None
    period_s: float | None
    warnings: tuple[str, ...]
    judged: bool = False

    def rows(self) -> list[dict[str, Any]]:
        """One dictionary a joint, as for `pandas.DataFrame(evaluation.rows())`."""
        figures = {name: getattr(self, name).tolist() for name in _FIGURES}
        return [
            {"joint": joint, **{name: values[at] for name, values in figures.items()}}
            for at, joint in enumerate(self.joint_names)
        ]

    @property
    def title(self) -> str:
        """What was compared with what, and whether that flatters."""
        what = "held-out samples" if self.part == "held_out" else "samples"
        unseen = ", which it was trained on: these figures flatter" if self.in_training else ""
        unseen = ", as judged before it learnt them" if self.judged else unseen
        return f"{self.model} version {self.version} on {self.samples_used} {what} of {self.dataset}{unseen}"

    def __str__(self) -> str:
        return "\n".join([text_table(self.title, self._columns()), *(f"careful: {each}" for each in self.warnings)])

    def _repr_html_(self) -> str:
        careful = (f"<p>careful: {escape(each)}</p>" for each in self.warnings)
        return html_table(self.title, self._columns()) + "".join(careful)

    def _columns(self) -> dict[str, list[str]]:
        heads = {
            "nMSE": (self.nmse, ".2e"),
            "RMSE N·m": (self.rmse, ".4f"),
            f"coverage of {percent(self.level)}": (self.coverage, ".1%"),
            "at least": (self.coverage_low, ".0%"),
            "at most": (self.coverage_high, ".0%"),
            "independent errors": (self.independent, ".0f"),
            "width N·m": (self.interval_width, ".3f"),
            "NLPD nats": (self.nlpd, ".3f"),
        }
        cells = {head: [figure(each, form) for each in values] for head, (values, form) in heads.items()}
        return {"joint": list(self.joint_names), **cells}


_FIGURES = ("nmse", "rmse", "coverage", "coverage_low", "coverage_high", "independent", "nlpd", "interval_width")


@dataclass(frozen=True, eq=False)
class VersionFigures(Plain):
    """Figures of one version, (n) each; see `Evaluation`."""

    version: int
    revision: int
    nmse: Array
    rmse: Array
    coverage: Array
    nlpd: Array
    interval_width: Array
    in_training: bool


@dataclass(frozen=True, eq=False)
class Difference(Plain):
    """The second version's figure less the first's: (n), or () over all joints; NaN where it cannot be told.

    standard_error: of the paired difference; half_width: half the width of its 95 % interval.
    """

    difference: Array
    standard_error: Array
    half_width: Array


@dataclass(frozen=True, eq=False)
class Comparison(Plain):
    """Two versions on one data set.

    blocks: stretches that standard errors stand on; differences: per joint by figure; nlpd, nmse: over all joints;
    outcome and better: which version is better by its predictive density, None where none is; verdict: in words;
    warnings: what makes the comparison unfair.
    """

    model: str
    dataset: str
    joint_names: tuple[str, ...]
    samples: int
    samples_used: int
    blocks: int
    versions: tuple[VersionFigures, VersionFigures]
    differences: Mapping[str, Difference]
    nlpd: Difference
    nmse: Difference
    outcome: Outcome
    better: int | None
    verdict: str
    warnings: tuple[str, ...]

    def __str__(self) -> str:
        return "\n".join([self.verdict, *(f"careful: {warning}" for warning in self.warnings)])


read_evaluation = reading(Evaluation)
read_comparison = reading(Comparison)
