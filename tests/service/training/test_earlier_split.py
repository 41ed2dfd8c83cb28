"""The split of a version's data is found again from its lineage."""

import numpy as np
import pytest
from pydantic import ValidationError

from service.models.archive_lineage import Lineage
from service.models.lineage import describe_datasets, learnt_from
from service.storage.database import DatasetRow
from service.training.holding_out import CannotHoldOutError, find_earlier_split
from tests.service.training.held_out import ENTRY, HOLDOUT, ROWS

EPISODE, TIMES = np.zeros(ROWS, dtype=np.int64), np.arange(ROWS) / 10


def test_lineage_names_the_data_preparation():
    prepared = {"recipe": {"cutoff_hz": 4.0}, "steps": [{"step": "trim", "text": "5 rows cut off"}]}
    record = {"id": "ds_1", "name": "n", "sha256": "s", "rows": 5}
    for known in (prepared, {}):
        assert describe_datasets([DatasetRow(**record, report={"rows": 5, **known})]) == [{**record, **known}]


def test_data_sets_without_learnt_rows_are_not_in_training():
    lineage = {"datasets": [{"id": "ds_1", "sha256": "s"}, {"id": "ds_2", "sha256": "r"}], "holdout": HOLDOUT}
    entire = {**HOLDOUT, "datasets": [{**ENTRY, "whole": True}]}
    assert learnt_from(lineage) == {"ds_1", "s", "ds_2", "r"}
    assert learnt_from({**lineage, "holdout": entire}) == {"ds_2", "r"}
    assert learnt_from({**lineage, "holdout": {**entire, "learnt": True}}) == {"ds_1", "s", "ds_2", "r"}
    assert learnt_from({}) == frozenset()


@pytest.mark.parametrize("row", [DatasetRow(id="ds_1", sha256="?"), DatasetRow(id="ds_9", sha256="s")])
def test_data_set_is_recognised_by_id_or_samples(row):
    assert find_earlier_split(DatasetRow(id="ds_9", sha256="?"), {"holdout": HOLDOUT}) is None
    assert find_earlier_split(row, {}) is None
    split = find_earlier_split(row, {"holdout": HOLDOUT})
    assert np.flatnonzero(split.held_out(EPISODE, TIMES)).tolist() == list(range(86, 120))


@pytest.mark.parametrize("counts", [{"rows": 35}, {"guarded": 3}, {"stretches": [[0, 30]]}])
def test_inconsistent_split_in_a_lineage_is_rejected(counts):
    """If the counts do not match, the samples may not be the held-out ones."""
    reply = {**HOLDOUT, "datasets": [{**ENTRY, **counts}]}
    with pytest.raises(CannotHoldOutError, match="cannot be split as before"):
        find_earlier_split(DatasetRow(id="ds_1", sha256="s"), {"holdout": reply}).held_out(EPISODE, TIMES)


@pytest.mark.parametrize(
    "holdout",
    [
        {**HOLDOUT, "split": {"kind": "rows"}},
        *(
            {**HOLDOUT, "datasets": [{**ENTRY, **wrong}]}
            for wrong in ({"guard": -1.0}, {"rows": "3"}, {"stretches": [[0, 3, 4]]}, {"stretches": [[-1, 3]]})
        ),
        3,
    ],
)
def test_holdout_of_an_imported_lineage_is_checked(holdout):
    Lineage.model_validate({"holdout": HOLDOUT})
    with pytest.raises(ValidationError):
        Lineage.model_validate({"holdout": holdout})
