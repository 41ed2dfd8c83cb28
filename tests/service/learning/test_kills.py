"""Kills while batches come: what was acknowledged is there, and nothing is there, or learnt, twice."""

import multiprocessing
import os
import signal
import threading
from contextlib import suppress

import numpy as np
import pytest

from benchmarks.online import durability
from benchmarks.online.durability import VICTIMS, open_trials
from benchmarks.online.trials import Tally
from service.foundation.settings import Settings
from service.journal import log
from service.journal.log import encode
from service.storage.database import Database
from tests.service.data import DEADLINE
from tests.service.learning.batches import MODEL, batch, everything, opened, rows, source

ROWS = 50


def send_batches(settings, acknowledged, sequence, count, later):
    """Send batches from a sequence on; be killed `later` s after `count` have been acknowledged."""
    database = Database.of(settings)
    killing = threading.Timer(later, os.kill, (os.getpid(), signal.SIGKILL))
    while True:
        with database.transaction() as session:
            if log.find_batch(session, MODEL, "robot-1", sequence) is None:
                log.append_batch(session, MODEL, batch(sequence, rows=rows(ROWS, seed=sequence)))
        acknowledged.send(sequence)
        sequence += 1
        count -= 1
        if count == 0:
            killing.start()


def sent_until_killed(home, sequence, count, later):
    """Let a process send until it is killed; return what it has acknowledged."""
    processes = multiprocessing.get_context("forkserver")
    processes.set_forkserver_preload([__name__])  # many processes, one import
    ours, theirs = processes.Pipe(duplex=False)
    given = Settings(home=home), theirs, sequence, count, later
    process = processes.Process(target=send_batches, args=given, daemon=True)
    process.start()
    theirs.close()
    acknowledged = []
    with suppress(EOFError):
        while ours.poll(DEADLINE):
            acknowledged.append(ours.recv())
    process.join(DEADLINE)
    assert process.exitcode == -signal.SIGKILL
    return acknowledged


@pytest.mark.slow
def test_a_kill_at_any_moment_loses_no_acknowledged_batch_and_leaves_none_twice(home):
    opened(home).close()
    chance = np.random.default_rng(3)
    acknowledged = []
    for kill in range(20):
        later = chance.uniform(0.0, 0.01) if kill % 2 else 0.0  # at any moment, or just as one was acknowledged
        following = acknowledged[-1] + 1 if acknowledged else 0  # again what may be there, never what was acknowledged
        acknowledged += sent_until_killed(home, following, int(chance.integers(1, 6)), later)

    database = Database.of(Settings(home=home))
    found = everything(database)
    sequences = [event.sequence for event in found]
    assert set(acknowledged) <= set(sequences)
    assert sequences == list(range(len(found)))  # none missing, none twice
    assert [event.number for event in found] == list(range(1, len(found) + 1))
    with database.session() as session:
        for event in log.events(session, MODEL, 0, len(found)):
            assert event.payload == encode(rows(ROWS, seed=event.sequence))
    assert (source(database).last, source(database).missing["ranges"]) == (sequences[-1], [])
    database.close()


TRIALS = 6
"""Kills, of the service and of its learner in turn."""


@pytest.fixture(scope="module")
def tally(tmp_path_factory) -> Tally:
    with open_trials(tmp_path_factory.mktemp("trials"), TRIALS, seed=5, batches=20) as trials:
        for number in range(TRIALS):
            trials.trial(VICTIMS[number % 2], batches=20)
        trials.weigh()
    return trials.tally


@pytest.mark.slow
def test_no_acknowledged_batch_is_lost_nor_applied_twice(tally):
    assert tally.kills == {"service": TRIALS // 2, "learner": TRIALS // 2}
    assert tally.batches == 20 * TRIALS
    assert min(tally.repeated, tally.late) > 0
    assert (tally.lost, tally.twice, tally.refused) == (0, 0, 0)
    # a single batch more or less would show
    assert tally.largest <= durability.TOLERANCE < 0.1 * tally.one_batch
