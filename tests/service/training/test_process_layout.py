"""Scheduling of training processes: few threads, all with a lower priority than serving, on their own CPUs."""

import os
from functools import partial
from pathlib import Path

import pytest

from service.foundation.settings import Settings
from service.runtime.process import THREAD_VARIABLES, ProcessOptions, training_cpus, training_process_options
from tests.service.data import ENDLESS, queue, running, stream, upload
from tests.service.server import Server

MANY_THREADS = dict.fromkeys(THREAD_VARIABLES, "4")
"""The environment of a service whose operator asks for many threads, or of a machine with many CPUs."""


def threads(pid):
    """Return the niceness, policy and CPUs of all threads of a process, as the kernel reports them."""
    names = [int(task.name) for task in Path(f"/proc/{pid}/task").iterdir()]
    read_niceness = partial(os.getpriority, os.PRIO_PROCESS)
    return [(read_niceness(each), os.sched_getscheduler(each), os.sched_getaffinity(each)) for each in names]


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="reads /proc")
@pytest.mark.parametrize("policy", ["other", "idle"])
def test_training_process_has_lower_priority_than_its_service(home, policy):
    """No library starts more threads than the limit, and none keeps the usual priority."""
    available = os.sched_getaffinity(0)
    place = {"LIPSERVE_TRAINING_NICENESS": "5", "LIPSERVE_TRAINING_CPUS": "1", "LIPSERVE_TRAINING_POLICY": policy}
    with Server(home, **place, **MANY_THREADS) as server:
        before = threads(server.process.pid)
        name = queue(server.client, "slow", upload(server.client, stream("panda", 200))["id"], options=ENDLESS)["id"]
        running(server.client, name)
        (worker,) = server.workers()
        result = threads(worker)
        expected = os.SCHED_IDLE if policy == "idle" else os.SCHED_OTHER
        assert 1 <= len(result) <= 3  # the main thread, one that waits for the service's end, one for the heartbeat
        assert all(thread == (os.nice(0) + 5, expected, {max(available)}) for thread in result)
        for thread in (*before, *threads(server.process.pid)):  # the service itself is unchanged
            assert thread == (os.nice(0), os.SCHED_OTHER, available)


@pytest.mark.parametrize(
    ("available", "maximum", "expected"),
    [
        ({0, 1, 2, 3}, None, {1, 2, 3}),
        ({0, 1}, None, {1}),
        ({3}, None, {3}),
        ({2, 5, 7}, 1, {7}),
        ({2, 5, 7}, 2, {5, 7}),
        ({2, 5, 7}, 64, {2, 5, 7}),
    ],
)
def test_cpus_of_training(available, maximum, expected):
    assert training_cpus(available, maximum) == expected


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="CPUs cannot be chosen here")
def test_layout_follows_the_settings(monkeypatch, tmp_path):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1, 2})
    monkeypatch.delenv("LIPSERVE_TRAINING_CPUS")  # the tests set these
    place = training_process_options(
        Settings(home=tmp_path, training_threads=3, training_niceness=2, training_policy="idle")
    )
    assert place == ProcessOptions(threads=3, niceness=2, policy="idle", cpus=frozenset({1, 2}))
