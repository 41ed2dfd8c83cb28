"""A service of two planes while each of its processes is killed or hangs, and when it stops."""

import os
import signal
import sys

import httpx
import pytest

from service.runtime.process import THREAD_VARIABLES
from tests.service.data import DEADLINE, eventually, stream, upload
from tests.service.server import Server, command, descendants, is_running

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform != "linux", reason="planes need Linux")]
QUERY = {each: [0.1] * 7 for each in ("q", "dq", "ddq")}
PREDICT = "/v1/models/panda-sim/predict"
PROCESSES = "lip-control", "lip-data", "lip-spare", "lip-nursery", "lip-weigher"
MANY_THREADS = dict.fromkeys(THREAD_VARIABLES, "4")
"""The environment of a machine with many CPUs: the service forks all the same."""


@pytest.fixture
def service(home):
    with Server(home, LIPSERVE_DATA_PLANE="on", **MANY_THREADS) as started:
        eventually(lambda: all(started.named(each) for each in PROCESSES))
        yield started


def predict(service):
    """Return the answer of a new connection."""
    answer = httpx.post(service.url + PREDICT, json=QUERY, timeout=DEADLINE)
    assert answer.status_code == 200, answer.text
    return answer.json()


def checks(service):
    """Return the parts of readiness, by name."""
    answer = service.client.get("/health/ready")
    return {each["name"]: each for each in answer.json()["checks"]} if answer.status_code == 200 else {}


def test_killed_processes_come_back(service):
    before = predict(service)
    for each in ("lip-control", "lip-data", "lip-spare", "lip-weigher"):
        (pid,) = service.named(each)
        os.kill(pid, signal.SIGKILL)
        assert predict(service) == before
        eventually(lambda each=each, pid=pid: all(service.named(name) for name in PROCESSES) and not is_running(pid))
    eventually(lambda: checks(service).get("planes", {}).get("state") == "warning")
    assert "the control plane was restarted once" in checks(service)["planes"]["message"]
    assert "Traceback" not in service.log.read_text()


def test_weigher_starts_without_a_nursery(service):
    (nursery,), (weigher,) = service.named("lip-nursery"), service.named("lip-weigher")
    os.kill(nursery, signal.SIGKILL)
    eventually(lambda: service.started() and not is_running(weigher))
    assert "is started as a new interpreter" in service.log.read_text()


def test_control_loops_are_answered_while_the_control_plane_hangs(service):
    before = predict(service)
    (control,) = service.named("lip-control")
    os.kill(control, signal.SIGSTOP)
    try:
        assert predict(service) == before
        assert httpx.get(f"{service.url}/health/live", timeout=DEADLINE).status_code == 200
        with pytest.raises(httpx.ReadTimeout):  # it must be seen that the control plane hangs
            httpx.get(f"{service.url}/health/ready", timeout=1.0)
    finally:
        os.kill(control, signal.SIGCONT)
    eventually(lambda: checks(service))
    assert service.named("lip-control") == [control]


def test_hanging_data_plane_is_replaced_by_its_spare(service):
    before = predict(service)
    (data,), (spare,) = service.named("lip-data"), service.named("lip-spare")
    os.kill(data, signal.SIGSTOP)
    assert predict(service) == before
    assert service.named("lip-data") == [spare]
    assert not is_running(data)


def test_killed_service_leaves_no_process(service):
    started = descendants(service.process.pid)
    service.kill()
    eventually(lambda: not any(map(is_running, started)))


def test_readers_of_uploads_inherit_no_model(service):
    """Their fork server is a program of its own: it is no fork of a process that has models in memory."""
    upload(service.client, stream())
    (server,) = (pid for pid in descendants(service.process.pid) if "forkserver" in command(pid))
    assert "service serve" not in command(server)
