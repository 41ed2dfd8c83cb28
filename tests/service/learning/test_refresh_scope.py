"""What of a model's log, and of its data sets, a refresh learns from."""

from datetime import UTC, datetime

import numpy as np
import pytest

from service.journal import log
from service.storage.database import DatasetRow, now
from service.training import refresh_data
from service.training.refresh_data import Scope
from tests.service.learning import batches
from tests.service.learning.batches import MODEL, everything, note, roll_back, rows, take_back, write


def found_scope(database, through=None):
    with database.session() as session:
        return refresh_data.scope_of(session, MODEL, log.newest(session, MODEL) if through is None else through)


def read(database, within, most=1000):
    return refresh_data.read_log(database, MODEL, ("a", "b"), within, most, longest_step=0.5)


def test_all_rows_that_teach_are_in_scope(database):
    write(database, *(batches.batch(number) for number in range(4)))
    write(database, batches.batch(4, rows=rows(6, seed=9, codes=("contact", "limit"))))
    take_back(database, 2)
    within = found_scope(database)
    found = read(database, within)
    expected = np.concatenate([rows(seed=0).tau, rows(seed=2).tau, rows(seed=3).tau, rows(6, seed=9).tau[2:]])
    np.testing.assert_array_equal(found.samples.tau, expected)
    assert found.rows == 16
    assert len(found.samples.episodes()) == 4
    with database.session() as session:
        assert refresh_data.rows_within(session, MODEL, within) == 16


@pytest.mark.parametrize("most", [7, 50, 99, 400])
def test_many_rows_are_thinned_evenly(database, most):
    write(database, *(batches.batch(number, rows=rows(40, seed=number)) for number in range(10)))
    found = read(database, found_scope(database), most)
    assert found.rows == 400
    assert 0.9 * most <= len(found.samples) <= most
    everything_there = np.concatenate([rows(40, seed=number).time for number in range(10)])
    places = np.searchsorted(everything_there, found.samples.t)
    steps = np.diff(places)
    assert steps.min() >= 1
    assert steps.max() <= 2 * np.ceil(400 / most)
    assert places[0] < 400 / most
    assert places[-1] >= 400 - 3 * 400 / most


def test_after_a_change_only_what_came_since_is_in_scope(database):
    write(database, *(batches.batch(number) for number in range(4)))
    note(database, "change", {"t": 102.0})
    within = found_scope(database)
    found = read(database, within)
    np.testing.assert_array_equal(found.samples.tau, np.concatenate([rows(seed=2).tau, rows(seed=3).tau]))
    assert "changed" in within.left_out(DatasetRow(created_at=now()))
    roll_back(database, 4)
    assert found_scope(database).changed is None


def test_what_is_forgotten_is_left_out_and_the_rest_weighs_by_age(database):
    write(database, *(batches.batch(number, rows=rows(seed=number)) for number in (0, 10, 12)))
    assert found_scope(database).since == -np.inf
    note(database, "settings", {"forgetting_s": 1.0})
    within = found_scope(database)
    assert within.since == pytest.approx(112.003 - 5.0)
    found = read(database, within)
    np.testing.assert_array_equal(found.samples.tau, np.concatenate([rows(seed=10).tau, rows(seed=12).tau]))
    np.testing.assert_allclose(refresh_data.age_weights(found.samples.t, within), np.exp(found.samples.t - 112.003))
    assert refresh_data.age_weights(np.array([500.0]), within) == [1.0]
    for age, kept in ((4.0, True), (6.0, False)):
        uploaded = datetime.fromtimestamp(112.003 - age, UTC).isoformat()
        assert (within.left_out(DatasetRow(created_at=uploaded)) is None) == kept


def test_data_sets_that_are_left_out_are_named_with_the_reason(database):
    with database.transaction() as session:
        row = DatasetRow(id="ds_kept", name="", created_at=now(), sha256="", torque_convention="", report={})
        row.joint_names, row.rows = [], 1
        session.add(row)
    lineage = {"datasets": [{"id": "ds_gone"}, {"id": "ds_kept"}]}
    with database.session() as session:
        kept, left_out = refresh_data.split_datasets(session, Scope(0, -np.inf, None, None, None), lineage)
        assert ([each.id for each in kept], left_out) == (
            ["ds_kept"],
            [{"id": "ds_gone", "reason": "it has been deleted"}],
        )
        kept, left_out = refresh_data.split_datasets(session, Scope(0, 5.0, None, None, 5.0), lineage)
        assert kept == []
        assert [each["id"] for each in left_out] == ["ds_gone", "ds_kept"]


def test_what_is_taken_back_is_seen_only_where_it_matters(database):
    write(database, *(batches.batch(number) for number in range(4)))
    newest = len(everything(database))

    def is_taken_back(through):
        with database.session() as session:
            return refresh_data.is_taken_back(session, MODEL, through, newest)

    take_back(database, 3)
    assert [is_taken_back(through) for through in (2, 3, 4)] == [False, True, True]
    roll_back(database, 2)
    assert [is_taken_back(through) for through in (1, 2, 3)] == [False, False, True]
