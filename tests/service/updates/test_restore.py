"""What is learnt is a function of the log: from a snapshot or not, in pages or at once, whatever was taken out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lipcore.online import state
from lipcore.online.learner import OnlineModel
from lipcore.vocabulary import CODES
from service.updates.learner import course, learnt, recent
from service.updates.learner import restore as restoring
from service.updates.learner.course import RewoundError
from service.updates.learner.restore import advance
from service.updates.storage import snapshots
from tests.service.updates.pendulums import (
    ARM,
    BEGIN,
    QUERIES,
    Arm,
    at_once,
    differ,
    predicted,
    record,
    rows,
    same,
    trained,
)


@pytest.fixture
def arm(home):
    """A model of one version."""
    opened = Arm.open(home)
    yield opened
    opened.database.close()


@pytest.fixture(params=[1, 25, 500], ids="pages of {} rows".format)
def pages(request, monkeypatch):
    """Pages of one batch, of a few, and of all."""
    monkeypatch.setattr(course, "PAGE_ROWS", request.param)


def snapshot(arm, at_most=None):
    """Store the state after an event; return what it is of."""
    known = arm.restored(at_most=at_most)
    assert known.settled
    payload = state.dump(known.online)
    most = arm.settings.max_snapshots
    assert snapshots.save(arm.database, arm.files, ARM, 1, known.number, payload, most=most) is not None
    return known.number


def followed(arm, known):
    """Advance until there is nothing new."""
    while (following := advance(arm.database, known)) is not known:
        known = following
    return known


# learning


def test_the_rows_of_a_log_are_learnt_as_if_there_had_been_one_batch(arm, pages):
    arm.batches(*range(12))
    known = arm.restored()
    assert known.number == 12
    assert known.online.samples == pytest.approx(120)
    same(known.online, at_once(range(12)))
    assert differ(at_once(range(12)), at_once())


def test_nothing_is_learnt_from_an_empty_log(arm):
    known = arm.restored()
    assert known.number == 0
    same(known.online, predicted(trained()))


def test_rows_that_were_kept_out_teach_nothing_until_they_are_replayed(arm):
    told = rows(1)
    code = told.code.copy()
    code[3:6] = CODES.index("contact")
    arm.batch(0)
    arm.batch(1, rows=replace(told, code=code))
    same(arm.restored().online, at_once([0], [replace(told, code=code)]))
    arm.event("replay", replace(told, code=np.where(code == 0, 8, 0).astype(np.uint8)), event=2)
    same(arm.restored().online, at_once([0, 1]))


def test_a_version_learns_what_came_after_its_training(arm):
    arm.batches(0, 1, 2)
    arm.publish(candidate=True, start=2)
    arm.batches(3)
    found = restoring.restore(arm.database, arm.files, ARM, 2, arm.base)
    assert found.number == 4
    same(found.online, at_once([2, 3]))


def test_a_page_takes_no_more_rows_than_it_may_and_at_least_a_batch(arm, monkeypatch):
    monkeypatch.setattr(course, "PAGE_ROWS", 25)
    arm.batches(0, 1, 2)
    arm.batch(1, size=40, stream_id="other")
    known, seen = arm.restored(most_rows=0), []
    for _ in range(3):
        known = advance(arm.database, known, watch=lambda page: seen.append([each.event.number for each in page]))
    assert seen == [[1, 2], [3], [4]]
    assert advance(arm.database, known) is known


def test_restoring_can_stop_after_some_rows_and_go_on(arm, monkeypatch):
    monkeypatch.setattr(course, "PAGE_ROWS", 10)
    arm.batches(*range(6))
    known = arm.restored(most_rows=25)
    assert known.number == 3
    same(known.online, at_once(range(3)))
    same(followed(arm, known).online, at_once(range(6)))


# snapshots


@pytest.mark.parametrize("at", [1, 7, 12])
def test_a_snapshot_changes_nothing_but_the_time_it_takes(arm, pages, at, monkeypatch):
    arm.batches(*range(12))
    assert snapshot(arm, at_most=at) == at
    decoded, decode = [], restoring.decode
    monkeypatch.setattr(restoring, "decode", lambda payload: decoded.append(1) or decode(payload))
    found = arm.restored()
    assert (found.number, len(decoded)) == (12, 12 - at)
    same(found.online, at_once(range(12)))
    assert found.online.samples == pytest.approx(120)


def test_a_damaged_snapshot_gives_way_to_the_one_before(arm, caplog):
    arm.batches(0, 1)
    snapshot(arm)
    arm.batches(2, 3)
    snapshot(arm)
    with arm.database.session() as session:
        newest = snapshots.latest(session, ARM, 1, None)
    path = arm.files.learning / f"{newest.id}.safetensors"
    path.write_bytes(path.read_bytes()[:1000])
    same(arm.restored().online, at_once(range(4)))
    assert f"snapshot {newest.id} of version 1 of model 'arm' cannot be used" in caplog.text
    path.unlink()
    same(arm.restored().online, at_once(range(4)))


def test_a_snapshot_of_another_version_is_not_taken(arm):
    arm.batches(0, 1)
    snapshot(arm)
    arm.publish(candidate=True, start=1)
    found = restoring.restore(arm.database, arm.files, ARM, 2, arm.base)
    same(found.online, at_once([1]))


def test_who_is_overtaken_by_retention_goes_on_from_the_newest_snapshot(arm):
    arm.batches(*range(4))
    known = arm.restored(at_most=1)
    assert snapshot(arm) == 4
    arm.batches(4)
    with arm.database.transaction() as session:
        session.connection().exec_driver_sql("DELETE FROM events WHERE number <= 4")
    with pytest.raises(RewoundError) as rewound:
        advance(arm.database, known)
    assert rewound.value.number is None
    same(arm.restored(rewound=rewound.value).online, at_once(range(5)))


def test_where_that_snapshot_is_lost_what_is_left_of_the_log_is_learnt(arm):
    arm.batches(*range(4))
    snapshot(arm)
    arm.batches(4, 5)
    with arm.database.transaction() as session:
        session.connection().exec_driver_sql("DELETE FROM events WHERE number <= 4")
    for path in arm.files.learning.glob("*.safetensors"):
        path.unlink()
    found = arm.restored()
    assert found.number == 6
    same(found.online, at_once([4, 5]))


# taking out


@pytest.mark.parametrize("at", [None, 1, 3, 5], ids="snapshot at {}".format)
def test_a_batch_that_was_unlearnt_leaves_nothing_behind(arm, pages, at):
    arm.batches(*range(6))
    if at is not None:
        snapshot(arm, at_most=at)
    known = arm.restored()
    assert arm.unlearn(3) == 7
    expected = at_once([0, 1, 3, 4, 5])
    assert differ(expected, at_once(range(6)))
    same(arm.restored().online, expected)
    same(followed(arm, known).online, expected)
    arm.batches(6)
    same(arm.restored().online, at_once([0, 1, 3, 4, 5, 6]))
    same(followed(arm, known).online, at_once([0, 1, 3, 4, 5, 6]))


def test_replays_go_with_their_batch(arm):
    code = np.array([0] * 5 + [6] * 5, np.uint8)
    arm.batch(0)
    arm.batch(1, rows=replace(rows(1), code=code))
    arm.event("replay", replace(rows(1), code=6 - code), event=2)
    known = arm.restored()
    same(known.online, at_once([0, 1]))
    arm.unlearn(2)
    same(followed(arm, known).online, at_once([0]))
    same(arm.restored().online, at_once([0]))


def test_unlearning_twice_is_unlearning_once(arm):
    arm.batches(0, 1)
    known = arm.restored()
    arm.unlearn(1)
    known = followed(arm, known)
    assert snapshot(arm) == 3
    arm.unlearn(1)
    same(followed(arm, known).online, at_once([1]))
    same(arm.restored().online, at_once([1]))


def test_a_batch_that_is_unlearnt_later_is_learnt_at_its_place(arm, monkeypatch):
    monkeypatch.setattr(course, "PAGE_ROWS", 10)
    arm.batches(*range(4))
    arm.unlearn(1)
    known = arm.restored(most_rows=30)
    assert known.number == 3
    same(known.online, at_once(range(3)))
    same(followed(arm, known).online, at_once([1, 2, 3]))


def test_what_was_unlearnt_while_the_pages_were_read_is_taken_out_once(arm, monkeypatch):
    monkeypatch.setattr(course, "PAGE_ROWS", 10)
    arm.batches(*range(6))
    known = arm.restored(most_rows=30)
    assert known.number == 3
    arm.unlearn(2)
    arm.unlearn(5)
    same(followed(arm, known).online, at_once([0, 2, 3, 5]))


def test_a_rollback_leads_back(arm, pages):
    arm.batches(*range(4))
    snapshot(arm)
    arm.batches(4, 5, 6)
    snapshot(arm)
    known = arm.restored()
    assert arm.rollback(5) == 8
    same(arm.restored().online, at_once(range(5)))
    with pytest.raises(RewoundError) as rewound:
        followed(arm, known)
    assert rewound.value.number == 5
    arm.batches(7)
    same(arm.restored().online, at_once([0, 1, 2, 3, 4, 7]))
    assert arm.restored().number == 9


def test_a_rollback_reaches_what_was_read_in_between_and_no_more(arm, monkeypatch):
    monkeypatch.setattr(course, "PAGE_ROWS", 10)
    arm.batches(*range(4))
    known = arm.restored(most_rows=20)
    assert known.number == 2
    arm.rollback(3)
    same(followed(arm, known).online, at_once(range(3)))
    arm.rollback(1)
    with pytest.raises(RewoundError):
        followed(arm, known)


def test_a_rollback_between_two_pages_of_a_restart_is_followed(arm, monkeypatch):
    monkeypatch.setattr(course, "PAGE_ROWS", 10)
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


def test_what_was_unlearnt_stays_unlearnt_after_a_rollback(arm):
    arm.batches(*range(4))
    snapshot(arm)
    arm.unlearn(2)
    arm.batches(4)
    arm.rollback(4)
    same(arm.restored().online, at_once([0, 2, 3]))


def test_a_batch_that_was_rolled_back_cannot_be_taken_out_again(arm):
    arm.batches(*range(4))
    arm.rollback(2)
    known = arm.restored()
    arm.unlearn(4)
    same(followed(arm, known).online, at_once(range(2)))
    same(arm.restored().online, at_once(range(2)))


def test_the_state_of_an_earlier_event_is_told_with_or_without_what_has_been_unlearnt_since(arm):
    arm.batches(*range(5))
    snapshot(arm, at_most=3)
    arm.unlearn(2)
    same(arm.restored(at_most=3).online, at_once(range(3)))
    found = arm.restored(at_most=3, taken_back=True)
    assert found.number == 3
    same(found.online, at_once([0, 2]))


# changes and forgetting: their oracle is the model's own order of calls


def test_a_change_begins_a_regime_where_the_log_says(arm, pages):
    arm.batches(0, 1, 2)
    arm.event("change", t=BEGIN + 0.3)
    arm.batches(3, 4)
    expected = OnlineModel.start(arm.base, None, 0.0)
    expected = expected.learn(_together(0, 1, 2)).change(BEGIN + 0.3).learn(_together(3, 4))
    same(arm.restored().online, predicted(expected.model()))
    snapshot(arm, at_most=4)
    same(arm.restored().online, predicted(expected.model()))
    assert differ(predicted(expected.model()), at_once(range(5)))


def test_a_batch_from_before_two_changes_is_unlearnt_by_learning_the_others_again(arm):
    arm.batches(0, 1)
    arm.event("change", t=BEGIN + 0.2)
    arm.batches(2)
    arm.event("change", t=BEGIN + 0.3)
    arm.batches(3)
    known = arm.restored()
    arm.unlearn(1)
    expected = OnlineModel.start(arm.base, None, 0.0).learn(rows(1)).change(BEGIN + 0.2)
    expected = expected.learn(rows(2)).change(BEGIN + 0.3).learn(rows(3))
    same(arm.restored().online, predicted(expected.model()))
    with pytest.raises(RewoundError):
        followed(arm, known)


def test_where_the_log_reaches_back_no_more_such_a_batch_stays_and_that_is_said(arm, caplog):
    arm.batches(0, 1)
    arm.event("change", t=BEGIN + 0.2)
    arm.batches(2)
    arm.event("change", t=BEGIN + 0.3)
    arm.batches(3)
    known = arm.restored()
    arm.unlearn(2)
    with arm.database.transaction() as session:
        session.connection().exec_driver_sql("DELETE FROM events WHERE number = 1")
    same(followed(arm, known).online, predicted(known.online.model()))
    assert "events 2 of model 'arm' stay in what is learnt" in caplog.text


@pytest.mark.parametrize("at", [None, 2, 5])
def test_forgetting_is_that_of_the_log(arm, pages, at):
    arm.event("settings", forgetting_s=2.0)
    arm.batches(0, 1, 2)
    arm.event("settings", forgetting_s=0.5)
    arm.batches(3, 4)
    if at is not None:
        snapshot(arm, at_most=at)
    expected = OnlineModel.start(arm.base, 2.0, BEGIN + 0.09).learn(_together(0, 1, 2))
    expected = expected.with_forgetting(0.5).learn(_together(3, 4))
    found = arm.restored()
    same(found.online, predicted(expected.model()))
    assert found.online.forgetting_s == 0.5
    assert differ(predicted(expected.model()), at_once(range(5)))


def test_forgetting_that_was_set_before_a_version_was_trained_holds_for_it(arm):
    arm.batches(0)
    arm.event("settings", forgetting_s=3.0)
    arm.publish(candidate=True)
    arm.batches(1)
    found = restoring.restore(arm.database, arm.files, ARM, 2, arm.base)
    assert found.online.forgetting_s == 3.0


def test_under_forgetting_too_it_does_not_matter_in_which_steps_a_log_is_read(arm):
    arm.event("settings", forgetting_s=1.0)
    known = arm.restored()
    arm.batch(5)  # from the first batch on, the training is forgotten
    known = advance(arm.database, known)
    arm.batches(2, 3)
    same(followed(arm, known).online, predicted(arm.restored().online.model()))


def test_a_batch_under_forgetting_that_has_changed_since_is_unlearnt_by_learning_the_others_again(arm):
    arm.batches(0, 1)
    snapshot(arm)
    arm.event("settings", forgetting_s=0.5)
    arm.batches(2)
    known = arm.restored()
    arm.unlearn(1)
    with pytest.raises(RewoundError):
        followed(arm, known)
    expected = OnlineModel.start(arm.base, None, BEGIN + 0.09).learn(rows(1)).with_forgetting(0.5).learn(rows(2))
    same(arm.restored().online, predicted(expected.model()))


# for the process that serves


def test_little_is_learnt_where_a_version_is_loaded_and_the_rest_is_left_to_the_learner(arm, monkeypatch):
    assert learnt.find(arm.database, arm.files, ARM, 1, arm.base) is None
    arm.batches(*range(6))
    found = learnt.find(arm.database, arm.files, ARM, 1, arm.base)
    assert (found.revision, found.behind) == (6, False)
    same(found.model, at_once(range(6)))
    monkeypatch.setattr(course, "PAGE_ROWS", 10)
    monkeypatch.setattr(learnt, "MOST_ROWS", 20)
    found = learnt.find(arm.database, arm.files, ARM, 1, arm.base)
    assert (found.revision, found.behind) == (2, True)
    same(found.model, at_once(range(2)))


def test_a_version_that_learns_no_more_has_learnt_what_its_last_snapshot_says(arm):
    arm.batches(0, 1, 2)
    snapshot(arm, at_most=2)
    arm.publish()
    arm.batches(3)
    found = learnt.find(arm.database, arm.files, ARM, 1, arm.base)
    assert (found.revision, found.behind) == (2, False)
    same(found.model, at_once(range(2)))


def test_without_a_snapshot_such_a_version_is_as_trained(arm):
    arm.batches(0, 1)
    arm.publish()
    assert learnt.find(arm.database, arm.files, ARM, 1, arm.base) is None


# the errors of the last seconds


def test_the_stated_uncertainty_is_not_below_the_errors_of_the_last_seconds(arm):
    arm.batch(0, received=100.0, record=record(3.0))
    for number in range(1, 5):
        arm.batch(number, received=110.0 + number, record=record(0.5))
    noise = trained().noise_std[0] ** 2
    floor = recent.floor(arm.database, ARM, 1, 5, 2)
    np.testing.assert_allclose(floor, [0.25 - noise, 0.0], rtol=1e-9)
    assert recent.floor(arm.database, ARM, 1, 1, 2)[0] == pytest.approx(9.0 - noise)
    assert recent.floor(arm.database, ARM, 2, 5, 2).tolist() == [0.0, 0.0]
    assert recent.floor(arm.database, ARM, 1, 0, 2).tolist() == [0.0, 0.0]
    found = learnt.find(arm.database, arm.files, ARM, 1, arm.base)
    assert found.model.predict(*QUERIES).tau_std[:, 0].min() >= np.sqrt(0.25 - noise) * (1 - 1e-9)


def test_slow_streams_are_judged_by_enough_rows(arm):
    for number in range(4):
        arm.batch(number, received=100.0 + 60 * number, record=record(1.0 if number < 2 else 0.0))
    assert recent.floor(arm.database, ARM, 1, 4, 2)[0] == 0.0  # 200 rows without error
    assert recent.floor(arm.database, ARM, 1, 3, 2)[0] > 0.1


def _together(*numbers):
    return rows(0).concatenate([rows(number) for number in numbers])
