"""What is learnt is a function of the log: from a snapshot or not, in pages or at once, whatever was taken back."""

import numpy as np
import pytest

from lipcore.online.learner import OnlineModel
from service.journal import log, snapshots
from service.journal import restore as restoring
from service.journal.floor import error_floor_of
from service.journal.restore import advance
from service.learning.learner import learnt
from service.learning.learner.learnt import LearntVersions
from tests.service.faults.damage import cut, flip, remove
from tests.service.learning.pendulums import (
    ARM,
    BEGIN,
    QUERIES,
    at_once,
    differ,
    predicted,
    record,
    rows,
    same,
    trained,
)


def test_a_page_takes_no_more_rows_than_it_may_and_at_least_a_batch(arm, monkeypatch):
    monkeypatch.setattr(restoring, "PAGE_ROWS", 25)
    arm.batches(0, 1, 2)
    arm.batch(1, size=40, stream_id="other")
    known, ends = arm.restored(pages=0), []
    for _ in range(3):
        known = advance(arm.database, arm.files, known)
        ends.append(known.number)
    assert ends == [2, 3, 4]
    assert advance(arm.database, arm.files, known) is known


@pytest.mark.each_once
@pytest.mark.parametrize("at", [0, 7, 12])
def test_a_snapshot_changes_nothing_but_the_time_it_takes(arm, pages, at, monkeypatch):
    """Twelve batches are learnt as one would be."""
    arm.batches(*range(12))
    assert not at or arm.snapshot(at_most=at) == at
    decoded, decode = [], log.decode
    monkeypatch.setattr(log, "decode", lambda payload: decoded.append(1) or decode(payload))
    found = arm.restored()
    assert (found.number, len(decoded)) == (12, 12 - at)
    same(found.online, at_once(range(12)))
    assert found.online.samples == pytest.approx(120)
    assert differ(at_once(range(12)), at_once())


@pytest.mark.parametrize("harm", [flip, cut, remove], ids=lambda each: each.__name__)
def test_a_damaged_snapshot_gives_way_to_the_one_before(arm, caplog, harm):
    arm.batches(0, 1)
    arm.snapshot()
    arm.batches(2, 3)
    arm.snapshot()
    with arm.database.session() as session:
        newest = snapshots.find_latest(session, ARM, 1, None)
    harm(arm.files.learning / f"{newest.id}.safetensors")
    same(arm.restored().online, at_once(range(4)))
    assert f"snapshot {newest.id} of version 1 of model 'arm' cannot be used" in caplog.text


def test_who_is_overtaken_by_retention_goes_on_from_the_newest_snapshot(arm):
    arm.batches(*range(4))
    known = arm.restored(at_most=1)
    assert arm.snapshot() == 4
    arm.batches(4)
    with arm.database.transaction() as session:
        session.connection().exec_driver_sql("DELETE FROM events WHERE number <= 4")
    assert advance(arm.database, arm.files, known).number == 4
    same(arm.followed(known).online, at_once(range(5)))


def test_where_that_snapshot_is_lost_what_is_left_of_the_log_is_learnt(arm):
    arm.batches(*range(4))
    arm.snapshot()
    arm.batches(4, 5)
    with arm.database.transaction() as session:
        session.connection().exec_driver_sql("DELETE FROM events WHERE number <= 4")
    for path in arm.files.learning.glob("*.safetensors"):
        path.unlink()
    found = arm.restored()
    assert found.number == 6
    same(found.online, at_once([4, 5]))


def test_little_is_learnt_where_a_version_is_loaded_and_the_rest_is_left_to_the_learner(arm, monkeypatch):
    assert LearntVersions(arm.database, arm.files).find(ARM, 1, arm.base) is None
    arm.batches(*range(6))
    found = LearntVersions(arm.database, arm.files).find(ARM, 1, arm.base)
    assert (found.revision, found.behind) == (6, False)
    same(found.model, at_once(range(6)))
    monkeypatch.setattr(restoring, "PAGE_ROWS", 10)
    monkeypatch.setattr(learnt, "MAX_PAGES", 2)
    found = LearntVersions(arm.database, arm.files).find(ARM, 1, arm.base)
    assert (found.revision, found.behind) == (2, True)
    same(found.model, at_once(range(2)))


def test_a_version_that_learns_no_more_has_learnt_what_its_last_snapshot_says(arm):
    arm.batches(0, 1, 2)
    arm.publish()
    assert LearntVersions(arm.database, arm.files).find(ARM, 1, arm.base) is None
    arm.snapshot(at_most=2)
    arm.batches(3)
    found = LearntVersions(arm.database, arm.files).find(ARM, 1, arm.base)
    assert (found.revision, found.behind) == (2, False)
    same(found.model, at_once(range(2)))


def test_the_stated_uncertainty_is_not_below_the_errors_of_the_last_seconds(arm):
    arm.batch(0, received=100.0, record=record(3.0))
    for number in range(1, 5):
        arm.batch(number, received=110.0 + number, record=record(0.5))
    noise = trained().noise_std[0] ** 2
    floor = error_floor_of(arm.database, ARM, 1, 5, 2)
    np.testing.assert_allclose(floor, [0.25 - noise, 0.0], rtol=1e-9)
    assert error_floor_of(arm.database, ARM, 1, 1, 2)[0] == pytest.approx(9.0 - noise)
    assert error_floor_of(arm.database, ARM, 2, 5, 2).tolist() == [0.0, 0.0]
    assert error_floor_of(arm.database, ARM, 1, 0, 2).tolist() == [0.0, 0.0]
    found = LearntVersions(arm.database, arm.files).find(ARM, 1, arm.base)
    assert found.model.predict(*QUERIES).tau_std[:, 0].min() >= np.sqrt(0.25 - noise) * (1 - 1e-9)


def test_slow_streams_are_judged_by_enough_rows(arm):
    for number in range(4):
        arm.batch(number, received=100.0 + 60 * number, record=record(1.0 if number < 2 else 0.0))
    assert error_floor_of(arm.database, ARM, 1, 4, 2)[0] == 0.0  # 200 rows without error
    assert error_floor_of(arm.database, ARM, 1, 3, 2)[0] > 0.1


@pytest.mark.each_once
@pytest.mark.parametrize("at", [None, 3, 5], ids="snapshot at {}".format)
def test_a_batch_that_was_unlearnt_leaves_nothing_behind(arm, pages, at):
    arm.batches(*range(6))
    if at is not None:
        arm.snapshot(at_most=at)
    known = arm.restored()
    assert arm.unlearn(3) == 7
    expected = at_once([0, 1, 3, 4, 5])
    assert differ(expected, at_once(range(6)))
    same(arm.restored().online, expected)
    same(arm.followed(known).online, expected)
    arm.batches(6)
    same(arm.restored().online, at_once([0, 1, 3, 4, 5, 6]))
    same(arm.followed(known).online, at_once([0, 1, 3, 4, 5, 6]))


def test_a_rollback_leads_back(arm, pages):
    arm.batches(*range(4))
    arm.snapshot()
    arm.batches(4, 5, 6)
    arm.snapshot()
    known = arm.restored()
    assert arm.rollback(5) == 8
    same(arm.restored().online, at_once(range(5)))
    same(arm.followed(known).online, at_once(range(5)))
    arm.batches(7)
    same(arm.restored().online, at_once([0, 1, 2, 3, 4, 7]))
    assert arm.restored().number == 9


def test_a_rollback_between_two_pages_of_a_restart_is_followed(arm, monkeypatch):
    monkeypatch.setattr(restoring, "PAGE_ROWS", 10)
    arm.batches(*range(6))
    calls, real = [], restoring.advance

    def disturbed(*arguments):
        calls.append(arguments)
        if len(calls) == 5:
            arm.rollback(2)
        return real(*arguments)

    monkeypatch.setattr(restoring, "advance", disturbed)
    found = arm.restored()
    assert found.number == 7
    same(found.online, at_once(range(2)))


def test_a_change_begins_a_regime_where_the_log_says(arm, pages):
    arm.batches(0, 1, 2)
    arm.event("change", t=BEGIN + 0.3)
    arm.batches(3, 4)
    expected = OnlineModel.start(arm.base, None, 0.0)
    expected = expected.learn(_together(0, 1, 2)).change(BEGIN + 0.3).learn(_together(3, 4))
    same(arm.restored().online, predicted(expected.model()))
    arm.snapshot(at_most=4)
    same(arm.restored().online, predicted(expected.model()))
    assert differ(predicted(expected.model()), at_once(range(5)))


def test_where_the_log_reaches_back_no_more_a_batch_stays_and_that_is_said(arm, caplog):
    arm.batches(*range(4))
    known = arm.restored()
    with arm.database.transaction() as session:
        session.connection().exec_driver_sql("DELETE FROM events WHERE number = 1")
    arm.unlearn(2)
    same(arm.followed(known).online, at_once(range(4)))
    assert "batch 1 of stream 's' stays in what model 'arm' has learnt" in caplog.text


def test_a_rollback_counts_beside_a_batch_that_stays(arm):
    arm.batches(*range(4))
    known = arm.restored()
    with arm.database.transaction() as session:
        session.connection().exec_driver_sql("DELETE FROM events WHERE number = 1")
    arm.unlearn(2)  # which the log is too short for
    arm.rollback(3)
    same(arm.followed(known).online, at_once([2]))


def test_a_snapshot_of_what_was_undone_meanwhile_is_not_stored(arm):
    arm.batches(*range(4))
    known = arm.restored()
    arm.unlearn(2)
    state = ARM, 1, known.number, known.seen, b"state"
    assert snapshots.save(arm.database, arm.files, *state, most=4) is None
    known = arm.followed(known)
    assert arm.snapshot() == known.number == 5


@pytest.mark.each_once
@pytest.mark.parametrize("at", [None, 2, 5])
def test_forgetting_is_that_of_the_log(arm, pages, at):
    arm.event("settings", forgetting_s=2.0)
    arm.batches(0, 1, 2)
    arm.event("settings", forgetting_s=0.5)
    arm.batches(3, 4)
    if at is not None:
        arm.snapshot(at_most=at)
    expected = OnlineModel.start(arm.base, 2.0, BEGIN + 0.09).learn(_together(0, 1, 2))
    expected = expected.with_forgetting(0.5).learn(_together(3, 4))
    found = arm.restored()
    same(found.online, predicted(expected.model()))
    assert found.online.forgetting_s == 0.5
    assert differ(predicted(expected.model()), at_once(range(5)))


def _together(*numbers):
    return rows(0).concatenate([rows(number) for number in numbers])
