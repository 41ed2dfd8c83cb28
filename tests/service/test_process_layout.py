"""Where training processes stand on the machine: few threads, all of them behind serving, on their own CPUs."""

from __future__ import annotations

import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import pytest

from service.compute.process import THREAD_VARIABLES, Place, start_process, training_cpus, training_place
from service.foundation.settings import Settings
from tests.service.data import ENDLESS, queue, running, stream, upload
from tests.service.server import Server

MANY = dict.fromkeys(THREAD_VARIABLES, "4")
"""The environment of a service whose operator wants many threads, or of a machine with many CPUs."""
linux = pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="reads /proc")


@dataclass(frozen=True)
class Thread:
    """A thread as the kernel sees it."""

    niceness: int
    policy: int
    cpus: frozenset[int]


def threads(pid):
    """All threads of a process."""
    found = []
    for task in Path(f"/proc/{pid}/task").iterdir():
        fields = (task / "stat").read_text().rpartition(")")[2].split()  # from the third on: see proc(5)
        found.append(Thread(int(fields[16]), int(fields[38]), frozenset(os.sched_getaffinity(int(task.name)))))
    return found


def threads_after_linear_algebra():
    """Of this process, once all libraries that start threads have had a reason to."""
    import numpy as np
    import scipy.linalg
    import torch

    import lipcore  # noqa: F401

    square = np.random.default_rng(0).normal(size=(400, 400))
    scipy.linalg.cholesky(square @ square.T + np.eye(400))
    torch.from_numpy(square).matmul(torch.from_numpy(square)).sum()
    return threads(os.getpid()), torch.get_num_threads()


def probe(place):
    """What a pool's process at `place` says of its threads."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, context, start_process, (place,)) as pool:
        return pool.submit(threads_after_linear_algebra).result()


@pytest.mark.slow
@linux
@pytest.mark.parametrize("policy", ["other", "idle"])
def test_no_library_starts_more_threads_than_the_place_has(monkeypatch, policy):
    """Nor is one left at the usual priority: threads keep what was set before they were started."""
    for name, value in MANY.items():
        monkeypatch.setenv(name, value)
    cpus = frozenset({max(os.sched_getaffinity(0))})
    found, of_torch = probe(Place(threads=1, niceness=7, policy=policy, cpus=cpus))
    assert of_torch == 1
    assert len(found) <= 2  # the main one, and the one that waits for the parent's end
    expected = os.SCHED_IDLE if policy == "idle" else os.SCHED_OTHER
    assert set(found) == {Thread(os.nice(0) + 7, expected, cpus)}


@pytest.mark.slow
@linux
def test_a_place_of_its_own_accord_leaves_priority_and_cpus_as_they_are():
    found, of_torch = probe(Place(threads=2))
    assert of_torch == 2
    assert set(found) == {Thread(os.nice(0), os.SCHED_OTHER, frozenset(os.sched_getaffinity(0)))}


@pytest.mark.slow
@linux
def test_a_training_process_stands_behind_the_service_that_started_it(home):
    available = os.sched_getaffinity(0)
    with Server(home, LIPSERVE_TRAINING_NICENESS="5", LIPSERVE_TRAINING_CPUS="1", **MANY) as server:
        before = threads(server.process.pid)
        name = queue(server.client, "slow", upload(server.client, stream("panda", 200))["id"], options=ENDLESS)["id"]
        running(server.client, name)
        (worker,) = server.workers()
        found = threads(worker)
        assert set(found) == {Thread(os.nice(0) + 5, os.SCHED_OTHER, frozenset({max(available)}))}
        assert len(found) <= 3  # the main one, one that waits for the service's end, one that gives signs of life
        for thread in (*before, *threads(server.process.pid)):  # serving itself is as it was
            assert (thread.niceness, thread.policy, thread.cpus) == (os.nice(0), os.SCHED_OTHER, frozenset(available))


@pytest.mark.parametrize(
    ("available", "most", "expected"),
    [
        ({0, 1, 2, 3}, None, {1, 2, 3}),
        ({0, 1}, None, {1}),
        ({3}, None, {3}),
        ({2, 5, 7}, 1, {7}),
        ({2, 5, 7}, 2, {5, 7}),
        ({2, 5, 7}, 64, {2, 5, 7}),
    ],
)
def test_cpus_of_training(available, most, expected):
    assert training_cpus(available, most) == expected


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="CPUs cannot be chosen here")
def test_a_place_follows_the_settings(monkeypatch, tmp_path):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1, 2})
    monkeypatch.delenv("LIPSERVE_TRAINING_CPUS")  # which tests set
    place = training_place(Settings(home=tmp_path, training_threads=3, training_niceness=2, training_policy="idle"))
    assert place == Place(threads=3, niceness=2, policy="idle", cpus=frozenset({1, 2}))


@pytest.mark.slow
@linux
def test_a_machine_that_forbids_a_place_trains_all_the_same():
    found, _ = probe(Place(threads=1, niceness=3, cpus=frozenset({100_000})))
    assert {(thread.niceness, thread.policy) for thread in found} == {(os.nice(0) + 3, os.SCHED_OTHER)}
