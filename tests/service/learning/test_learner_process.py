"""The learner process: waking, messages, kills, restarts, and its low priority."""

import os
import signal
import subprocess
import sys
import threading
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest
from sqlalchemy import select

from service.learning.learner import publication
from service.learning.learner.learnt import LearntVersions
from service.learning.learner.process import LearnerProcess, learner_place
from service.learning.learner.publication import Publication
from service.models.loaded import LoadedModels
from service.runtime import companion
from service.storage.database import SnapshotRow
from tests.service.data import DEADLINE, eventually
from tests.service.learning.pendulums import ARM, Arm, adopt_revision, assert_predictions, expected_predictions


class AnsweringService:
    """Service that predicts with what its learner process publishes; `arm` is the model that learns."""

    def __init__(self, home, **settings):
        self.arm = Arm.open(home, learner_niceness=1, **settings)
        self.loaded = LoadedModels(self.arm.storage, LearntVersions(self.arm.database, self.arm.files), capacity=4)
        self.loaded.preload()
        self.messages = []
        self.learner = LearnerProcess(self.arm.settings, self.receive)

    def receive(self, message):
        self.messages.append(message)
        if isinstance(message, Publication):
            adopt_revision(self.loaded, message)

    def wake(self):
        """Wake the learner for the model."""
        self.learner.wake(self.arm.model)

    def learn_batches(self, *numbers):
        """Log batches, wake the learner, and check the predictions once they contain these and all earlier batches."""
        self.arm.log_batches(*numbers)
        self.wake()
        self.check_predictions(numbers[-1] + 1, range(numbers[-1] + 1))

    def check_predictions(self, revision, batches):
        """Check that predictions, once they contain a revision, have learnt these batches."""
        served = eventually(lambda: (hot := self.loaded.hot(self.arm.model, None)).revision >= revision and hot)
        assert_predictions(served.model, expected_predictions(batches))

    def list_snapshots(self):
        """Return the event numbers of the snapshots."""
        with self.arm.database.session() as session:
            return sorted(session.scalars(select(SnapshotRow.number)))

    def close(self):
        self.learner.close()
        self.arm.database.close()


@pytest.fixture(scope="module")
def shared_service(tmp_path_factory):
    """Service with a running learner."""
    started = AnsweringService(tmp_path_factory.mktemp("learner"))
    started.learn_batches(0)
    yield started
    started.close()


@pytest.fixture
def answering(shared_service, request):
    """Shared service with a model of this test."""
    shared_service.arm = replace(shared_service.arm, model=request.node.name[:60].replace("[", "-").rstrip("]"))
    shared_service.arm.publish()
    shared_service.loaded.get(shared_service.arm.model, None)
    shared_service.messages.clear()
    return shared_service


@pytest.fixture
def own_service(home):
    """Service of this test, whose learner is not started yet."""
    started = AnsweringService(home)
    yield started
    started.close()


def test_logged_batches_are_learnt_and_answered(answering):
    answering.learn_batches(0, 1, 2)
    answering.learn_batches(3)
    assert list(publication.folder(answering.arm.files).iterdir()) == []
    answering.arm.unlearn(2)
    answering.wake()
    answering.check_predictions(5, [0, 2, 3])


def check_replacement(service, fatal_signal):
    """Check that the service replaces a learner that gets a signal, and that its successor learns all batches."""
    service.learn_batches(0, 1)
    first = service.learner.pid
    os.kill(first, fatal_signal)
    service.learn_batches(2, 3)
    assert service.learner.pid not in (None, first)


def test_killed_learner_restarts_and_catches_up(answering, caplog):
    check_replacement(answering, signal.SIGKILL)
    assert "the learner process ended with exit code -9; it is started again" in caplog.text
    revisions = [each.revision for each in answering.messages if each.model == answering.arm.model]
    assert revisions == sorted(revisions)
    assert revisions[-1] == 4


@pytest.mark.slow
def test_hanging_learner_is_replaced_without_loss(home, caplog, monkeypatch):
    monkeypatch.setattr(companion, "COMPANION", companion.CompanionOptions(quiet_s=2.0))
    with closing(AnsweringService(home)) as impatient_service:
        check_replacement(impatient_service, signal.SIGSTOP)  # the process exists but does not run
        assert "the learner process hangs and is killed: it has made no progress for 2 s" in caplog.text


@pytest.mark.slow
def test_failed_learner_start_is_retried(own_service, monkeypatch, caplog):
    start, failures = own_service.learner._start, iter([BlockingIOError("no more processes")])

    def sometimes():
        for failure in failures:
            raise failure
        return start()

    monkeypatch.setattr(own_service.learner, "_start", sometimes)
    own_service.learn_batches(0)
    assert "the learner process could not be started" in caplog.text


@pytest.mark.slow
def test_idle_learner_reports_progress(answering):
    answering.learn_batches(0)
    process = answering.learner._progress
    process.silent_s = 7.0
    eventually(lambda: process.silent_s == 0.0)


@pytest.mark.slow
def test_state_is_stored_at_shutdown(own_service):
    assert own_service.learner.pid is None  # the learner is started by the first batch
    own_service.learn_batches(0, 1, 2)
    assert own_service.list_snapshots() == []
    os.kill(own_service.learner.pid, signal.SIGTERM)  # signals reach all processes; the service ends the learner
    os.kill(own_service.learner.pid, signal.SIGINT)
    own_service.learner.close()
    assert own_service.list_snapshots() == [3]
    assert own_service.learner.pid is None
    own_service.learner.wake(ARM)  # a closed learner is not started
    assert own_service.learner.pid is None


def test_shutdown_does_not_wait_for_a_starting_learner(own_service):
    own_service.learner.wake(ARM)
    own_service.learner.close()
    assert own_service.learner.pid is None


def test_waking_a_busy_learner_does_not_block(answering):
    answering.learn_batches(0)
    pid = answering.learner.pid
    os.kill(pid, signal.SIGSTOP)
    for _ in range(5000):  # more messages than a pipe holds
        answering.wake()
    os.kill(pid, signal.SIGCONT)
    answering.learn_batches(1)


def test_failing_message_handler_does_not_stop_the_listener(answering, monkeypatch, caplog):
    refused = threading.Event()

    def take(message):
        if not refused.is_set():
            refused.set()
            raise RuntimeError("no room")
        answering.receive(message)

    monkeypatch.setattr(answering.learner, "on_message", take)
    answering.arm.log_batches(0)
    answering.wake()
    assert refused.wait(DEADLINE)
    answering.learn_batches(1)
    assert "could not handle a message of the learner process" in caplog.text


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="reads /proc")
def test_learner_runs_at_low_priority(answering):
    answering.learn_batches(0)
    place, pid = learner_place(answering.arm.settings), answering.learner.pid
    for task in Path(f"/proc/{pid}/task").iterdir():
        fields = (task / "stat").read_text().rpartition(")")[2].split()
        assert int(fields[16]) == os.nice(0) + answering.arm.settings.learner_niceness
        assert frozenset(os.sched_getaffinity(int(task.name))) == place.cpus
    assert (place.threads, place.niceness) == (1, answering.arm.settings.learner_niceness)


def test_process_module_imports_no_numerics():
    """Spawning imports this module before the process sets its priority and thread count."""
    loaded = "sorted({'numpy', 'torch', 'scipy'} & set(sys.modules))"
    reply = f"import sys, service.learning.learner.process; print({loaded})"
    done = subprocess.run([sys.executable, "-c", reply], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
