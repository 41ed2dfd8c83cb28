"""Followers of the log: what they learn, publish and store, and how several take turns."""

import multiprocessing
import time
from math import inf

import numpy as np
import pytest
from sqlalchemy import select

from lipcore import NotPositiveDefiniteError
from lipcore.vocabulary import Code
from service.journal import log
from service.learning.learner import follower as follower_module
from service.learning.learner import publication
from service.learning.learner import worker as learner_worker
from service.learning.learner.follower import Follower, Novelty
from service.learning.learner.publication import LearningFailure, Publication
from service.learning.learner.worker import Learner
from service.learning.weigher import worker as weigher_worker
from service.storage.database import SnapshotRow
from tests.service.learning.pendulums import (
    ARM,
    assert_predictions,
    expected_predictions,
    make_rows,
    predict_queries,
    trained_model,
)


@pytest.fixture
def arm(arm, monkeypatch):
    """Model with one version and without periodic snapshots."""
    monkeypatch.setattr(follower_module, "SNAPSHOT_PERIODS", 1e8)
    publication.clear(arm.files)
    return arm


@pytest.mark.parametrize("process", [learner_worker, weigher_worker])
def test_process_ends_in_order_if_the_service_dies_with_unread_messages(arm, process):
    ours, theirs = multiprocessing.Pipe()
    theirs.send("unread")
    ours.close()  # the next read of the other end is refused with ECONNRESET
    process.run(arm.settings, theirs)
    theirs.close()


def start_follower(arm):
    """Return a follower of version 1 that has not read the log yet."""
    return Follower(arm.database, arm.files, arm.settings, ARM, 1, arm.base)


@pytest.fixture
def follower(arm):
    return start_follower(arm)


def catch_up(follower):
    """Step to the end of the log."""
    follower.woken = follower.behind = True
    while follower.behind:
        follower.step()
    return follower


def list_snapshots(arm):
    """Return the event numbers of the snapshots of version 1 of all models."""
    with arm.database.session() as session:
        return sorted(session.scalars(select(SnapshotRow.number).where(SnapshotRow.version == 1)))


def read_published_model(message):
    """Return the model that the service would predict with."""
    return publication.read(message.path).apply(trained_model())


def test_logged_batches_are_published(arm, follower):
    arm.log_batches(0, 1, 2)
    message = catch_up(follower).publish()
    assert (message.model, message.version, message.number, message.revision) == (ARM, 1, 3, 3)
    assert message.samples == pytest.approx(30)
    assert message.seconds > 0
    assert_predictions(read_published_model(message), expected_predictions(range(3)))
    assert not follower.unpublished
    arm.log_batches(3)
    assert catch_up(follower).unpublished
    assert_predictions(read_published_model(follower.publish()), expected_predictions(range(4)))


def test_rollback_is_published_as_higher_revision(arm, follower):
    arm.log_batches(0, 1)
    catch_up(follower).store()
    arm.log_batches(2, 3)
    catch_up(follower).publish()
    arm.rollback(2)
    follower.woken = follower.behind = True
    while follower.behind:
        follower.step()
        assert not follower.unpublished or follower.number == 5  # no states within the rollback
    message = follower.publish()
    assert message.revision == 5
    assert_predictions(read_published_model(message), expected_predictions(range(2)))


def test_rejected_batches_do_not_trigger_a_solve(arm, follower, monkeypatch):
    arm.log_batches(0, 1)
    before = predict_queries(read_published_model(catch_up(follower).publish()))
    kept_out = make_rows(2)
    kept_out.code[:] = 6
    arm.log_batch(2, rows=kept_out)
    monkeypatch.setattr(follower_module.Revision, "of", None)
    message = catch_up(follower).publish()
    assert message.revision == 3
    assert_predictions(read_published_model(message), before)


def test_follower_resumes_from_stored_state(arm, follower, monkeypatch):
    arm.log_batches(0, 1, 2)
    catch_up(follower).store()
    assert list_snapshots(arm) == [3]
    follower.store()
    assert list_snapshots(arm) == [3]
    arm.log_batches(3)
    learnt = []
    monkeypatch.setattr(log, "decode", lambda payload, real=log.decode: learnt.append(1) or real(payload))
    again = catch_up(start_follower(arm))
    assert len(learnt) == 1
    assert_predictions(read_published_model(again.publish()), expected_predictions(range(4)))


def test_several_services_share_snapshots(arm, follower, monkeypatch):
    monkeypatch.setattr(arm.database.adapter, "shared", True)
    other = start_follower(arm)
    arm.log_batches(0, 1)
    catch_up(follower).store_in_turn()
    arm.log_batches(2)
    catch_up(other).store_in_turn()
    assert list_snapshots(arm) == [2]
    catch_up(follower).store_in_turn()
    other.store()
    assert list_snapshots(arm) == [2, 3]
    arm.log_batches(3)
    catch_up(other).store()  # the final store does not depend on whose turn it is
    assert list_snapshots(arm) == [2, 3, 4]


def test_snapshots_are_stored_after_clock_is_set_back(arm, follower, monkeypatch):
    monkeypatch.setattr(arm.database.adapter, "shared", True)
    arm.log_batches(0)
    catch_up(start_follower(arm)).store()
    arm.log_batches(1)
    monkeypatch.setattr(time, "time", lambda real=time.time: real() - 3600.0)
    catch_up(follower).store_in_turn()
    assert list_snapshots(arm) == [1, 2]


def test_novelty_counts_motion_beyond_the_basis():
    novelty, seen = Novelty(window=80), []
    for count, novel in ((76, 76), (4, 4), (80, 0), (40, 40), (60, 0)):  # few rows give no share
        novelty.add(np.arange(count) < novel)
        seen.append((novelty.rows, novelty.share))
    assert seen == [(76, 0.0), (80, 1.0), (80, 0.0), (120, 0.5), (120, 0.25)]


def test_publication_contains_novelty_of_learnt_rows(arm, follower):
    """Motion is far faster than in the training; rows that are not learnt do not count."""
    quick = make_rows(0, size=40)
    quick.dq[:] = 50.0
    quick.code[30:] = Code.CONTACT
    arm.log_batch(0, rows=quick)
    message = catch_up(follower).publish()
    assert (message.novel_rows, message.novel_share) == (30, 0.0)


def test_publication_contains_linearisation_error(arm, follower, monkeypatch):
    arm.log_batch(0)
    assert catch_up(follower).publish().linearisation is None
    monkeypatch.setattr(follower_module, "linearisation_error", lambda model: np.array([0.1, 0.7]))
    arm.log_batch(1)
    assert catch_up(follower).publish().linearisation == (0.0, 0.0)  # both errors are below the floor
    monkeypatch.setattr(follower_module, "error_floor_of", lambda *_: np.array([0.0, 0.5]))
    arm.log_batch(2)
    assert catch_up(follower).publish().linearisation == (0.0, 0.7)


@pytest.fixture
def learner(arm):
    """Learner that normally runs in the learner process."""
    return Learner(arm.database, arm.files, arm.settings.model_copy(update={"max_loaded_models": 2}))


def run_turns(learner, *woken):
    """Wake models and run turns until no follower has work; return the messages."""
    learner.wake(set(woken))
    messages = []
    while learner.pause() == 0 or (
        learner.pause() < inf and any(each.unpublished for each in list(learner.followers.values()))
    ):
        messages += learner.turn()
    return messages


def test_only_the_serving_version_learns(arm, learner):
    arm.log_batches(0, 1)
    arm.publish(candidate=True, start=1)
    arm.publish("other")
    arm.log_batch(0, model="other")
    messages = {(each.model, each.version): each for each in run_turns(learner, ARM)}
    assert set(messages) == {(ARM, 1)}
    assert_predictions(read_published_model(messages[ARM, 1]), expected_predictions(range(2)))


def test_replaced_version_is_stored_and_stops_learning(arm, learner):
    arm.log_batches(0, 1)
    run_turns(learner, ARM)
    arm.publish()
    arm.log_batches(2)
    messages = run_turns(learner, ARM)
    assert {each.version for each in messages} == {2}
    assert set(learner.followers) == {(ARM, 2)}
    assert list_snapshots(arm) == [2]


def test_evicted_versions_are_stored_and_restored(arm, learner):
    for name in ("b", "c"):
        arm.publish(name)
        arm.log_batch(0, model=name)
    arm.log_batches(0, 1)
    for name in (ARM, "b", "c"):
        run_turns(learner, name)
    assert set(learner.followers) == {("b", 1), ("c", 1)}
    assert list_snapshots(arm) == [2]
    arm.log_batches(2)
    (message,) = run_turns(learner, ARM)
    assert_predictions(read_published_model(message), expected_predictions(range(3)))
    assert run_turns(learner, "nobody") == []
    learner.close()
    assert list_snapshots(arm) == [1, 1, 2, 3]  # closing stores all versions


def test_snapshots_are_stored_periodically(arm, learner, monkeypatch):
    monkeypatch.setattr(follower_module, "SNAPSHOT_PERIODS", 0)
    arm.log_batches(0, 1)
    run_turns(learner, ARM)
    assert list_snapshots(arm) == [2]


def test_failing_version_does_not_block_others(arm, learner):
    arm.publish("other")
    arm.log_batch(0, model="other")
    arm.log_batches(0, 1)
    with arm.database.transaction() as session:
        session.connection().exec_driver_sql("UPDATE events SET payload = x'00' WHERE model = 'arm'")
    failed, learnt = run_turns(learner, ARM, "other")
    assert isinstance(failed, LearningFailure)
    assert (failed.model, failed.version) == (ARM, 1)
    assert isinstance(learnt, Publication)
    assert learnt.model == "other"
    assert 0.0 < learner.pause() <= 1.0
    assert run_turns(learner, ARM) == []  # not retried at once


def test_failed_version_is_retried_with_growing_pauses(arm, learner, monkeypatch):
    arm.log_batches(0)

    def fail(self, floor):
        raise NotPositiveDefiniteError("no samples have such statistics")

    pauses = []
    with monkeypatch.context() as patch:
        patch.setattr(follower_module.OnlineModel, "model", fail)
        for _ in range(3):
            (failed,) = run_turns(learner, ARM)
            assert failed.error == "NotPositiveDefiniteError: no samples have such statistics"
            ((at, pause),) = learner._failed.values()
            pauses.append(pause)
            learner._failed[ARM, 1] = (at - 100.0, pause)  # simulates the pause
    assert pauses == [1.0, 2.0, 4.0]
    (message,) = run_turns(learner)
    assert_predictions(read_published_model(message), expected_predictions([0]))
    assert not learner._failed
