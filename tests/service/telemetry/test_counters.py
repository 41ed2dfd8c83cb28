"""Counters in memory that processes share: sums over all, kept when a process is killed."""

import os
import signal
from threading import Thread

import pytest

from service.learning.live.status import AnswerCounter
from service.telemetry import counters
from service.telemetry.counters import CounterMemory, Counters
from service.telemetry.meters import Kind, Meters

ANSWERED = Kind("POST", "/v1/models/{model}/predict", "arm", 200, "")


def in_child(work):
    """Run in a forked process, which then kills itself."""
    child = os.fork()
    if not child:
        try:
            work()
        finally:
            os.kill(os.getpid(), signal.SIGKILL)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL


def count(meters, kind, number):
    for _ in range(number):
        meters.requests.find(kind, exists=True).add(0.5)


def answered(meters):
    return {kind: (sum(each.counts), each.total) for kind, each in meters.requests.totals().items()}


def test_killed_processes_lose_no_count_and_their_successors_continue():
    memory = CounterMemory(2)
    meters = Meters(counters=Counters(memory, 0))
    count(meters, ANSWERED, 3)
    for _ in range(2):
        in_child(lambda: count(Meters(counters=Counters(memory, 1)), ANSWERED, 2))
    in_child(lambda: count(Meters(counters=Counters(memory, 0)), ANSWERED._replace(status=429), 1))
    assert answered(meters) == {ANSWERED: (7, 3.5), ANSWERED._replace(status=429): (1, 0.5)}


def test_streams_are_sums_by_model_and_error():
    memory = CounterMemory(2)
    here, there = (Meters(counters=Counters(memory, part)) for part in range(2))
    for meters, number in ((here, 1), (there, 2)):
        for _ in range(number):
            meters.stream("arm").durations.add(0.25)
            meters.stream("arm").count_late()
            meters.stream("arm").refuse("invalid_request")
    there.stream("other arm").refuse("busy")
    for meters in (here, there):
        totals = meters.streams()
        assert (sum(totals["arm"].durations.counts), totals["arm"].durations.total) == (3, 0.75)
        assert (totals["arm"].late, totals["arm"].refused) == (3, {"invalid_request": 3})
        assert (totals["other arm"].late, totals["other arm"].refused) == (0, {"busy": 1})


def test_live_feed_counts_the_answers_of_all_processes():
    memory = CounterMemory(2)
    here, there = (Meters(counters=Counters(memory, part)) for part in range(2))
    counter = AnswerCounter(here, "arm")
    there.stream("arm").durations.add(0.25)
    assert counter.since(None) is None
    for meters in (here, there, there):
        meters.stream("arm").durations.add(0.25)
        meters.stream("arm").count_late()
    there.stream("arm").refuse("busy")
    seen = counter.since(1.0)
    assert (seen.count, seen.late, seen.refused, seen.p50_at_most_s) == (3, 3, 1, 0.25)


def test_gauges_of_a_killed_process_end_with_it():
    memory = CounterMemory(2)
    ours = Counters(memory, 0)
    ours.gauge("streams").add(2)
    in_child(lambda: Counters(memory, 1).gauge("streams").add(5))
    assert ours.gauge("streams").total == 7
    Counters(memory, 1)  # the successor
    assert ours.gauge("streams").total == 2
    in_child(lambda: Counters(memory, 1).gauge("streams").add(5))
    ours.clear_gauges(1)
    assert (ours.gauge("streams").total, ours.gauge("requests").total) == (2, 0)


@pytest.mark.parametrize("name", [("kind", "third"), ("kind", "x" * counters.NAME_BYTES)], ids=["many", "long"])
def test_counters_without_room_are_of_their_process_alone(monkeypatch, name):
    monkeypatch.setattr(counters, "MAX_TALLIES", 2)
    memory = CounterMemory(2)
    ours, theirs = Counters(memory, 0), Counters(memory, 1)
    for each in (("kind", "first"), ("kind", "second"), name):
        ours.tally(*each).counts[0] += 1
        ours.tally(*each).counts[0] += 1
    assert [tally.counts[0] for tally in ours.tallies("kind")[name[1:]]] == [2]
    assert name[1:] not in theirs.tallies("kind")
    assert [tally.counts[0] for tally in theirs.tallies("kind")["second",]] == [2]
    assert theirs.tallies("other kind") == {}


def test_threads_of_a_process_get_the_same_tally():
    ours, found = Counters(CounterMemory(1)), []
    threads = [Thread(target=lambda: found.extend(ours.tally("kind", str(n)) for n in range(200))) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len({id(tally) for tally in found}) == len(ours.tallies("kind")) == 200


def test_other_processes_are_known():
    memory = CounterMemory(3)
    ours = Counters(memory, 0)
    in_child(lambda: Counters(memory, 1))
    assert [pid for pid in ours.others() if pid != os.getpid()] == ours.others()
    assert len(ours.others()) == 1
    Counters(memory, 2)
    assert os.getpid() in ours.others()
    assert Counters().others() == []
