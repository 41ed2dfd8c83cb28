"""The part of the log and of the data sets that a refresh is trained on."""

from datetime import UTC, datetime

import numpy as np
import pytest

from service.journal import log
from service.storage.database import DatasetRow, now
from service.training import refresh_data
from service.training.refresh_data import Scope
from tests.service.learning.batches import (
    MODEL,
    append_batches,
    append_event,
    list_events,
    make_batch,
    make_rows,
    roll_back,
    unlearn_batch,
)


def find_scope(database):
    with database.session() as session:
        return refresh_data.scope_of(session, MODEL, log.newest(session, MODEL))


def read_log(database, within, max_rows=1000):
    return refresh_data.read_log(database, MODEL, ("a", "b"), within, max_rows, longest_step=0.5)


def join_torques(*seeds):
    """Return the torques of batches that were made with these seeds."""
    return np.concatenate([make_rows(seed=seed).tau for seed in seeds])


def test_scope_contains_all_learnt_rows(database):
    append_batches(database, *(make_batch(number) for number in range(4)))
    append_batches(database, make_batch(4, rows=make_rows(6, seed=9, codes=("contact", "limit"))))
    unlearn_batch(database, 2)
    within = find_scope(database)
    found = read_log(database, within)
    expected = np.concatenate([join_torques(0, 2, 3), make_rows(6, seed=9).tau[2:]])
    np.testing.assert_array_equal(found.samples.tau, expected)
    assert found.rows == 16
    assert len(found.samples.episodes()) == 4
    with database.session() as session:
        assert refresh_data.rows_within(session, MODEL, within) == 16


@pytest.mark.parametrize("max_rows", [7, 50, 99, 400])
def test_rows_are_thinned_evenly(database, max_rows):
    append_batches(database, *(make_batch(number, rows=make_rows(40, seed=number)) for number in range(10)))
    found = read_log(database, find_scope(database), max_rows)
    assert found.rows == 400
    assert 0.9 * max_rows <= len(found.samples) <= max_rows
    all_times = np.concatenate([make_rows(40, seed=number).time for number in range(10)])
    places = np.searchsorted(all_times, found.samples.t)
    steps = np.diff(places)
    assert steps.min() >= 1
    assert steps.max() <= 2 * np.ceil(400 / max_rows)
    assert places[0] < 400 / max_rows
    assert places[-1] >= 400 - 3 * 400 / max_rows


def test_scope_starts_at_the_last_change(database):
    append_batches(database, *(make_batch(number) for number in range(4)))
    append_event(database, "change", {"t": 102.0})
    within = find_scope(database)
    np.testing.assert_array_equal(read_log(database, within).samples.tau, join_torques(2, 3))
    assert "changed" in within.left_out(DatasetRow(created_at=now()))
    roll_back(database, 4)
    assert find_scope(database).changed is None


def test_forgotten_rows_are_left_out_and_others_weighted(database):
    append_batches(database, *(make_batch(number, rows=make_rows(seed=number)) for number in (0, 10, 12)))
    assert find_scope(database).since == -np.inf
    append_event(database, "settings", {"forgetting_s": 1.0})
    within = find_scope(database)
    assert within.since == pytest.approx(112.003 - 5.0)
    found = read_log(database, within)
    np.testing.assert_array_equal(found.samples.tau, join_torques(10, 12))
    np.testing.assert_allclose(refresh_data.age_weights(found.samples.t, within), np.exp(found.samples.t - 112.003))
    assert refresh_data.age_weights(np.array([500.0]), within) == [1.0]
    for age, kept in ((4.0, True), (6.0, False)):
        uploaded = datetime.fromtimestamp(112.003 - age, UTC).isoformat()
        assert (within.left_out(DatasetRow(created_at=uploaded)) is None) == kept


def test_excluded_data_sets_are_listed_with_reason(database):
    with database.transaction() as session:
        row = DatasetRow(id="ds_kept", name="", created_at=now(), sha256="", torque_convention="", report={})
        row.joint_names, row.rows = [], 1
        session.add(row)
    lineage = {"datasets": [{"id": "ds_gone"}, {"id": "ds_kept"}]}
    with database.session() as session:
        kept, left_out = refresh_data.split_datasets(session, Scope(0, -np.inf, None, None, None), lineage)
        assert [each.id for each in kept] == ["ds_kept"]
        assert left_out == [{"id": "ds_gone", "reason": "it has been deleted"}]
        kept, left_out = refresh_data.split_datasets(session, Scope(0, 5.0, None, None, 5.0), lineage)
        assert kept == []
        assert [each["id"] for each in left_out] == ["ds_gone", "ds_kept"]


def test_undone_events_matter_only_within_scope(database):
    append_batches(database, *(make_batch(number) for number in range(4)))
    newest = len(list_events(database))

    def is_taken_back(through):
        with database.session() as session:
            return refresh_data.is_taken_back(session, MODEL, through, newest)

    unlearn_batch(database, 3)
    assert [is_taken_back(through) for through in (2, 3, 4)] == [False, True, True]
    roll_back(database, 2)
    assert [is_taken_back(through) for through in (1, 2, 3)] == [False, False, True]
