"""Evaluation of a version on a data set, and comparison of two versions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lipserve.records.verdicts import Verdict
from lipserve.results import Array, Plain, figure, html_table, reading, text_table
from lipserve.states import Outcome
from lipserve.wording import percent


@dataclass(frozen=True, eq=False)
class Interval(Plain):
    """Coverage and width of intervals at one level."""

    level: float
    """Nominal probability of the intervals."""
    coverage: Array
    """(n,) share of measurements inside, noise included."""
    interval_width: Array
    """(n,) mean width, N·m."""


@dataclass(frozen=True, eq=False)
class Reliability(Plain):
    """Observed coverage against nominal probability."""

    nominal: Array
    """(K,) nominal probabilities of the intervals."""
    observed: Array
    """(n, K) shares of measurements inside."""


@dataclass(frozen=True, eq=False)
class Stretches(Plain):
    """Error along the recording, in S parts."""

    kind: str
    """`episodes`, or `equal` for ten equal parts."""
    samples: NDArray[np.int64]
    """(S,) compared samples."""
    nmse: Array
    """(n, S) mean squared error in the part / variance of the torque over all samples."""


@dataclass(frozen=True, eq=False)
class OutsideRange(Plain):
    """Quality on the samples outside the training range; NaN without such samples."""

    share: float
    """Share of the samples."""
    squared: Array
    """(n,) mean squared error, (N·m)²."""
    coverage: Array
    """(n,) share of measurements inside the 95 % interval."""


@dataclass(frozen=True, eq=False)
class Evaluation(Plain):
    """Figures of a version on a data set, per joint; `print` shows a table, `rows` returns dictionaries.

    Example:
        >>> result = client.evaluate("panda-sim", "ds_0123456789abcdef")
        >>> print(result)
    """

    model: str
    version: int
    revision: int
    dataset: str
    part: str
    """`all` or `held_out`."""
    joint_names: tuple[str, ...]
    samples: int
    """Number of samples of the data set or part."""
    samples_used: int
    """Number of samples compared."""
    level: float
    """Nominal probability of the intervals."""
    nmse: Array
    """(n,) mean squared error / variance of the measured torque; NaN for constant torque."""
    rmse: Array
    """(n,) root mean square error, N·m."""
    coverage: Array
    """(n,) share of measurements inside the interval, noise included."""
    nlpd: Array
    """(n,) mean negative log predictive density, nats."""
    interval_width: Array
    """(n,) mean width of the interval, N·m."""
    coverages: tuple[Interval, ...]
    """Coverage and width at several levels."""
    reliability: Reliability
    stretches: Stretches
    independent: Array
    """(n,) effective samples of the coverage."""
    coverage_low: Array
    """(n,) lower end of the 95 % confidence interval of the coverage."""
    coverage_high: Array
    """(n,) upper end of the 95 % confidence interval of the coverage."""
    in_training: bool
    """Whether the version was trained on these samples: then the figures are too optimistic."""
    repeats_training: float | None
    """Share of samples that repeat training motion; None if unknown."""
    period_s: float | None
    """Period of the training motion, s; None if unknown."""
    warnings: tuple[str, ...]
    """Other reasons why the figures are too optimistic."""
    verdict: Verdict
    """Verdict on the version by these figures."""
    seconds: float | None = None
    """Duration of the samples, s; None for versions of earlier releases."""
    moving: float | None = None
    """Share of samples in which a joint moves; None for versions of earlier releases."""
    torque_range: Array | None = None
    """(n,) max less min of the measured torque, N·m; None for versions of earlier releases."""
    outside: OutsideRange | None = None
    """Quality outside the training range; None for versions of earlier releases."""
    judged: bool = False
    """Whether the figures are those of the fit without these samples; the version was trained on them afterwards."""

    def rows(self) -> list[dict[str, Any]]:
        """Return one dictionary per joint, e.g. for `pandas.DataFrame(evaluation.rows())`."""
        figures = {name: getattr(self, name).tolist() for name in _FIGURES}
        return [
            {"joint": joint, **{name: values[at] for name, values in figures.items()}}
            for at, joint in enumerate(self.joint_names)
        ]

    @property
    def title(self) -> str:
        """Title of the table: model, samples, and whether they are training data."""
        what = "held-out samples" if self.part == "held_out" else "samples"
        caveat = " (training data: figures are too optimistic)" if self.in_training else ""
        caveat = ", evaluated before training on them" if self.judged else caveat
        return f"{self.model} version {self.version} on {self.samples_used} {what} of {self.dataset}{caveat}"

    def __str__(self) -> str:
        verdict = f"{self.verdict.label}: {self.verdict.reason}"
        warnings = (f"warning: {each}" for each in self.warnings)
        return "\n".join([text_table(self.title, self._columns()), verdict, *warnings])

    def _repr_html_(self) -> str:
        texts = (f"{self.verdict.label}: {self.verdict.reason}", *(f"warning: {each}" for each in self.warnings))
        return html_table(self.title, self._columns()) + "".join(f"<p>{escape(each)}</p>" for each in texts)

    def _columns(self) -> dict[str, list[str]]:
        heads = {
            "nMSE": (self.nmse, ".2e"),
            "RMSE N·m": (self.rmse, ".4f"),
            f"coverage ({percent(self.level)})": (self.coverage, ".1%"),
            "95 % CI from": (self.coverage_low, ".0%"),
            "to": (self.coverage_high, ".0%"),
            "effective samples": (self.independent, ".0f"),
            "width N·m": (self.interval_width, ".3f"),
            "NLPD nats": (self.nlpd, ".3f"),
        }
        cells = {head: [figure(each, form) for each in values] for head, (values, form) in heads.items()}
        return {"joint": list(self.joint_names), **cells}


_FIGURES = ("nmse", "rmse", "coverage", "coverage_low", "coverage_high", "independent", "nlpd", "interval_width")


@dataclass(frozen=True, eq=False)
class VersionFigures(Plain):
    """Figures of one version, (n,) each; see `Evaluation`."""

    version: int
    revision: int
    nmse: Array
    rmse: Array
    coverage: Array
    nlpd: Array
    interval_width: Array
    in_training: bool
    verdict: Verdict


@dataclass(frozen=True, eq=False)
class Difference(Plain):
    """Figure of the second version − figure of the first: (n,), or () over all joints; NaN if unknown."""

    difference: Array
    standard_error: Array
    """Standard error of the paired difference."""
    half_width: Array
    """Half the width of its 95 % confidence interval."""


@dataclass(frozen=True, eq=False)
class Comparison(Plain):
    """Comparison of two versions on one data set; `print` shows its verdict.

    Example:
        >>> print(client.compare("my-arm", "ds_0123456789abcdef", 1, 2))
    """

    model: str
    dataset: str
    joint_names: tuple[str, ...]
    samples: int
    """Number of samples of the data set."""
    samples_used: int
    """Number of samples compared."""
    blocks: int
    """Number of blocks for the standard errors."""
    versions: tuple[VersionFigures, VersionFigures]
    differences: Mapping[str, Difference]
    """Differences per joint, by figure."""
    nlpd: Difference
    """Difference of the negative log predictive density over all joints."""
    nmse: Difference
    """Difference of the nMSE over all joints."""
    outcome: Outcome
    """Result by predictive density."""
    better: int | None
    """Better version by predictive density, None if there is no difference."""
    verdict: str
    """Result in words."""
    warnings: tuple[str, ...]
    """Reasons why the comparison is unfair."""

    def __str__(self) -> str:
        return "\n".join([self.verdict, *(f"warning: {warning}" for warning in self.warnings)])


read_evaluation = reading(Evaluation)
read_comparison = reading(Comparison)
