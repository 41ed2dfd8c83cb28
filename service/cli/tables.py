"""Tables of predictions, evaluations and reports for the terminal."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import ArrayLike
from rich.markup import escape
from rich.table import Table

from lipserve.records.datasets import AgainstRobot, DatasetReport, JointExcitation, JointNoise, Weight
from lipserve.records.learning import QualityWindow
from lipserve.records.models import Selection
from lipserve.records.verdicts import Verdict
from lipserve.results.arm import Arm
from lipserve.results.evaluation import Comparison
from lipserve.results.series import Prediction
from service.foundation.text import counted, percent


def prediction_tables(answer: Prediction) -> list[Table]:
    """Return tables of a prediction: joints, then matrix components, then scalar components."""
    columns = {"tau N·m": _texts(answer.tau), "tau_std": _texts(answer.tau_std), "noise_std": _texts(answer.noise_std)}
    matrices, numbers = [], Table("", "mean", "std")
    for name, values in (answer.components or {}).items():
        dimensions = np.ndim(values.mean)
        if dimensions == 0:
            numbers.add_row(name, *_texts(values.mean), *_texts(values.std))
        elif dimensions == 1:
            columns[name] = _pairs(values.mean, values.std)
        else:
            cells = np.reshape(_pairs(values.mean, values.std), np.shape(values.mean))
            matrices.append(_by_joint(Table(name, *answer.joint_names), answer.joint_names, cells.tolist()))
    rows = [list(row) for row in zip(*columns.values(), strict=True)]
    joints = _by_joint(
        Table("joint", *columns, title=f"{answer.model} version {answer.version}"), answer.joint_names, rows
    )
    return [joints, *matrices, *([numbers] if numbers.row_count else [])]


def verdict_table(title: str, verdict: Verdict) -> Table:
    """Return a table of a verdict, one row per joint. Comparisons with unknown values are left out."""
    joints = verdict.joints
    optional = {
        "of rated": [_figure(each.limit_share, ".1%") for each in joints],
        "serving": [_figure(each.serving_rmse, ".2g") for each in joints],
    }
    shown = {head: cells for head, cells in optional.items() if any(cell != "-" for cell in cells)}
    table = Table(
        "joint", "verdict", "RMSE", "of range", *shown, "mean torque", "coverage (95 %)", "95 % CI", "width", "× need",
        title=title,
    )  # fmt: skip
    for at, each in enumerate(joints):
        ci = (
            "-"
            if each.coverage_low is None
            else f"{percent(each.coverage_low)} to {percent(each.coverage_high or 1.0)}"
        )
        table.add_row(
            each.joint,
            each.level.replace("_", " "),
            f"{each.rmse:.2g} {each.unit}",
            _figure(each.range_share, ".1%"),
            *(cells[at] for cells in shown.values()),
            _figure(each.mean_rmse, ".2g"),
            _figure(each.coverage, ".0%"),
            ci,
            _figure(each.interval_width, ".2g"),
            _figure(each.width_over_need, ".2g"),
        )
    return table


def verdict_cells(verdict: Verdict | None) -> tuple[str, str, str]:
    """Return a verdict, the largest error of the joints and their mean coverage as cells of a list."""
    if verdict is None:
        return NOTHING, NOTHING, NOTHING
    shares = [each.range_share for each in verdict.joints if each.range_share is not None]
    coverage = _mean([each.coverage for each in verdict.joints])
    return verdict.label, _figure(max(shares, default=None), ".1%"), _figure(coverage, ".0%")


def quality_table(title: str, joint_names: Sequence[str], window: QualityWindow) -> Table:
    """Return a table of the prediction quality of a window, one row per joint."""
    table = Table("joint", "nMSE", "RMSE N·m", "coverage (95 %)", "NLPD nats", title=title)
    for joint, *figures in zip(joint_names, window.nmse, window.rmse, window.coverage, window.nlpd, strict=True):
        table.add_row(joint, *map(_figure, figures, (".2e", ".4f", ".1%", ".3f")))
    return table


def selection_table(selection: Selection) -> Table:
    """Return a table of the estimators that `auto` compared."""
    held = selection.held_out
    title = "not evaluated"
    if held.blocks:
        title = f"evaluated on {counted(held.blocks, 'held-out block')}, {held.edge_blocks} at the edge of the data"
    table = Table(
        "estimator", "log density nats", "below best", "mean nMSE", "nMSE at edge", "coverage (95 %)", title=title
    )
    for each in selection.table:
        name = f"{each.estimator} (selected)" if each.estimator == selection.chosen else each.estimator
        if each.error is not None:
            table.add_row(name, f"failed: {escape(each.error)}", "", "", "", "")
            continue
        error = "" if each.standard_error is None else f" ± {each.standard_error:.2f}"
        less = None if each.difference is None else 0.0 - each.difference
        errors = [_figure(_mean(nmse), ".2e") for nmse in (each.nmse, each.edge_nmse)]
        row = [_figure(each.log_density, ".2f"), _figure(less, ".2f") + error, *errors]
        table.add_row(name, *row, _figure(_mean(each.coverage), ".1%"))
    return table


def _mean(values: Sequence[float | None] | None) -> float | None:
    """Return the mean over joints that have a figure, None if none has."""
    known = [each for each in values or () if each is not None]
    return sum(known) / len(known) if known else None


def _figure(value: float | None, form: str) -> str:
    return "-" if value is None or np.isnan(value) else format(value, form).replace("%", " %")


def _by_joint(table: Table, joint_names: Sequence[str], rows: list[list[str]]) -> Table:
    for joint, row in zip(joint_names, rows, strict=True):
        table.add_row(joint, *row)
    return table


def _texts(values: ArrayLike) -> list[str]:
    return [f"{value:.4f}" for value in np.ravel(values)]


def _pairs(means: ArrayLike, stds: ArrayLike) -> list[str]:
    return [f"{mean} ± {std}" for mean, std in zip(_texts(means), _texts(stds), strict=True)]


def comparison_table(comparison: Comparison) -> Table:
    """Return a table of the figures of two versions, one row per joint."""
    title = f"{comparison.model} on {counted(comparison.samples_used, 'sample')} of {comparison.dataset}"
    numbers = [f"version {each.version}" for each in comparison.versions]
    heads = [f"{figure}, {number}" for figure in ("nMSE", "RMSE N·m", "coverage") for number in numbers]
    table = Table("joint", *heads, title=title)
    for at, joint in enumerate(comparison.joint_names):
        cells = [
            _figure(getattr(each, name)[at], form)
            for name, form in (("nmse", ".2e"), ("rmse", ".4f"), ("coverage", ".1%"))
            for each in comparison.versions
        ]
        table.add_row(joint, *cells)
    return table


def arm_tables(arm: Arm) -> list[Table]:
    """Return tables of joint frames, bodies and friction, one row per joint from base to tip."""
    tables = []
    for title, columns in arm.tables().items():
        table = Table(*columns, title=title)
        for row in zip(*columns.values(), strict=True):
            table.add_row(*map(escape, row))
        tables.append(table)
    return tables


NOTHING = "–"


def overview(report: DatasetReport) -> Iterator[str]:
    """Yield sentences on how a recording was read and prepared."""
    yield from report.reading
    yield from report.preparation
    rate = NOTHING if report.rate_hz is None else f"{report.rate_hz:.4g} Hz"
    parts, gaps = counted(report.episodes, "episode"), counted(report.gaps, "gap")
    yield f"{report.rows:,} of {report.rows_uploaded:,} rows are used as samples, in {parts}, at {rate}"
    if report.timing.jitter_p99 is not None:
        yield f"jitter: 99 % of time steps within {percent(report.timing.jitter_p99, 1)} of the median; {gaps}"


def report_tables(report: DatasetReport, joint_names: Sequence[str]) -> Iterator[Table]:
    """Yield tables of the joints: signals, friction, and comparison with the robot."""
    yield _joints(report, joint_names)
    yield _friction(report.excitation.joints)
    if report.against_robot is not None:
        yield _against(report.against_robot)


def _joints(report: DatasetReport, joint_names: Sequence[str]) -> Table:
    table = Table("joint", "q", "|dq|", "|ddq|", "tau N·m", "noise N·m", "lag ms", "range used", title="signals")
    limits = {each.joint: each for each in report.limits}
    noise = {each.joint: each for each in report.noise}
    lag = {each.joint: each for each in report.lag}
    for index, joint in enumerate(joint_names):
        low, high = ({name: each[side][index] for name, each in report.ranges.items()} for side in ("min", "max"))
        known = noise.get(joint)
        late = lag.get(joint)
        used = limits.get(joint)
        table.add_row(
            joint,
            f"{low['q']:.2f} … {high['q']:.2f}",
            *(f"{max(-low[name], high[name]):.3g}" for name in ("dq", "ddq")),
            f"{low['tau']:.3g} … {high['tau']:.3g}",
            _noise(report.torque_noise_estimate[index], known),
            NOTHING if late is None or late.seconds is None else f"{1e3 * late.seconds:.1f}",
            NOTHING if used is None or used.range_used is None else percent(used.range_used),
        )
    return table


def _friction(joints: Sequence[JointExcitation]) -> Table:
    table = Table("joint", "reversals", "viscous", "Coulomb", "offset", title="identifiability of friction")
    for each in joints:
        table.add_row(each.joint, str(each.reversals), *map(_weight, (each.viscous, each.coulomb, each.offset)))
    return table


def _against(found: AgainstRobot) -> Table:
    table = Table("joint", "gravity", "inertia", "explained", title=f"torque relative to {found.robot}")
    for each in found.joints:
        times = [_times(each.gravity, each.gravity_std), _times(each.inertia, each.inertia_std)]
        table.add_row(each.joint, *times, percent(each.explained))
    return table


def _times(factor: float | None, std: float | None) -> str:
    return NOTHING if factor is None or std is None else f"{factor:.2f} ± {std:.2g}"


def _noise(prepared: float, recorded: JointNoise | None) -> str:
    if recorded is None:
        return _number(prepared)
    return "smoothed" if recorded.smoothed else _number(recorded.torque)


def _weight(weight: Weight) -> str:
    if weight.std is None:
        return weight.verdict
    value = "" if weight.value is None else f"{weight.value:.2g} "
    return f"{'implausible' if weight.implausible else weight.verdict} ({value}±{weight.std:.2g})"


def _number(value: float | None) -> str:
    return NOTHING if value is None else f"{value:.3g}"
