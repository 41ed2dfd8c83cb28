"""Changes and forgetting in the log: their oracle is the model's own order of calls."""

from __future__ import annotations

import pytest

from lipcore.online.learner import OnlineModel
from service.learning.learner import restore as restoring
from service.learning.learner.course import RewoundError
from service.learning.learner.restore import advance
from tests.service.learning.pendulums import (
    ARM,
    BEGIN,
    at_once,
    differ,
    predicted,
    rows,
    same,
)


def changed_twice(arm):
    """Two batches, then a change before each of two more; return the state after the last."""
    arm.batches(0, 1)
    arm.event("change", t=BEGIN + 0.2)
    arm.batches(2)
    arm.event("change", t=BEGIN + 0.3)
    arm.batches(3)
    return arm.restored()


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


def test_a_batch_from_before_two_changes_is_unlearnt_by_learning_the_others_again(arm):
    known = changed_twice(arm)
    arm.unlearn(1)
    expected = OnlineModel.start(arm.base, None, 0.0).learn(rows(1)).change(BEGIN + 0.2)
    expected = expected.learn(rows(2)).change(BEGIN + 0.3).learn(rows(3))
    same(arm.restored().online, predicted(expected.model()))
    with pytest.raises(RewoundError):
        arm.followed(known)


def test_where_the_log_reaches_back_no_more_such_a_batch_stays_and_that_is_said(arm, caplog):
    known = changed_twice(arm)
    arm.unlearn(2)
    with arm.database.transaction() as session:
        session.connection().exec_driver_sql("DELETE FROM events WHERE number = 1")
    same(arm.followed(known).online, predicted(known.online.model()))
    assert "events 2 of model 'arm' stay in what is learnt" in caplog.text


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
    same(arm.followed(known).online, predicted(arm.restored().online.model()))


def test_a_batch_under_forgetting_that_has_changed_since_is_unlearnt_by_learning_the_others_again(arm):
    arm.batches(0, 1)
    arm.snapshot()
    arm.event("settings", forgetting_s=0.5)
    arm.batches(2)
    known = arm.restored()
    arm.unlearn(1)
    with pytest.raises(RewoundError):
        arm.followed(known)
    expected = OnlineModel.start(arm.base, None, BEGIN + 0.09).learn(rows(1)).with_forgetting(0.5).learn(rows(2))
    same(arm.restored().online, predicted(expected.model()))


def _together(*numbers):
    return rows(0).concatenate([rows(number) for number in numbers])
