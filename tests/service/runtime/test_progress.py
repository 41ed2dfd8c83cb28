"""Whether a process gets on: by its steps and the CPU time of its main thread, not by its being there."""

import subprocess
import sys
from math import inf

import pytest

from service.runtime.progress import LOOK_S, Progress, main_thread_s
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
"""Waits for ever, though another thread of it is busy."""


class Process:
    """Time that the test moves, CPU time of one process, and the watch over it: 10 s quiet, 100 s a step."""

    def __init__(self):
        self.now, self.spent = 0.0, 0.0
        self.progress = Progress(lambda: (1,), 10.0, 100.0, lambda pid: self.spent, lambda: self.now)

    def looks(self, seconds, busy=False):
        """Look each second for so long; the last answer."""
        answer = None
        for _ in range(round(seconds)):
            self.now += 1.0
            self.spent = None if self.spent is None else self.spent + (0.02 if busy else 0.0)
            answer = self.progress.look()
        return answer


def test_one_that_neither_steps_nor_computes_hangs():
    process = Process()
    assert process.looks(9) is None
    process.progress.step()
    assert process.looks(9) is None
    assert process.progress.silent_s == 9.0
    assert process.looks(1) == "it has not got on for 10 s"


def test_one_that_computes_may_take_long_but_not_for_ever():
    process = Process()
    assert process.looks(99, busy=True) is None
    assert process.progress.silent_s == 0.0
    assert process.looks(1, busy=True) == "one step of it has taken 100 s"


def test_where_the_system_does_not_tell_of_cpu_time_only_steps_count():
    process = Process()
    process.spent = None
    assert process.looks(99) is None
    assert process.looks(1) == "one step of it has taken 100 s"


def test_time_in_which_nobody_could_look_does_not_count():
    process = Process()
    process.looks(1)
    process.now += 1000.0  # the machine slept, or who looks was suspended too
    assert process.progress.look() is None
    assert process.progress.silent_s <= 2 * LOOK_S + 1.0


@pytest.mark.skipif(main_thread_s(1) is None, reason="the system does not tell")
@pytest.mark.parametrize("source", [BUSY, WAITING], ids=["computes", "waits"])
def test_only_the_main_thread_of_a_process_counts(source):
    with subprocess.Popen([sys.executable, "-c", source], stdout=subprocess.PIPE) as child:
        try:
            if source is WAITING:
                child.stdout.readline()
            now = iter(range(10**9))
            progress = Progress(lambda: (child.pid,), inf, inf, clock=lambda: float(next(now)))
            if source is BUSY:
                progress.look()
                progress.silent_s = 5.0
                eventually(lambda: progress.look() is None and progress.silent_s == 0.0)
            else:
                everything = eventually(lambda: (spent := all_threads_s(child.pid)) > 0.1 and spent)
                progress.look()
                eventually(lambda: all_threads_s(child.pid) > everything + 0.1)
                progress.look()
                assert progress.silent_s > 0.0
        finally:
            child.kill()


def all_threads_s(pid):
    """CPU time of all threads of a process, in hundredths at the finest."""
    with open(f"/proc/{pid}/stat") as file:
        fields = file.read().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / 100
