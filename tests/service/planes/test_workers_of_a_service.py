"""Workers of a service of two planes: started by long queries, killed at any time, and never missed."""

import json
import os
import signal
import socket
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

import httpx
import numpy as np
import pytest

from lipcore import load
from tests import ROOT
from tests.service.data import DEADLINE, error, eventually, stream, upload
from tests.service.server import Server, is_running

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform != "linux", reason="workers need Linux")]
PREDICT = "/v1/models/panda-sim/predict"
MOTIONS = np.random.default_rng(1).uniform(-1.0, 1.0, (3, 300, 7))
QUERY = dict(zip(("q", "dq", "ddq"), MOTIONS.tolist(), strict=True)) | {"covariance": True}


@pytest.fixture(scope="module")
def service(tmp_path_factory):
    with Server(tmp_path_factory.mktemp("workers") / "home", LIPSERVE_DATA_PLANE="on") as started:
        yield started


@pytest.fixture(scope="module")
def expected():
    """The answer of lipcore to `QUERY`."""
    return load(ROOT / "models/panda-sim").predict(*MOTIONS, covariance=True)


def predict(service):
    """Return the answer of a new connection."""
    answer = httpx.post(service.url + PREDICT, json=QUERY, timeout=DEADLINE)
    assert answer.status_code == 200, answer.text
    return answer.json()


def worker(service):
    """Return the process id of the only worker."""
    (pid,) = service.named("lip-worker")
    return pid


def test_long_queries_are_computed_by_a_niced_process(service, expected):
    assert service.named("lip-worker") == []
    answer = predict(service)
    for name in ("tau", "tau_std", "covariance"):
        np.testing.assert_allclose(answer[name], getattr(expected, name), rtol=1e-9, atol=1e-12)
    pid = worker(service)
    assert os.getpriority(os.PRIO_PROCESS, pid) > os.getpriority(os.PRIO_PROCESS, service.process.pid)
    assert predict(service) == answer
    assert worker(service) == pid


def test_evaluation_reads_data_sets_in_the_worker(service):
    dataset = upload(service.client, stream("panda", 120, motion="middle"))["id"]
    pid = worker(service)
    assert service.client.post("/v1/models/panda-sim/evaluate", json={"dataset": dataset}).json()["samples"] == 120
    answer = service.client.post("/v1/models/panda-sim/evaluate", json={"dataset": "ds_0"})
    assert error(answer, 404, "not_found")["detail"][0]["value"] == "ds_0"
    assert worker(service) == pid


def test_clients_do_not_notice_that_workers_are_killed(service):
    before = predict(service)
    for _ in range(2):
        with ThreadPoolExecutor(4) as clients:
            answers = [clients.submit(predict, service) for _ in range(8)]
            os.kill(service.named("lip-worker")[0], signal.SIGKILL)
            assert all(each.result() == before for each in answers)


def test_worker_of_a_client_that_disconnects_is_killed(service):
    predict(service)
    for pid in service.named("lip-worker"):
        os.kill(pid, signal.SIGSTOP)  # its answer does not come before the client leaves
    stopped = service.named("lip-worker")
    body = json.dumps(QUERY).encode()
    head = f"POST {PREDICT} HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"

    def leave_without_an_answer():
        with socket.create_connection(("127.0.0.1", service.port), DEADLINE) as client:
            client.sendall(f"{head}Content-Length: {len(body)}\r\n\r\n".encode() + body)
            client.settimeout(0.2)
            with suppress(TimeoutError):
                client.recv(1)

    # no worker is killed for a client that leaves before its query has one
    eventually(lambda: not all(is_running(pid) for pid in stopped) or leave_without_an_answer())
    eventually(lambda: 'status="499"' in service.client.get("/metrics").text)
    for pid in filter(is_running, stopped):
        os.kill(pid, signal.SIGCONT)
    predict(service)


def test_long_queries_are_answered_without_a_nursery(service, expected):
    killed = service.named("lip-nursery") + service.named("lip-worker")
    for pid in killed:
        os.kill(pid, signal.SIGKILL)
    eventually(lambda: not any(is_running(pid) for pid in killed))
    np.testing.assert_allclose(predict(service)["covariance"], expected.covariance, rtol=1e-9, atol=1e-12)
