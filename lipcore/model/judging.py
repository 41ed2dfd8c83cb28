"""Judge a model by its figures on samples that it has not learnt."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import fdtri

from lipcore.data import repetition
from lipcore.data.coverage import clopper_pearson
from lipcore.data.metrics import LEVEL, quantile
from lipcore.data.splits import Mask, Split
from lipcore.model import texts
from lipcore.model.verdict import (
    OPTIONS,
    Fault,
    JointVerdict,
    JudgedFigures,
    JudgedOn,
    Level,
    Verdict,
    VerdictOptions,
)


def judge(
    figures: JudgedFigures | None,
    judged_on: JudgedOn,
    repeats: float | None = None,
    faults: Sequence[Fault] = (),
    faulty_samples: Sequence[Fault] = (),
    options: VerdictOptions = OPTIONS,
) -> Verdict:
    """Return the verdict on a model.

    Args:
        figures: Its figures on samples; None without samples.
        judged_on: The origin of the samples.
        repeats: Share of the samples that repeat the training motion; None if unknown.
        faults: Faults of its training data, the gravest first. With any, it is wrong, whatever its figures.
        faulty_samples: Faults of the samples. With any, it is not judged.
        options: Thresholds.

    Example:
        >>> two = {name: np.full(2, np.nan) for name in ("torque_range", "torque_limit", "serving_rmse")}
        >>> two |= {"nmse": np.array([0.01, 0.98]), "rmse": np.array([0.1, 1.0]), "torque_noise": np.full(2, 0.05)}
        >>> two |= {name: np.full(2, 0.95) for name in ("coverage", "coverage_low", "coverage_high")}
        >>> two |= {"independent": np.full(2, 60.0), "interval_width": np.full(2, 4.0)}
        >>> known = {"outside": None, "moving": 1.0, "seconds": 60.0}
        >>> figures = JudgedFigures(("hip", "knee"), ("revolute", "revolute"), **two, **known)
        >>> judge(figures, "held_out").reason
        'The errors are no smaller than with the mean torque: knee 1 N·m RMSE (mean torque: 1 N·m).'

    """
    if figures is None:
        why = (texts.NO_ROWS, texts.SEND_ROWS) if judged_on == "stream" else (texts.NOTHING_HELD_OUT, texts.HOLD_OUT)
        found = Verdict("not_judged", *why, "nothing")
    else:
        found = _Judging(figures, judged_on, repeats, options).verdict()
    causes: tuple[tuple[Level, Sequence[Fault]], ...] = (("wrong", faults), ("not_judged", faulty_samples))
    for level, which in causes:
        if which:
            return replace(found, level=level, reason=which[0].text, action=which[0].action)
    return found


def judge_recording(
    seconds: float | None,
    moving: float | None,
    period: float | None,
    faults: Sequence[Fault] = (),
) -> Verdict:
    """Return the best verdict that a model of a recording can get, by its held-out part alone.

    Args:
        seconds: Duration of the recording, s; None if unknown.
        moving: Share of its samples in which a joint moves; None if unknown.
        period: Time after which its motion repeats itself, s; None if it does not.
        faults: Its faults, the gravest first.

    Example:
        >>> judge_recording(6.0, 1.0, None).reason
        'Only 1.8 s can be judged, at least 3 s are needed.'

    """
    short = _why_too_short(None if seconds is None else Split().share * seconds, OPTIONS)
    if faults:
        return Verdict("wrong", faults[0].text, faults[0].action, "nothing")
    if short is not None:
        return Verdict("not_judged", short, texts.RECORD_LONGER, "nothing")
    if _is_at_rest(moving, OPTIONS):
        return Verdict("usable_in_range", texts.JUDGED_AT_REST, texts.RECORD_OTHER_MOTION, "nothing")
    if period is not None:
        return Verdict("usable_in_range", texts.describe_periodic(period), texts.RECORD_OTHER_MOTION, "nothing")
    return Verdict("usable", texts.LONG_AND_VARIED, texts.TRAIN, "nothing")


def _why_too_short(seconds: float | None, options: VerdictOptions) -> str | None:
    """Return why samples of this duration are too short to judge a model; None if they are not."""
    if seconds is None or seconds >= options.min_seconds:
        return None
    return texts.describe_short(seconds, options.min_seconds)


def _is_at_rest(moving: float | None, options: VerdictOptions) -> bool:
    return moving is not None and moving < options.min_moving


@dataclass(frozen=True)
class _Judging:
    """Checks of figures; each returns a mask of the joints, (n,)."""

    figures: JudgedFigures
    judged_on: JudgedOn
    repeats: float | None
    options: VerdictOptions

    def verdict(self) -> Verdict:
        figures = self.figures
        large, few, narrow, wide = self.has_large_error(), self.has_few_samples(), self.is_narrow(), self.is_wide()
        checks: list[tuple[Level, Mask, str, str]] = [
            ("wrong", large, texts.describe_large_error(self._list(large, self._errors())), texts.CHECK_TORQUE),
            ("wrong", narrow, texts.describe_narrow(self._list(narrow, self._coverages())), texts.RECORD_VARIED),
            ("too_uncertain", wide, texts.describe_wide(self._list(wide, self._widths())), texts.RECORD_MORE),
            ("not_judged", few, texts.describe_few_samples(self._list(few, self._counts())), texts.RECORD_LONGER),
        ]
        everywhere = np.ones(len(figures.nmse), np.bool_)
        if (short := _why_too_short(figures.seconds, self.options)) is not None:
            checks.append(("not_judged", everywhere, short, texts.RECORD_LONGER))
        if self.judged_on == "training":
            checks.append(("not_judged", everywhere, texts.JUDGED_ON_TRAINING, texts.EVALUATE_OTHER))
        if not self.has_signal().any():
            checks.append(("not_judged", everywhere, texts.NO_SIGNAL, texts.RECORD_FASTER))
        if (inside := self.why_only_inside()) is not None:
            checks.append(("usable_in_range", everywhere, inside, texts.STAY_INSIDE))
        checks.append(("usable", everywhere, texts.describe_usable(self._best()), texts.NOTHING_TO_DO))
        level, _, reason, action = next(each for each in checks if each[1].any())
        joints: list[Level] = [next(each[0] for each in checks if each[1][j]) for j in range(len(everywhere))]
        outside = None if figures.outside is None else figures.outside.share
        return Verdict(level, reason, action, self.judged_on, self._joints(joints), outside, self.repeats)

    def has_signal(self) -> Mask:
        """Return the joints whose torque is larger than its noise."""
        spread = np.nan_to_num(self.figures.mean_rmse)
        return np.asarray((spread > 0) & (spread >= self.options.min_signal * self.figures.torque_noise))

    def has_large_error(self) -> Mask:
        """Return the joints with an error that is not below that of the mean torque."""
        return np.asarray(self.has_signal() & (self.figures.nmse >= self.options.max_error))

    def has_few_samples(self) -> Mask:
        """Return the joints with too few samples to tell whether the error is below that of the mean torque.

        Both errors are of N effective samples each. With probability `confidence`, their ratio is below `nmse` times
        the quantile of F(N, N).
        """
        count = np.maximum(self.figures.independent, 1.0)
        bound = self.figures.nmse * fdtri(count, count, self.options.confidence)
        return np.asarray(self.has_signal() & ~self.has_large_error() & (bound >= self.options.max_error))

    def is_narrow(self) -> Mask:
        """Return the joints with a coverage below `min_coverage`, beyond sampling error."""
        return np.asarray(self.figures.coverage_high < self.options.min_coverage)

    def is_wide(self) -> Mask:
        """Return the joints with intervals that are no narrower than those of the mean torque."""
        mean_width = 2 * quantile(LEVEL) * self.figures.mean_rmse
        return np.asarray(self.has_signal() & (self.figures.interval_width >= self.options.max_width * mean_width))

    def why_only_inside(self) -> str | None:
        """Return why the model is not known to be right outside the training range; None if it is."""
        if self.repeats is not None and self.repeats >= repetition.OPTIONS.repeated_share:
            return texts.describe_repeated(self.repeats)
        if _is_at_rest(self.figures.moving, self.options):
            return texts.JUDGED_AT_REST
        outside = self.figures.outside
        if outside is None:
            return texts.ONLY_PRESENT_MOTION if self.judged_on == "stream" else texts.UNKNOWN_RANGE
        count = outside.share * self.figures.independent
        if count.min() < self.options.min_outside:
            return texts.describe_few_outside(outside.share, float(count.min()))
        large = self.has_signal() & (outside.squared >= self.options.max_error * self.figures.mean_rmse**2)
        narrow = clopper_pearson(outside.coverage, count)[1] < self.options.min_coverage
        if (large | narrow).any():
            return texts.describe_worse_outside(self._list(large | narrow, [""] * len(count)))
        return None

    def _joints(self, levels: Sequence[Level]) -> tuple[JointVerdict, ...]:
        f = self.figures
        return tuple(
            JointVerdict(
                joint=f.joint_names[j],
                level=level,
                unit=self._unit(j),
                rmse=float(f.rmse[j]),
                range_share=_known(f.rmse[j] / f.torque_range[j]) if f.torque_range[j] > 0 else None,
                limit_share=_known(f.rmse[j] / f.torque_limit[j]),
                mean_rmse=_known(f.mean_rmse[j]),
                serving_rmse=_known(f.serving_rmse[j]),
                coverage=float(f.coverage[j]),
                coverage_low=_known(f.coverage_low[j]),
                coverage_high=_known(f.coverage_high[j]),
                effective_samples=_known(f.independent[j]),
                interval_width=_known(f.interval_width[j]),
                width_over_need=_known(f.width_over_need[j]),
            )
            for j, level in enumerate(levels)
        )

    def _unit(self, joint: int) -> str:
        return "N" if self.figures.joint_types[joint] == "prismatic" else "N·m"

    def _errors(self) -> list[str]:
        each = zip(self.figures.rmse, self.figures.mean_rmse, strict=True)
        return [texts.describe_joint_error(rmse, mean, self._unit(j)) for j, (rmse, mean) in enumerate(each)]

    def _coverages(self) -> list[str]:
        f = self.figures
        each = zip(f.coverage, f.coverage_low, f.coverage_high, f.independent, strict=True)
        return [texts.describe_joint_coverage(*joint) for joint in each]

    def _widths(self) -> list[str]:
        need = 2 * quantile(LEVEL) * self.figures.mean_rmse
        each = zip(self.figures.interval_width, need, strict=True)
        return [texts.describe_joint_width(width, mean, self._unit(j)) for j, (width, mean) in enumerate(each)]

    def _counts(self) -> list[str]:
        return [f"{count:.0f}" for count in self.figures.independent]

    def _best(self) -> str:
        """Return the range of errors and of coverage over the joints."""
        shares = self.figures.rmse / np.where(self.figures.torque_range > 0, self.figures.torque_range, np.nan)
        largest = float(np.nanmax(shares)) if np.isfinite(shares).any() else None
        return texts.describe_best(largest, float(self.figures.coverage.min()))

    def _list(self, which: Mask, joints: Sequence[str]) -> str:
        listed = zip(self.figures.joint_names, joints, which, strict=True)
        return texts.list_joints([f"{name} {text}".strip() for name, text, taken in listed if taken])


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
