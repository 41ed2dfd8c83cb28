"""The verdict on a version, from the figures in its lineage or in an evaluation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from lipcore.data.samples import Array
from lipcore.model import verdict
from lipcore.model.verdict import Fault, JudgedFigures, JudgedOn, OutsideFigures, VerdictOptions
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
    return replace(verdict.OPTIONS, **((row and row.thresholds) or {}))


def of_version(manifest: Mapping[str, Any], options: VerdictOptions = verdict.OPTIONS) -> Verdict:
    """Return the verdict on a version by its manifest: by the held-out part of its training.

    The shipped model was judged on other recordings, `judged` in its lineage.
    """
    lineage = manifest["lineage"]
    record = lineage.get("holdout") or lineage.get("judged") or {}
    figures = read_figures(record, manifest["joint_names"], manifest["joint_types"])
    judged_on: JudgedOn = "nothing" if figures is None else "held_out" if lineage.get("holdout") else "recording"
    repeats = record.get("repeats_training")
    return represent(verdict.judge(figures, judged_on, repeats, faults_of(lineage), options=options))


def of_evaluation(
    record: Mapping[str, Any],
    manifest: Mapping[str, Any],
    judged_on: JudgedOn,
    data: DatasetRow,
    options: VerdictOptions = verdict.OPTIONS,
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
    return represent(verdict.judge(figures, judged_on, record.get("repeats_training"), faults, faulty, options))


def represent(found: verdict.Verdict) -> Verdict:
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
