"""The learner as a process of its own: woken, heard, killed, started again, and out of serving's way."""

import os
import signal
import subprocess
import sys
import threading
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
from tests.service.learning.pendulums import ARM, Arm, adopt, at_once, same

linux = pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="reads /proc")


class Serving:
    """What the service does with a learner process: answer with what it publishes. arm: a model that learns."""

    def __init__(self, home, **settings):
        self.arm = Arm.open(home, learner_niceness=1, **settings)
        self.loaded = LoadedModels(self.arm.storage, LearntVersions(self.arm.database, self.arm.files), capacity=4)
        self.loaded.preload()
        self.messages = []
        self.learner = LearnerProcess(self.arm.settings, self.take)

    def take(self, message):
        self.messages.append(message)
        if isinstance(message, Publication):
            adopt(self.loaded, message)

    def teach(self, *numbers):
        """Log batches and wake the learner."""
        self.arm.batches(*numbers)
        self.learner.wake(self.arm.model)

    def answering(self, revision):
        """The model that answers once a revision does."""
        return eventually(
            lambda: (served := self.loaded.hot(self.arm.model, None)).revision >= revision and served
        ).model

    def stored(self):
        """Numbers of the snapshots."""
        with self.arm.database.session() as session:
            return sorted(session.scalars(select(SnapshotRow.number)))

    def close(self):
        self.learner.close()
        self.arm.database.close()


@pytest.fixture(scope="module")
def service(tmp_path_factory):
    """A service whose learner runs."""
    started = Serving(tmp_path_factory.mktemp("learner"))
    started.teach(0)
    started.answering(1)
    yield started
    started.close()


@pytest.fixture
def serving(service, request):
    """That service with a model of the test's own."""
    service.arm = replace(service.arm, model=request.node.name[:60].replace("[", "-").rstrip("]"))
    service.arm.publish()
    service.loaded.get(service.arm.model, None)
    service.messages.clear()
    return service


@pytest.fixture
def alone(home):
    """A service of the test's own, whose learner has not been needed yet."""
    started = Serving(home)
    yield started
    started.close()


def test_what_is_logged_is_learnt_and_answered(serving):
    serving.teach(0, 1, 2)
    same(serving.answering(3), at_once(range(3)))
    serving.teach(3)
    same(serving.answering(4), at_once(range(4)))
    assert list(publication.folder(serving.arm.files).iterdir()) == []
    serving.arm.unlearn(2)
    serving.learner.wake(serving.arm.model)
    same(serving.answering(5), at_once([0, 2, 3]))


def test_a_killed_learner_comes_back_and_catches_up(serving, caplog):
    serving.teach(0, 1)
    serving.answering(2)
    first = serving.learner.pid
    os.kill(first, signal.SIGKILL)
    serving.teach(2, 3)
    same(serving.answering(4), at_once(range(4)))
    assert serving.learner.pid not in (None, first)
    assert "the learner process ended with exit code -9; it is started again" in caplog.text
    revisions = [each.revision for each in serving.messages if each.model == serving.arm.model]
    assert revisions == sorted(revisions)
    assert revisions[-1] == 4


def test_a_learner_that_hangs_is_replaced_and_nothing_is_lost(home, caplog, monkeypatch):
    monkeypatch.setattr(companion, "COMPANION", companion.CompanionOptions(quiet_s=2.0))
    hasty = Serving(home)
    try:
        hasty.teach(0, 1)
        hasty.answering(2)
        first = hasty.learner.pid
        os.kill(first, signal.SIGSTOP)  # it is there, but does nothing any more
        hasty.teach(2, 3)
        same(hasty.answering(4), at_once(range(4)))
        assert hasty.learner.pid not in (None, first)
        assert "the learner process hangs and is killed: it has not got on for 2 s" in caplog.text
    finally:
        hasty.close()


def test_where_the_system_starts_no_learner_it_is_tried_again(alone, monkeypatch, caplog):
    start, failures = alone.learner._start, iter([BlockingIOError("no more processes")])

    def sometimes():
        for failure in failures:
            raise failure
        return start()

    monkeypatch.setattr(alone.learner, "_start", sometimes)
    alone.teach(0)
    alone.answering(1)
    assert "the learner process cannot be started" in caplog.text


def test_a_learner_at_rest_says_that_it_gets_on(serving):
    serving.teach(0)
    serving.answering(1)
    process = serving.learner._progress
    process.silent_s = 7.0
    eventually(lambda: process.silent_s == 0.0)


def test_what_it_knows_is_stored_when_the_service_ends(alone):
    assert alone.learner.pid is None  # not before there is something to learn
    alone.teach(0, 1, 2)
    alone.answering(3)
    assert alone.stored() == []
    os.kill(alone.learner.pid, signal.SIGTERM)  # to all processes of a service, which then ends in order
    os.kill(alone.learner.pid, signal.SIGINT)
    alone.learner.close()
    assert alone.stored() == [3]
    assert alone.learner.pid is None
    alone.learner.wake(ARM)  # too late: nothing is started
    assert alone.learner.pid is None


def test_ending_while_it_starts_does_not_wait_for_it(alone):
    alone.learner.wake(ARM)
    alone.learner.close()
    assert alone.learner.pid is None


def test_waking_one_that_is_busy_does_not_wait(serving):
    serving.teach(0)
    serving.answering(1)
    pid = serving.learner.pid
    os.kill(pid, signal.SIGSTOP)
    for _ in range(5000):  # more than a pipe holds, were each sent
        serving.learner.wake(serving.arm.model)
    os.kill(pid, signal.SIGCONT)
    serving.teach(1)
    same(serving.answering(2), at_once(range(2)))


def test_a_message_that_cannot_be_taken_does_not_end_the_listening(serving, monkeypatch, caplog):
    refused = threading.Event()

    def take(message):
        if not refused.is_set():
            refused.set()
            raise RuntimeError("no room")
        serving.take(message)

    monkeypatch.setattr(serving.learner, "on_message", take)
    serving.teach(0)
    assert refused.wait(DEADLINE)
    serving.teach(1)
    same(serving.answering(2), at_once(range(2)))
    assert "a message of the learner process was not taken" in caplog.text


@linux
def test_it_gives_way_to_serving(serving):
    serving.teach(0)
    serving.answering(1)
    place, pid = learner_place(serving.arm.settings), serving.learner.pid
    for task in Path(f"/proc/{pid}/task").iterdir():
        fields = (task / "stat").read_text().rpartition(")")[2].split()
        assert int(fields[16]) == os.nice(0) + serving.arm.settings.learner_niceness
        assert frozenset(os.sched_getaffinity(int(task.name))) == place.cpus
    assert (place.threads, place.niceness) == (1, serving.arm.settings.learner_niceness)


def test_it_takes_its_place_before_numerics_are_imported():
    """Spawning imports the module of the process's function before that runs."""
    said = "import sys, service.learning.learner.process; print(sorted({'numpy', 'torch', 'scipy'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", said], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
