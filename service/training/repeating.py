"""Check whether held-out samples repeat the training motion, and choose others to hold out."""

from __future__ import annotations

from collections.abc import Sequence
from math import floor
from typing import Any

from lipcore.data.repetition import Repetition, repetition
from lipcore.data.samples import Samples
from lipcore.training import held_out
from service.contract.holdout import Holdout
from service.storage.database import Database, DatasetRow
from service.storage.files import Files
from service.training import holding_out, refresh_data
from service.training.table import TablePart, open_parts

MAX_REPETITION_ROWS = 20_000
"""Maximum rows of a training that are compared, thinned evenly."""


def unrepeated(part: TablePart, joint_types: Sequence[str], asked: Holdout) -> list[list[int]] | None:
    """Return the rows of a data set to hold out instead of its last part, see `held_out.find_unrepeated`.

    Each entry is a first and an exclusive last row, in order of episode and time. Return None if the last part is right
    or the data set has no times.
    """
    if not part.timed:
        return None
    places, samples = part.motion(MAX_REPETITION_ROWS)
    spans = held_out.find_unrepeated(samples, joint_types, asked.share, asked.seed)
    if spans is None:
        return None
    border = [*places.tolist(), len(part)]
    return [[border[first], border[last]] for first, last in spans]


def find_repetition(training: Sequence[TablePart], part: Samples, joint_types: Sequence[str]) -> dict[str, Any]:
    """Return how much of some samples repeats the training data, under the names of lineages and the API.

    Values are null if no training data are left.
    """
    if not training:
        return {"repeats_training": None, "period_s": None, "warnings": []}
    rows = max(MAX_REPETITION_ROWS, sum(map(len, training)))
    known = [each.motion(max(1, round(MAX_REPETITION_ROWS * len(each) / rows)))[1] for each in training]
    repeated = repetition(Samples.concatenate(known), part, joint_types)
    if not all(each.timed for each in training):
        repeated = repeated._replace(period=None)
    return {"repeats_training": repeated.share, "period_s": repeated.period, "warnings": _warnings(repeated)}


def read_training_parts(database: Database, files: Files, lineage: dict[str, Any]) -> list[TablePart]:
    """Return what a version has learnt from those of its data sets that still exist.

    Raise DamagedDataError, or CannotHoldOutError if a data set no longer splits as recorded.
    """
    with database.session() as session:
        known = refresh_data.datasets(session, [each["id"] for each in lineage.get("datasets", [])])
    parts = open_parts(files, list(known.values()))
    if not (lineage.get("holdout") or {}).get("learnt"):
        parts = [_learnt(part, lineage) for part in parts]
    return [part for part in parts if len(part)]


def _learnt(part: TablePart, lineage: dict[str, Any]) -> TablePart:
    row: DatasetRow = part.row
    split = holding_out.find_earlier_split(row, lineage)
    return part if split is None else TablePart(row, part.reader, split.parts(*part.clock()).train)


def _warnings(found: Repetition) -> list[str]:
    if not found.is_repeated:
        return []
    again = "" if found.period is None else f", which repeats every {found.period:.3g} s"
    return [
        f"{floor(100 * found.share)} % of these samples repeat motion of the training{again}, so the figures are too "
        "optimistic. Evaluate a recording of other motion."
    ]
