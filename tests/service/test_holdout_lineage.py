"""What lineages say of data that were held out and of how data were prepared, and what is believed of it."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from service.models.archive_import import Lineage
from service.models.lineage import learnt_from, named
from service.storage.database import DatasetRow
from service.training.holding_out import CannotHoldOutError, remembered

ENTRY = {"id": "ds_1", "sha256": "s", "whole": False, "guard": 0.25, "guard_unit": "s", "rows": 34, "guarded": 4}
HOLDOUT = {"split": {"share": 0.3}, "datasets": [ENTRY], "rows": 34, "guarded": 4, "nmse": [0.1]}
EPISODE, TIMES = np.zeros(120, dtype=np.int64), np.arange(120) / 10


def test_lineages_name_how_data_were_prepared():
    report = {"rows": 5, "recipe": {"cutoff_hz": 4.0}, "steps": [{"step": "trim", "text": "5 rows cut off"}]}
    row = DatasetRow(id="ds_1", name="n", sha256="s", rows=5, report=report)
    told = {"id": "ds_1", "name": "n", "sha256": "s", "rows": 5}
    assert named([row]) == [{**told, "recipe": report["recipe"], "steps": report["steps"]}]
    assert named([DatasetRow(id="ds_1", name="n", sha256="s", rows=5, report={"rows": 5})]) == [told]


def test_data_sets_that_nothing_was_learnt_of_are_not_in_training():
    datasets = [{"id": "ds_1", "sha256": "s"}, {"id": "ds_2", "sha256": "r"}]
    assert learnt_from({"datasets": datasets, "holdout": HOLDOUT}) == {"ds_1", "s", "ds_2", "r"}
    whole = {**HOLDOUT, "datasets": [{**ENTRY, "whole": True}]}
    assert learnt_from({"datasets": datasets, "holdout": whole}) == {"ds_2", "r"}
    assert learnt_from({}) == frozenset()


@pytest.mark.parametrize("row", [DatasetRow(id="ds_1", sha256="?"), DatasetRow(id="ds_9", sha256="s")])
def test_a_data_set_is_known_by_its_id_or_its_samples(row):
    split = remembered(row, {"holdout": HOLDOUT})
    assert np.flatnonzero(split.held_out(EPISODE, TIMES)).tolist() == list(range(86, 120))


def test_others_are_not_known():
    assert remembered(DatasetRow(id="ds_9", sha256="?"), {"holdout": HOLDOUT}) is None
    assert remembered(DatasetRow(id="ds_1", sha256="s"), {}) is None


@pytest.mark.parametrize("counts", [{"rows": 35}, {"guarded": 3}])
def test_a_lineage_that_splits_otherwise_is_not_believed(counts):
    """Counts that do not fit: the samples may not be those that were held out."""
    said = {**HOLDOUT, "datasets": [{**ENTRY, **counts}]}
    with pytest.raises(CannotHoldOutError, match="does not split as it did"):
        remembered(DatasetRow(id="ds_1", sha256="s"), {"holdout": said}).held_out(EPISODE, TIMES)


@pytest.mark.parametrize(
    "holdout",
    [
        {**HOLDOUT, "split": {"kind": "rows"}},
        {**HOLDOUT, "datasets": []},
        {**HOLDOUT, "datasets": [{**ENTRY, "guard": -1.0}]},
        {**HOLDOUT, "datasets": [{**ENTRY, "rows": "3"}]},
        {**HOLDOUT, "rows": None},
        3,
    ],
)
def test_holdouts_of_lineages_from_elsewhere_are_checked(holdout):
    Lineage.model_validate({"holdout": HOLDOUT})
    with pytest.raises(ValidationError):
        Lineage.model_validate({"holdout": holdout})
