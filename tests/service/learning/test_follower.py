"""A version that follows its log: what it learns, publishes and stores, and how several take turns."""

import time
from math import inf

import numpy as np
import pytest
from sqlalchemy import select

from lipcore import NotPositiveDefiniteError
from lipcore.vocabulary import Code
from service.journal import log
from service.learning.learner import follower as following
from service.learning.learner import publication
from service.learning.learner.follower import Follower, Novelty
from service.learning.learner.publication import LearningFailure, Publication
from service.learning.learner.worker import Learner
from service.storage.database import SnapshotRow
from tests.service.learning.pendulums import ARM, QUERIES, Arm, at_once, rows, same, trained


@pytest.fixture
def arm(home, monkeypatch):
    """A model of one version, which is stored when it is asked to be."""
    monkeypatch.setattr(following, "SNAPSHOT_PERIODS", 1e8)
    opened = Arm.open(home, max_loaded_models=2)
    publication.clear(opened.files)
    yield opened
    opened.database.close()


@pytest.fixture
def follower(arm):
    """Version 1, before it has looked at the log."""
    return Follower(arm.database, arm.files, arm.settings, ARM, 1, arm.base)


def caught_up(follower):
    """Step until there is nothing new."""
    follower.woken = follower.behind = True
    while follower.behind:
        follower.step()
    return follower


def stored(arm, version=1):
    """Numbers of the snapshots of a version."""
    with arm.database.session() as session:
        found = session.scalars(select(SnapshotRow.number).where(SnapshotRow.version == version))
        return sorted(found)


def answering(arm, message):
    """The model that the service would answer with."""
    return publication.read(message.path).apply(trained())


def test_what_came_is_published(arm, follower):
    arm.batches(0, 1, 2)
    message = caught_up(follower).publish()
    assert (message.model, message.version, message.number, message.revision) == (ARM, 1, 3, 3)
    assert message.samples == pytest.approx(30)
    assert message.seconds > 0
    same(answering(arm, message), at_once(range(3)))
    assert not follower.unpublished
    arm.batches(3)
    assert caught_up(follower).unpublished
    same(answering(arm, follower.publish()), at_once(range(4)))


def test_a_rollback_is_published_as_a_higher_revision(arm, follower):
    arm.batches(0, 1)
    caught_up(follower).store()
    arm.batches(2, 3)
    caught_up(follower).publish()
    arm.rollback(2)
    follower.woken = follower.behind = True
    while follower.behind:
        follower.step()
        assert not follower.unpublished or follower.number == 5  # nothing of the way back
    message = follower.publish()
    assert message.revision == 5
    same(answering(arm, message), at_once(range(2)))


def test_batches_that_teach_nothing_cost_no_solving(arm, follower, monkeypatch):
    arm.batches(0, 1)
    first = answering(arm, caught_up(follower).publish())
    kept_out = rows(2)
    kept_out.code[:] = 6
    arm.batch(2, rows=kept_out)
    monkeypatch.setattr(following.Revision, "of", None)
    message = caught_up(follower).publish()
    assert message.revision == 3
    same(answering(arm, message), (first.predict(*QUERIES).tau, first.predict(*QUERIES).tau_std))


def test_a_state_is_stored_and_taken_up_again(arm, follower, monkeypatch):
    arm.batches(0, 1, 2)
    caught_up(follower).store()
    assert stored(arm) == [3]
    follower.store()
    assert stored(arm) == [3]
    arm.batches(3)
    learnt = []
    monkeypatch.setattr(log, "decode", lambda payload, real=log.decode: learnt.append(1) or real(payload))
    again = caught_up(Follower(arm.database, arm.files, arm.settings, ARM, 1, arm.base))
    assert len(learnt) == 1
    same(answering(arm, again.publish()), at_once(range(4)))


def test_one_of_several_services_stores_for_all(arm, follower, monkeypatch):
    monkeypatch.setattr(arm.database.adapter, "shared", True)
    other = Follower(arm.database, arm.files, arm.settings, ARM, 1, arm.base)
    arm.batches(0, 1)
    caught_up(follower).store_in_turn()
    arm.batches(2)
    caught_up(other).store_in_turn()
    assert stored(arm) == [2]
    caught_up(follower).store_in_turn()
    other.store()
    assert stored(arm) == [2, 3]
    arm.batches(3)
    caught_up(other).store()  # at the end all of it, whoever was the last
    assert stored(arm) == [2, 3, 4]


def test_a_clock_that_is_set_back_keeps_no_state_from_being_stored(arm, follower, monkeypatch):
    monkeypatch.setattr(arm.database.adapter, "shared", True)
    other = Follower(arm.database, arm.files, arm.settings, ARM, 1, arm.base)
    arm.batches(0)
    caught_up(other).store()
    arm.batches(1)
    real = time.time
    monkeypatch.setattr(time, "time", lambda: real() - 3600.0)
    caught_up(follower).store_in_turn()
    assert stored(arm) == [1, 2]


def test_motion_beyond_the_basis_is_counted():
    novelty, seen = Novelty(window=80), []
    for count, novel in ((76, 76), (4, 4), (80, 0), (40, 40), (60, 0)):  # not told from few rows
        novelty.add(np.arange(count) < novel)
        seen.append((novelty.rows, novelty.share))
    assert seen == [(76, 0.0), (80, 1.0), (80, 0.0), (120, 0.5), (120, 0.25)]


def test_novelty_is_told_with_what_is_published(arm, follower):
    """Motion far faster than the version has seen; rows that are not learnt do not count."""
    quick = rows(0, size=40)
    quick.dq[:] = 50.0
    quick.code[30:] = Code.CONTACT
    arm.batch(0, rows=quick)
    message = caught_up(follower).publish()
    assert (message.novel_rows, message.novel_share) == (30, 0.0)


def test_the_error_of_a_learnt_arms_linearisation_is_published(arm, follower, monkeypatch):
    arm.batch(0)
    assert caught_up(follower).publish().linearisation is None
    monkeypatch.setattr(following, "linearisation_error", lambda model: np.array([0.1, 0.7]))
    arm.batch(1)
    assert caught_up(follower).publish().linearisation == (0.0, 0.0)  # both joints are predicted as well as stated
    monkeypatch.setattr(following, "error_floor_of", lambda *_: np.array([0.0, 0.5]))
    arm.batch(2)
    assert caught_up(follower).publish().linearisation == (0.0, 0.7)


@pytest.fixture
def learner(arm):
    """What the learner process runs, in this one."""
    return Learner(arm.database, arm.files, arm.settings)


def turns(learner, *woken, last=inf):
    """Wake models, and let all followers do what is to be done before monotonic time stands still; the messages."""
    learner.wake(set(woken))
    messages = []
    while learner.pause() < last and (learner.pause() == 0 or any(each.unpublished for each in followers(learner))):
        messages += learner.turn()
    return messages


def followers(learner):
    return list(learner.followers.values())


def test_only_the_version_that_serves_learns(arm, learner):
    arm.batches(0, 1)
    arm.publish(candidate=True, start=1)
    arm.publish("other")
    arm.batch(0, model="other")
    messages = {(each.model, each.version): each for each in turns(learner, ARM)}
    assert set(messages) == {(ARM, 1)}
    same(answering(arm, messages[ARM, 1]), at_once(range(2)))


def test_a_version_that_serves_no_more_is_stored_and_left(arm, learner):
    arm.batches(0, 1)
    turns(learner, ARM)
    arm.publish()
    arm.batches(2)
    messages = turns(learner, ARM)
    assert {each.version for each in messages} == {2}
    assert set(learner.followers) == {(ARM, 2)}
    assert stored(arm) == [2]


def test_no_more_versions_are_kept_than_may_be_and_none_is_lost(arm, learner):
    for name in ("b", "c"):
        arm.publish(name)
        arm.batch(0, model=name)
    arm.batches(0, 1)
    turns(learner, ARM)
    turns(learner, "b")
    turns(learner, "c")
    assert set(learner.followers) == {("b", 1), ("c", 1)}
    assert stored(arm) == [2]
    arm.batches(2)
    (message,) = turns(learner, ARM)
    same(answering(arm, message), at_once(range(3)))
    assert turns(learner, "nobody") == []
    learner.close()
    assert stored(arm) == [1, 1, 2, 3]  # all of all at the end


def test_snapshots_are_taken_now_and_then(home, monkeypatch):
    monkeypatch.setattr(following, "SNAPSHOT_PERIODS", 0)
    arm = Arm.open(home)
    publication.clear(arm.files)
    learner = Learner(arm.database, arm.files, arm.settings)
    arm.batches(0, 1)
    turns(learner, ARM)
    assert stored(arm) == [2]
    arm.database.close()


def test_a_version_that_cannot_learn_does_not_keep_others_from_it(arm, learner, monkeypatch):
    arm.publish("other")
    arm.batch(0, model="other")
    arm.batches(0, 1)
    with arm.database.transaction() as session:
        session.connection().exec_driver_sql("UPDATE events SET payload = x'00' WHERE model = 'arm'")
    failed, learnt = turns(learner, ARM, "other")
    assert isinstance(failed, LearningFailure)
    assert (failed.model, failed.version) == (ARM, 1)
    assert isinstance(learnt, Publication)
    assert learnt.model == "other"
    assert 0.0 < learner.pause() <= 1.0
    assert turns(learner, ARM) == []  # not at once


def test_a_version_that_failed_is_tried_again_less_and_less_often(arm, learner, monkeypatch):
    arm.batches(0)

    def fail(self, floor):
        raise NotPositiveDefiniteError("no samples have such statistics")

    real = following.OnlineModel.model
    monkeypatch.setattr(following.OnlineModel, "model", fail)
    pauses = []
    for _ in range(3):
        (failed,) = turns(learner, ARM)
        assert failed.error == "NotPositiveDefiniteError: no samples have such statistics"
        ((at, pause),) = learner._failed.values()
        pauses.append(pause)
        learner._failed[ARM, 1] = (at - 100.0, pause)  # as if that time had passed
    assert pauses == [1.0, 2.0, 4.0]
    monkeypatch.setattr(following.OnlineModel, "model", real)
    (message,) = turns(learner)
    same(answering(arm, message), at_once([0]))
    assert not learner._failed
