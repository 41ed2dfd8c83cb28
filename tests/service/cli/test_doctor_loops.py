"""Loops of `lipserve doctor`: their delays on an exact clock, and their policy."""

import gc
import os
from types import SimpleNamespace

import numpy as np
import pytest

from service.cli.doctor import loops
from service.runtime.realtime import probe_real_time


class ExactClock:
    """A clock that only sleeping and acting move. late: how late a sleep ends, ns."""

    def __init__(self, monkeypatch, late=0):
        self.now, self.late = 5_000, late
        monkeypatch.setattr(loops, "time", SimpleNamespace(monotonic_ns=lambda: self.now, sleep=self.sleep))

    def sleep(self, seconds):
        assert seconds > 0
        self.now += round(seconds * 1e9) + self.late


MS = 1_000_000


def test_delays_of_a_loop_count_from_its_ticks(monkeypatch):
    """A stall of 2.5 ms at the second of six ticks delays the next two as well; sleeps end 10 µs late."""
    clock, lengths = ExactClock(monkeypatch, late=10_000), iter([0, 2_500_000, 100_000, 100_000, 0, 0])

    def act():
        clock.now += next(lengths)

    delays = loops.run_loop(1000, 0.006, act)
    assert delays.tolist() == [10_000, 2_510_000, 1_610_000, 710_000, 10_000, 10_000]
    loop = loops.Loop.of("echo", "plain", 1000, delays, 1.0)
    assert (loop.ticks, loop.max_us, loop.in_time, loop.is_held) == (6, 2510.0, 4 / 6, False)
    assert loop.p50_us == pytest.approx(np.percentile(delays, 50) / 1e3)


def test_loop_that_falls_behind_ends_and_counts_its_last_ticks_as_late(monkeypatch):
    """Each act takes ten periods; of a hundred ticks, twenty are reached in twice the time."""
    clock, acts = ExactClock(monkeypatch), []

    def act():
        acts.append(clock.now)
        clock.now += 10 * MS

    delays = loops.run_loop(1000, 0.1, act)
    assert (len(acts), len(delays)) == (21, 100)
    assert (delays >= 10 * MS).all()
    assert delays[-1] == 101 * MS


def test_rate_is_held_if_999_of_1000_ticks_are_in_time():
    def loop(rate, late, ticks=1000):
        delays = np.where(np.arange(ticks) < late, 2e9 / rate, 1e9 / rate).astype(np.int64)
        return loops.Loop.of("torque", "plain", rate, delays, 1.0)

    assert loop(500, 1).is_held
    assert not loop(500, 2).is_held
    assert loops.highest_rate([loop(100, 0), loop(250, 1), loop(500, 2)]) == 250
    assert loops.highest_rate([loop(100, 5)]) is None


def test_loops_run_at_their_policy_and_collect_no_garbage(monkeypatch):
    ExactClock(monkeypatch)
    seen = []
    with loops.ThreadPoolExecutor(1, initializer=loops.initializer_of("plain")) as thread:
        thread.submit(loops.run_loop, 1000, 0.002, lambda: seen.append(gc.isenabled())).result()
    assert (seen, gc.isenabled()) == ([False, False], True)
    if probe_real_time().policy == "fifo":
        with loops.ThreadPoolExecutor(1, initializer=loops.initializer_of("SCHED_FIFO")) as thread:
            assert thread.submit(os.sched_getscheduler, 0).result() == os.SCHED_FIFO
    assert not hasattr(os, "sched_getscheduler") or os.sched_getscheduler(0) == os.SCHED_OTHER
