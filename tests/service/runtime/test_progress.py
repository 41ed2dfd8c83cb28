"""Hang detection: a process makes progress if it completes steps or its main thread uses CPU time."""

import subprocess
import sys
from math import inf

import pytest

from service.runtime.progress import CHECK_S, Progress, main_thread_s
from tests.service.data import eventually

BUSY = "while True: pass"
WAITING = """import threading
def spin():
    while True: pass
threading.Thread(target=spin, daemon=True).start()
lock = threading.Lock()
lock.acquire()
print("waits", flush=True)
lock.acquire()
"""
"""The main thread waits for ever while another thread is busy."""


class WatchedProcess:
    """A fake clock, the CPU time of one process, and its watch: at most 10 s without progress, 100 s a step."""

    def __init__(self):
        self.now, self.spent = 0.0, 0.0
        self.progress = Progress(lambda: (1,), 10.0, 100.0, lambda pid: self.spent, lambda: self.now)

    def look_for(self, seconds, busy=False):
        """Look once a second for this long; return the last result."""
        answer = None
        for _ in range(round(seconds)):
            self.now += 1.0
            self.spent = None if self.spent is None else self.spent + (0.02 if busy else 0.0)
            answer = self.progress.check()
        return answer


def test_process_without_steps_or_cpu_time_hangs():
    process = WatchedProcess()
    assert process.look_for(9) is None
    process.progress.step()
    assert process.look_for(9) is None
    assert process.progress.silent_s == 9.0
    assert process.look_for(1) == "it has made no progress for 10 s"


@pytest.mark.parametrize("spent", [0.0, None], ids=["computing", "of unknown CPU time"])
def test_process_may_take_long_but_not_for_ever(spent):
    process = WatchedProcess()
    process.spent = spent
    assert process.look_for(99, busy=True) is None
    assert process.progress.silent_s == 0.0
    assert process.look_for(1, busy=True) == "one of its steps has taken 100 s"


def test_time_without_looks_does_not_count():
    process = WatchedProcess()
    process.look_for(1)
    process.now += 1000.0  # the machine slept, or the watching process was suspended too
    assert process.progress.check() is None
    assert process.progress.silent_s <= 2 * CHECK_S + 1.0


@pytest.mark.skipif(main_thread_s(1) is None, reason="the system does not tell")
@pytest.mark.parametrize("source", [BUSY, WAITING], ids=["computes", "waits"])
def test_only_the_main_thread_counts(source):
    with subprocess.Popen([sys.executable, "-c", source], stdout=subprocess.PIPE) as child:
        try:
            if source is WAITING:
                child.stdout.readline()
            now = iter(range(10**9))
            progress = Progress(lambda: (child.pid,), inf, inf, clock=lambda: float(next(now)))
            if source is BUSY:
                progress.check()
                progress.silent_s = 5.0
                eventually(lambda: progress.check() is None and progress.silent_s == 0.0)
            else:
                everything = eventually(lambda: (spent := all_threads_s(child.pid)) > 0.1 and spent)
                progress.check()
                eventually(lambda: all_threads_s(child.pid) > everything + 0.1)
                progress.check()
                assert progress.silent_s > 0.0
        finally:
            child.kill()


def all_threads_s(pid):
    """Return the CPU time of all threads of a process; its resolution is 10 ms at best."""
    with open(f"/proc/{pid}/stat") as file:
        fields = file.read().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / 100
