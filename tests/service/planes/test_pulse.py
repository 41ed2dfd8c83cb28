"""Heartbeats of the planes: which silence means that a process hangs."""

import os
import subprocess
import sys

import pytest

from service.planes.pulse import MAX_STARVED_S, RESTART_WARNING_S, Plane, Pulse, Watch, cpu_s, is_runnable
from tests.service.data import eventually

linux = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
MAX_S = 0.5


class Clock:
    """A clock that a test sets."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def pulse(clock):
    return Pulse(clock)


@pytest.fixture
def watch(pulse, clock):
    return Watch(pulse, Plane.DATA, MAX_S, clock)


def look(watch, clock, seconds, step=0.1):
    """Look every `step` seconds for some seconds; return the last result."""
    result = None
    for _ in range(round(seconds / step)):
        clock.now += step
        result = watch.silent()
    return result


def test_planes_have_beats_and_restarts_of_their_own(pulse):
    pulse.beat(Plane.DATA)
    pulse.beat(Plane.DATA)
    pulse.record_restart(Plane.CONTROL)
    assert (pulse.last_beat(Plane.DATA), pulse.last_beat(Plane.CONTROL)) == ((os.getpid(), 2), (0, 0))
    assert (pulse.restarts(Plane.DATA)[0], pulse.restarts(Plane.CONTROL)[0]) == (0, 1)


@linux
def test_beats_of_a_forked_process_are_seen(pulse):
    pid = os.fork()
    if not pid:
        pulse.beat(Plane.DATA)
        os._exit(0)
    os.waitpid(pid, 0)
    assert pulse.last_beat(Plane.DATA) == (pid, 1)


@pytest.fixture
def sleeper():
    command = [sys.executable, "-c", "import sys; print(flush=True); sys.stdin.read()"]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    process.stdout.readline()  # during its start it waits for files, too
    eventually(lambda: not is_runnable(process.pid))
    yield process.pid
    process.kill()
    process.communicate()


def beat_as(pulse, monkeypatch, pid):
    """Record a beat of another process."""
    with monkeypatch.context() as patch:
        patch.setattr(os, "getpid", lambda: pid)
        pulse.beat(Plane.DATA)


@linux
def test_silent_process_that_sleeps_hangs(pulse, watch, clock, monkeypatch, sleeper):
    beat_as(pulse, monkeypatch, sleeper)
    assert look(watch, clock, MAX_S) is None
    found = look(watch, clock, 0.2)
    assert found is not None
    assert (found[0], found[1] > MAX_S) == (sleeper, True)


def test_beating_process_does_not_hang(pulse, watch, clock):
    for _ in range(20):
        pulse.beat(Plane.DATA)
        assert look(watch, clock, 0.4) is None


def test_nothing_hangs_before_the_first_beat(watch, clock):
    assert look(watch, clock, 10.0) is None


@linux
def test_gap_of_the_watching_process_does_not_count(pulse, watch, clock, monkeypatch, sleeper):
    """If all processes of a group were stopped, the first one to continue must not kill the others."""
    beat_as(pulse, monkeypatch, sleeper)
    assert look(watch, clock, 0.4) is None
    assert look(watch, clock, 60.0, step=60.0) is None
    assert look(watch, clock, 0.4) is None
    assert look(watch, clock, 0.2) is not None


@pytest.mark.parametrize(
    ("runnable", "share", "hangs"),
    [(True, 0.0, False), (True, 1.0, True), (False, 0.0, True)],
    ids=["starved", "spinning", "sleeping"],
)
def test_process_without_a_processor_is_not_replaced(monkeypatch, pulse, watch, clock, runnable, share, hangs):
    monkeypatch.setattr("service.planes.pulse.cpu_s", lambda _: share * clock.now)
    monkeypatch.setattr("service.planes.pulse.is_runnable", lambda _: runnable)
    pulse.beat(Plane.DATA)
    assert (look(watch, clock, 2 * MAX_S) is not None) == hangs
    assert look(watch, clock, MAX_STARVED_S) is not None  # in the end it is


@linux
def test_state_and_time_of_processes_are_those_of_the_kernel(sleeper):
    assert is_runnable(os.getpid())
    own, times = cpu_s(os.getpid()), os.times()
    assert own == pytest.approx(times.user + times.system, abs=0.1)


def test_restarts_are_a_warning_for_some_time(pulse, clock):
    assert pulse.check(None)[0] == "ok"
    pulse.record_restart(Plane.DATA)
    clock.now += 3
    pulse.record_restart(Plane.DATA)
    clock.now += 2
    assert pulse.check(None) == ("warning", "the data plane was restarted 2 times, the last time 2 s ago")
    clock.now += RESTART_WARNING_S
    assert pulse.check(None)[0] == "ok"
