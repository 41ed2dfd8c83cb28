"""Restoring a state from the log: with and without snapshots, in pages, and after undoing."""

import numpy as np
import pytest

from service.journal import log, snapshots
from service.journal import restore as restoring
from service.journal.floor import error_floor_of
from service.journal.restore import advance
from service.learning.learner import learnt
from service.learning.learner.learnt import LearntVersions
from tests.service.learning.pendulums import (
    ARM,
    QUERIES,
    assert_predictions,
    expected_predictions,
    predictions_differ,
    residual_record,
    trained_model,
)
from tests.system.faults.damage import cut, flip, remove


def delete_events(arm, last):
    """Delete the events up to a number, without regard to retention."""
    with arm.database.transaction() as session:
        session.connection().exec_driver_sql(f"DELETE FROM events WHERE number <= {last}")


def assert_loaded(arm, revision, is_behind):
    """Check what a loaded version has learnt: the batches up to a revision."""
    found = LearntVersions(arm.database, arm.files).find(ARM, 1, arm.base)
    assert (found.revision, found.behind) == (revision, is_behind)
    assert_predictions(found.model, expected_predictions(range(revision)))


def test_page_has_at_least_one_batch_and_limited_rows(arm, monkeypatch):
    monkeypatch.setattr(restoring, "PAGE_ROWS", 25)
    arm.log_batches(0, 1, 2)
    arm.log_batch(1, size=40, stream_id="other")
    known, ends = arm.restore_state(pages=0), []
    for _ in range(3):
        known = advance(arm.database, arm.files, known)
        ends.append(known.number)
    assert ends == [2, 3, 4]
    assert advance(arm.database, arm.files, known) is known


@pytest.mark.each_once
@pytest.mark.parametrize("at", [0, 7, 12])
def test_snapshot_does_not_change_the_result(arm, pages, at, monkeypatch):
    """Twelve batches give the same result as one sum."""
    arm.log_batches(*range(12))
    assert not at or arm.store_snapshot(at_most=at) == at
    decoded, decode = [], log.decode
    monkeypatch.setattr(log, "decode", lambda payload: decoded.append(1) or decode(payload))
    found = arm.restore_state()
    assert (found.number, len(decoded)) == (12, 12 - at)
    assert_predictions(found.online, expected_predictions(range(12)))
    assert found.online.samples == pytest.approx(120)
    assert predictions_differ(expected_predictions(range(12)), expected_predictions())


@pytest.mark.parametrize("harm", [flip, cut, remove], ids=lambda each: each.__name__)
def test_damaged_snapshot_falls_back_to_previous_one(arm, caplog, harm):
    for batches in ((0, 1), (2, 3)):
        arm.log_batches(*batches)
        arm.store_snapshot()
    with arm.database.session() as session:
        newest = snapshots.find_latest(session, ARM, 1, None)
    harm(arm.files.learning / f"{newest.id}.safetensors")
    assert_predictions(arm.restore_state().online, expected_predictions(range(4)))
    assert f"snapshot {newest.id} of version 1 of model 'arm' cannot be used" in caplog.text


def test_deleted_events_are_restored_from_the_snapshot_alone(arm):
    arm.log_batches(*range(4))
    known = arm.restore_state(at_most=1)
    assert arm.store_snapshot() == 4
    arm.log_batches(4, 5)
    delete_events(arm, 4)
    assert advance(arm.database, arm.files, known).number == 4
    assert_predictions(arm.follow_log(known).online, expected_predictions(range(6)))
    for path in arm.files.learning.glob("*.safetensors"):
        path.unlink()
    found = arm.restore_state()
    assert found.number == 6
    assert_predictions(found.online, expected_predictions([4, 5]))


def test_loading_learns_a_limited_part_of_the_log(arm, monkeypatch):
    assert LearntVersions(arm.database, arm.files).find(ARM, 1, arm.base) is None
    arm.log_batches(*range(6))
    assert_loaded(arm, 6, is_behind=False)
    monkeypatch.setattr(restoring, "PAGE_ROWS", 10)
    monkeypatch.setattr(learnt, "MAX_PAGES", 2)
    assert_loaded(arm, 2, is_behind=True)


def test_retired_version_uses_its_last_snapshot(arm):
    arm.log_batches(0, 1, 2)
    arm.publish()
    assert LearntVersions(arm.database, arm.files).find(ARM, 1, arm.base) is None
    arm.store_snapshot(at_most=2)
    arm.log_batches(3)
    assert_loaded(arm, 2, is_behind=False)


def test_recent_errors_set_a_floor_on_uncertainty(arm):
    arm.log_batch(0, received=100.0, record=residual_record(3.0))
    for number in range(1, 5):
        arm.log_batch(number, received=110.0 + number, record=residual_record(0.5))
    noise = trained_model().noise_std[0] ** 2
    floor = error_floor_of(arm.database, ARM, 1, 5, 2)
    np.testing.assert_allclose(floor, [0.25 - noise, 0.0], rtol=1e-9)
    assert error_floor_of(arm.database, ARM, 1, 1, 2)[0] == pytest.approx(9.0 - noise)
    assert error_floor_of(arm.database, ARM, 2, 5, 2).tolist() == [0.0, 0.0]
    assert error_floor_of(arm.database, ARM, 1, 0, 2).tolist() == [0.0, 0.0]
    found = LearntVersions(arm.database, arm.files).find(ARM, 1, arm.base)
    assert found.model.predict(*QUERIES).tau_std[:, 0].min() >= np.sqrt(0.25 - noise) * (1 - 1e-9)


def test_error_floor_uses_enough_rows_of_slow_streams(arm):
    for number in range(4):
        arm.log_batch(number, received=100.0 + 60 * number, record=residual_record(1.0 if number < 2 else 0.0))
    assert error_floor_of(arm.database, ARM, 1, 4, 2)[0] == 0.0  # the last 200 rows have no error
    assert error_floor_of(arm.database, ARM, 1, 3, 2)[0] > 0.1


@pytest.mark.each_once
@pytest.mark.parametrize("at", [None, 3, 5], ids="snapshot at {}".format)
def test_unlearnt_batch_leaves_no_trace(arm, pages, at):
    arm.log_batches(*range(6))
    if at is not None:
        arm.store_snapshot(at_most=at)
    known = arm.restore_state()
    assert arm.unlearn(3) == 7
    left = [0, 1, 3, 4, 5]
    assert predictions_differ(expected_predictions(left), expected_predictions(range(6)))
    for numbers in (left, [*left, 6]):
        arm.log_batches(*set(numbers) - set(left))
        assert_predictions(arm.restore_state().online, expected_predictions(numbers))
        assert_predictions(arm.follow_log(known).online, expected_predictions(numbers))


def test_rollback_between_pages_is_applied(arm, monkeypatch):
    monkeypatch.setattr(restoring, "PAGE_ROWS", 10)
    arm.log_batches(*range(6))
    calls, real = [], restoring.advance

    def disturbed(*arguments):
        calls.append(arguments)
        if len(calls) == 5:
            arm.rollback(2)
        return real(*arguments)

    monkeypatch.setattr(restoring, "advance", disturbed)
    found = arm.restore_state()
    assert found.number == 7
    assert_predictions(found.online, expected_predictions(range(2)))


@pytest.mark.parametrize("rolls_back", [False, True])
def test_batch_stays_with_warning_if_log_is_too_short_and_rollback_is_applied(arm, caplog, rolls_back):
    arm.log_batches(*range(4))
    known = arm.restore_state()
    delete_events(arm, 1)
    arm.unlearn(2)
    if rolls_back:
        arm.rollback(3)
    assert_predictions(arm.follow_log(known).online, expected_predictions([2] if rolls_back else range(4)))
    assert rolls_back or "could not unlearn batch 1 of stream 's' of model 'arm'" in caplog.text


def test_snapshot_of_undone_state_is_not_stored(arm):
    arm.log_batches(*range(4))
    known = arm.restore_state()
    arm.unlearn(2)
    state = ARM, 1, known.number, known.seen, b"state"
    assert snapshots.save(arm.database, arm.files, *state, most=4) is None
    known = arm.follow_log(known)
    assert arm.store_snapshot() == known.number == 5
