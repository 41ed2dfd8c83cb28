"""Each process of a service is killed and stopped under load: answers go on, and nothing acknowledged is lost."""

import os
import signal
import sys
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from lipcore.online.batch import Placement
from service.cli.verify import verify_home
from service.foundation.settings import Settings
from service.journal import log
from tests.service.data import eventually
from tests.service.server import Server, children
from tests.service.streams import logged_batches, saved_model
from tests.system.faults.harness import SETTINGS, populate_home
from tests.system.planes.load import PANDA, ROWS, Load, motion

OPTIONS = {f"LIPSERVE_{name}": value for name, value in SETTINGS.items()} | {"LIPSERVE_DATA_PLANE": "on"}
LOOPS = ("stream", "predict")
"""Clients of the data plane."""
PLANES = {"data", "spare", "control"}
LEARNING = ("learner", "weigher", "nursery")
"""Processes of the control plane; the last one starts the others."""
FAULTS = [
    pytest.param(name, number, id=f"{name} {number.name}")
    for name in ("data", "spare", *LEARNING, "control")
    for number in (signal.SIGSTOP, signal.SIGKILL)
]


def descendants(pid: int) -> list[int]:
    """Return the ids of all processes of a service."""
    return [each for child in children(pid) for each in (child, *descendants(child))]


def named(server: Server) -> dict[str, int]:
    """Return the ids of the processes of a service by their names."""
    found = {"supervisor": server.process.pid}
    for pid in descendants(server.process.pid):
        with suppress(OSError):
            found[Path(f"/proc/{pid}/comm").read_text().strip().removeprefix("lip-")] = pid
    return found


@pytest.fixture(scope="module")
def service(tmp_path_factory):
    """A service with two planes and the load of all clients."""
    home = tmp_path_factory.mktemp("killed") / "home"
    populate_home(home)
    with Server(home, **OPTIONS) as server, Load(server.port, saved_model(server, PANDA, 1)) as load:
        eventually(lambda: {"data", "spare", "control", "nursery", "learner", "weigher"} <= named(server).keys(), 60)
        yield server, load


def report(load: Load, what: str, since: float) -> None:
    """Print the gaps and errors of all clients."""
    for kind, client in load.clients.items():
        errors = Counter(text[:60] for at, text in client.errors if at >= since)
        gap = 1e3 * client.largest_gap(since)
        sys.stdout.write(f"{what:18} {kind:13} largest gap {gap:7.1f} ms {dict(errors) or ''}\n")


@pytest.mark.parametrize(("name", "number"), FAULTS)
def test_answers_go_on_without_a_process(service, name, number):
    server, load = service
    before, began = named(server), time.monotonic()
    os.kill(before[name], number)
    load.wait_for(100, *LOOPS)
    if number == signal.SIGSTOP:
        load.wait_for(100, *LOOPS)
        with suppress(ProcessLookupError):  # the supervisor may have killed it
            os.kill(before[name], signal.SIGCONT)
    load.wait_for(20)
    eventually(lambda: named(server).keys() >= PLANES, 60)
    revision = load.revision
    eventually(lambda: load.revision > revision, 60)
    report(load, f"{name} {number.name}", began)
    errors = [text for kind in LOOPS for at, text in load.clients[kind].errors if at >= began]
    assert errors == [] or name == "data"


def test_answers_go_on_while_the_supervisor_is_stopped(service):
    server, load = service
    before, began = named(server), time.monotonic()
    os.kill(server.process.pid, signal.SIGSTOP)
    load.wait_for(200, *LOOPS)
    load.wait_for(20)
    os.kill(server.process.pid, signal.SIGCONT)
    load.wait_for(20)
    report(load, "supervisor SIGSTOP", began)
    assert named(server) == before


def test_nothing_outlives_the_supervisor_and_nothing_acknowledged_is_lost(service):
    server, load = service
    processes = named(server)
    server.kill()
    eventually(lambda: not any(Path(f"/proc/{pid}").exists() for pid in processes.values()), 10)
    with Server(server.home, port=server.port, **OPTIONS) as again:
        load.wait_for(50)
        load.__exit__()
        assert [client.wrong for client in load.clients.values()] == [[], [], [], []]
        check_log(again, load)
        assert again.terminate() == -signal.SIGTERM
    assert verify_home(Settings(home=server.home)).damages == []


def check_log(server: Server, load: Load) -> None:
    """Check that the log has each acknowledged row once, and no other rows than those sent."""
    batches = logged_batches(server, "robot-1")
    sequences = [event.last_sequence for event in batches]
    assert sequences == sorted(set(sequences))
    assert load.acknowledged <= set(sequences)
    assert len(load.acknowledged) > 20
    for event in batches:
        sent = np.array([motion(ROWS * event.last_sequence + row, 2) for row in range(ROWS)])
        np.testing.assert_array_equal(log.decode(event.payload).q, sent[:, 0])
    frames = []
    for event in logged_batches(server, "arm-1"):
        ranges = Placement.from_json(event.report or {}).frames
        new = [number for first, last in ranges for number in range(first, last + 1)]
        np.testing.assert_array_equal(log.decode(event.payload).tau, [motion(number, 2)[3] for number in new])
        frames += new
    assert frames == sorted(set(frames))
    assert load.learnt <= set(frames)
    assert len(load.learnt) > 20
    counts = f"{len(load.learnt)} frames learnt, {len(load.refused)} refused, {len(load.acknowledged)} batches"
    sys.stdout.write(f"{counts}\n")
