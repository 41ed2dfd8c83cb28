"""Kills during ingest: acknowledged batches are logged and learnt exactly once."""

import multiprocessing
import signal
import threading
from contextlib import suppress
from itertools import count

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
from tests.service.learning.batches import MODEL, find_stream, list_events, make_batch, make_rows, open_database

ROWS = 50


def send_batches(settings, acknowledged, first):
    """Send batches from a sequence on, until this process is killed."""
    database = Database.of(settings)
    for sequence in count(first):
        with database.transaction() as session:
            if log.find_batch(session, MODEL, "robot-1", sequence) is None:
                log.append_batch(session, MODEL, make_batch(sequence, rows=make_rows(ROWS, seed=sequence)))
        acknowledged.send(sequence)


def send_until_killed(home, first, acknowledgements, later):
    """Run a process that is killed `later` s after its acknowledgements; return the acknowledged sequences."""
    processes = multiprocessing.get_context("forkserver")
    processes.set_forkserver_preload([__name__])  # imports once for many processes
    ours, theirs = processes.Pipe(duplex=False)
    process = processes.Process(target=send_batches, args=(Settings(home=home), theirs, first), daemon=True)
    process.start()
    theirs.close()
    acknowledged = []
    with suppress(EOFError):
        while ours.poll(DEADLINE):
            acknowledged.append(ours.recv())
            if len(acknowledged) == acknowledgements:
                threading.Timer(later, process.kill).start()
    process.join(DEADLINE)
    assert process.exitcode == -signal.SIGKILL
    return acknowledged


@pytest.mark.slow
def test_kill_loses_and_duplicates_no_acknowledged_batch(home):
    open_database(home).close()
    rng = np.random.default_rng(3)
    acknowledged = []
    for kill in range(20):
        later = rng.uniform(0.0, 0.01) if kill % 2 else 0.0  # at a random moment, or right after an acknowledgement
        following = acknowledged[-1] + 1 if acknowledged else 0  # it may be logged already
        acknowledged += send_until_killed(home, following, int(rng.integers(1, 6)), later)

    database = Database.of(Settings(home=home))
    found = list_events(database)
    sequences = [event.sequence for event in found]
    assert set(acknowledged) <= set(sequences)
    assert sequences == list(range(len(found)))  # none missing, none twice
    assert [event.number for event in found] == list(range(1, len(found) + 1))
    with database.session() as session:
        for event in log.events(session, MODEL, 0, len(found)):
            assert event.payload == encode(make_rows(ROWS, seed=event.sequence))
    assert (find_stream(database).last, find_stream(database).missing["ranges"]) == (sequences[-1], [])
    database.close()


N_TRIALS = 6
"""Number of kills, alternating between the service and its learner."""


@pytest.fixture(scope="module")
def tally(tmp_path_factory) -> Tally:
    with open_trials(tmp_path_factory.mktemp("trials"), N_TRIALS, seed=5, batches=20) as trials:
        for number in range(N_TRIALS):
            trials.trial(VICTIMS[number % 2], batches=20)
        trials.measure_one_batch()
    return trials.tally


@pytest.mark.slow
def test_service_and_learner_kills_lose_and_duplicate_nothing(tally):
    assert tally.kills == {"service": N_TRIALS // 2, "learner": N_TRIALS // 2}
    assert tally.batches == 20 * N_TRIALS
    assert min(tally.repeated, tally.late) > 0
    assert (tally.lost, tally.twice, tally.refused) == (0, 0, 0)
    # one batch more or less would exceed the tolerance
    assert tally.largest <= durability.MAX_DIFFERENCE < 0.1 * tally.one_batch
