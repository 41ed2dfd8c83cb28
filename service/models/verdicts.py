"""The verdict on a version, from the figures in its lineage or in an evaluation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from lipcore.data.coverage import clopper_pearson
from lipcore.data.samples import Array
from lipcore.model import judging
from lipcore.model.verdict import OPTIONS, Fault, JudgedFigures, JudgedOn, OutsideFigures, VerdictOptions
from lipcore.model.verdict import Verdict as JudgedVerdict
from lipcore.online.record import HALF_WIDTH
from lipcore.online.window import Window
from service.contract.datasets import Cause, Remedy
from service.contract.verdict import LABELS, Verdict
from service.models import texts
from service.storage.database import DatasetRow, ModelRow

_REQUIRED = ("nmse", "rmse", "coverage", "coverage_low", "coverage_high", "independent", "interval_width")
SPOILING: frozenset[Cause] = frozenset(
    {
        *("torque_sign", "torque_order", "joint_order", "torque_factor", "friction_sign"),
        *("no_gravity", "gravity_included", "gravity_doubled"),
    }
)
"""Causes of faults with which a model is wrong, even if its figures on the same recording are good."""


def options_of(row: ModelRow | None) -> VerdictOptions:
    """Return the thresholds of a model; the defaults for a new one."""
    return replace(OPTIONS, **((row and row.thresholds) or {}))


def of_version(manifest: Mapping[str, Any], options: VerdictOptions = OPTIONS) -> Verdict:
    """Return the verdict on a version by its manifest: by the held-out part of its training, or by `judged`.

    `judged` in a lineage has the figures of other rows: of recordings for the shipped model, of streams for a refresh.
    """
    lineage, figures = manifest["lineage"], figures_of_version(manifest)
    judged_on: JudgedOn = "nothing"
    if figures is not None:
        judged_on = "held_out" if not lineage.get("judged") else "stream" if "refresh" in lineage else "recording"
    repeats = _judged_record(lineage).get("repeats_training")
    return represent(judging.judge(figures, judged_on, repeats, faults_of(lineage), options=options))


def figures_of_version(manifest: Mapping[str, Any]) -> JudgedFigures | None:
    """Return the figures behind the verdict on a version; None without figures."""
    return read_figures(_judged_record(manifest["lineage"]), manifest["joint_names"], manifest["joint_types"])


def _judged_record(lineage: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the figures of a lineage that its verdict is based on; empty if there are none."""
    return lineage.get("judged") or lineage.get("holdout") or {}


def of_evaluation(
    record: Mapping[str, Any],
    manifest: Mapping[str, Any],
    judged_on: JudgedOn,
    data: DatasetRow,
    options: VerdictOptions = OPTIONS,
) -> Verdict:
    """Return the verdict on a version by an evaluation of it on a data set. record: fields of `Evaluation`."""
    known = {
        "torque_noise": data.report.get("torque_noise_estimate"),
        "torque_limit": torque_limits([data]),
        **record,
    }
    figures = read_figures(known, manifest["joint_names"], manifest["joint_types"])
    faults = faults_of(manifest["lineage"])
    faulty = []
    if judged_on != "training":
        faulty = [Fault(text, texts.describe_other_reading(data.id)) for text in find_faults(data)]
    return represent(judging.judge(figures, judged_on, record.get("repeats_training"), faults, faulty, options))


def of_recording(data: DatasetRow) -> Verdict:
    """Return the best verdict that a version trained on a data set alone can get."""
    report = data.report
    rate, excitation = report.get("rate_hz"), report.get("excitation") or {}
    standstill = excitation.get("standstill")
    found = judging.judge_recording(
        seconds=data.rows / rate if rate else None,
        moving=None if standstill is None else 1 - standstill,
        period=excitation.get("period_s"),
        faults=[Fault(text, texts.describe_correction(data.id)) for text in find_faults(data)],
    )
    return represent(found)


def of_window(
    window: Window,
    now: float,
    manifest: Mapping[str, Any],
    options: VerdictOptions = OPTIONS,
) -> Verdict:
    """Return the verdict on the intervals in responses, by the rows of a window before a Unix time, s.

    Errors of neighbouring rows are correlated, so a bucket of the window, 1 s or longer, is one effective sample.
    """
    record, spans, held = window.record(now), window.count_spans(now), window.held(now)
    faults = faults_of(manifest["lineage"])
    if not record.rows:
        return represent(judging.judge(None, "stream", faults=faults))
    n = record.n_joints
    coverage, factor = (
        (held.inside / held.rows, held.factors / held.rows) if held.rows else (record.coverage, np.ones(n))
    )
    count = np.full(n, float(spans))
    low, high = clopper_pearson(coverage, count)
    unknown = np.full(n, np.nan)
    trained = figures_of_version(manifest)
    figures = JudgedFigures(
        joint_names=tuple(manifest["joint_names"]),
        joint_types=tuple(manifest["joint_types"]),
        nmse=record.nmse,
        rmse=record.rmse,
        torque_noise=np.sqrt(record.noise),
        coverage=coverage,
        coverage_low=low,
        coverage_high=high,
        independent=count,
        interval_width=2 * HALF_WIDTH * factor * np.sqrt(record.variance + record.noise),
        torque_range=unknown if trained is None else trained.torque_range,
        torque_limit=unknown if trained is None else trained.torque_limit,
        serving_rmse=unknown,
        outside=None,
        moving=None,
        seconds=spans * window.span_s,
    )
    return represent(judging.judge(figures, "stream", faults=faults, options=options))


def represent(found: JudgedVerdict) -> Verdict:
    """Return a verdict as the API shows it."""
    return Verdict.model_validate({**vars(found), "label": LABELS[found.level], "serves": found.serves})


def read_figures(
    record: Mapping[str, Any], joint_names: Sequence[str], joint_types: Sequence[Any]
) -> JudgedFigures | None:
    """Return the figures of a lineage or an evaluation; None if they are missing or malformed.

    Imports keep figures that this release cannot read. Figures that earlier releases did not record are NaN.
    """
    n = len(joint_names)

    def column(name: str) -> Array:
        values = record.get(name)
        found = np.full(n, np.nan) if values is None else np.array(values, np.float64)
        if found.shape != (n,):
            raise ValueError(f"{name} does not match the joints")
        return found

    try:
        columns = {name: column(name) for name in (*_REQUIRED, "torque_range", "torque_limit")}
        if any(np.isnan(columns[name]).any() for name in _REQUIRED if name != "nmse"):
            return None
        outside = record.get("outside")
        serving = record.get("serving") or {}
        return JudgedFigures(
            joint_names=tuple(joint_names),
            joint_types=tuple(joint_types),
            torque_noise=np.nan_to_num(column("torque_noise")),
            serving_rmse=np.full(n, np.nan) if not serving else np.array(serving["rmse"], np.float64),
            outside=None if outside is None else _outside(outside),
            moving=record.get("moving"),
            seconds=record.get("seconds"),
            **columns,
        )
    except (KeyError, TypeError, ValueError):
        return None


def _outside(record: Mapping[str, Any]) -> OutsideFigures:
    return OutsideFigures(record["share"], *(np.array(record[name], np.float64) for name in ("squared", "coverage")))


def find_faults(data: DatasetRow) -> list[str]:
    """Return the faults of a data set that spoil a model, in words, the gravest first."""
    remedies = [Remedy.model_validate(each) for each in data.report.get("remedies", ())]
    return [each.text for each in remedies if each.cause in SPOILING]


def faults_of(lineage: Mapping[str, Any]) -> list[Fault]:
    """Return the faults of the data sets of a lineage."""
    return [
        Fault(text, texts.describe_correction(each["id"]))
        for each in lineage.get("datasets", ())
        for text in each.get("faults", ())
    ]


def torque_limits(rows: Sequence[DatasetRow]) -> list[float | None]:
    """Return the rated torque of each joint, N·m, from the first report that knows it; None if none does."""
    known: list[float | None] = [None] * len(rows[0].joint_names)
    for row in rows:
        for joint, each in enumerate(row.report.get("limits", ())):
            known[joint] = each.get("torque_limit") if known[joint] is None else known[joint]
    return known
