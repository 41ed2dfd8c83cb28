"""Whether what a version is judged on repeats the motion that it was trained on, and what to hold out instead."""

from __future__ import annotations

from collections.abc import Sequence
from math import floor
from typing import Any

from lipcore.data.repetition import Repetition, repetition
from lipcore.data.samples import Samples
from lipcore.training import held_out
from service.contract.models import Holdout
from service.storage.database import Database, DatasetRow
from service.storage.files import Files
from service.training import holding_out, refresh_data
from service.training.table import TablePart, opened

MOST = 20_000
"""Rows of a training that are looked at, thinned evenly."""


def unrepeated(part: TablePart, joint_types: Sequence[str], asked: Holdout) -> list[list[int]] | None:
    """Rows of a data set to hold out in place of its last part, see `held_out.unrepeated`; None where that is right, or
    the data set has no times. First and last, exclusive, in order of episode and time."""
    if not part.timed:
        return None
    places, samples = part.motion(MOST)
    spans = held_out.unrepeated(samples, joint_types, asked.share, asked.seed)
    if spans is None:
        return None
    border = [*places.tolist(), len(part)]
    return [[border[first], border[last]] for first, last in spans]


def look(training: Sequence[TablePart], part: Samples, joint_types: Sequence[str]) -> dict[str, Any]:
    """How much of some samples repeats what is trained on, as lineages and the API name it; nulls where there is
    nothing of that any more."""
    if not training:
        return {"repeats_training": None, "period_s": None, "warnings": []}
    rows = max(MOST, sum(map(len, training)))
    known = [each.motion(max(1, round(MOST * len(each) / rows)))[1] for each in training]
    repeated = repetition(Samples.concatenate(known), part, joint_types)
    if not all(each.timed for each in training):
        repeated = repeated._replace(period=None)
    return {"repeats_training": repeated.share, "period_s": repeated.period, "warnings": _warnings(repeated)}


def trained_on(database: Database, files: Files, lineage: dict[str, Any]) -> list[TablePart]:
    """What a version has learnt from of those of its data sets that are still there.

    Raise DamagedDataError, or CannotHoldOutError where one does not split as it did.
    """
    with database.session() as session:
        known = refresh_data.datasets(session, [each["id"] for each in lineage.get("datasets", [])])
    parts = opened(files, list(known.values()))
    if not (lineage.get("holdout") or {}).get("learnt"):
        parts = [_learnt(part, lineage) for part in parts]
    return [part for part in parts if len(part)]


def _learnt(part: TablePart, lineage: dict[str, Any]) -> TablePart:
    row: DatasetRow = part.row
    split = holding_out.remembered(row, lineage)
    return part if split is None else TablePart(row, part.reader, split.parts(*part.clock()).train)


def _warnings(found: Repetition) -> list[str]:
    if not found.flatters:
        return []
    again = "" if found.period is None else f", which repeats every {found.period:.3g} s"
    return [
        f"{floor(100 * found.share)} % of these samples repeat motion that was trained on{again}: the figures flatter. "
        "Judge by a recording of other motion"
    ]
