"""Counters and limits of a service with two planes are those of one service, also when a plane is killed."""

import os
import re
import signal
import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families as parse
from websockets.exceptions import InvalidStatus

from service.api.access import keys
from service.foundation.settings import Settings
from service.storage.database import Database
from tests.service.api.access.conftest import bearer
from tests.service.api.oip.requests import message
from tests.service.data import eventually
from tests.service.server import Server, children
from tests.service.streams import frame, open_stream, read_hello, send_frame

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="two planes need Linux")

MODEL = "panda-sim"
MOTION = {"q": [0.1] * 7, "dq": [0.1] * 7, "ddq": [0.5] * 7}
BATCH = {name: [values] * 3 for name, values in MOTION.items()}
PREDICT, INFER, MODELS = f"/v1/models/{MODEL}/predict", f"/v2/models/{MODEL}/infer", "/v1/models"
STREAM = f"/v1/models/{MODEL}/stream"
LIVE, READY = "/health/live", "/health/ready"
"""Paths that the data plane and the control plane answer."""
FRAMES = 20


def two_planes(home: Path, constants: Mapping[str, Any] | None = None, **settings: str) -> Server:
    """Return a service with two planes that has its model in both. constants: as of `Server`."""
    server = Server(home, warm=True, constants=constants, LIPSERVE_DATA_PLANE="on", **settings)
    with httpx.Client(base_url=server.url) as client:
        if "LIPSERVE_KEYS" not in settings:
            eventually(lambda: client.post(PREDICT, json=MOTION).is_success)
            data_plane = ids(server, LIVE)
            eventually(lambda: is_from(data_plane, client.post(PREDICT, json=MOTION)))
    return server


def process_of(server: Server, path: str) -> int:
    """Return the process that answers a path: the control plane is named so, the data plane has started last."""
    names = {pid: Path(f"/proc/{pid}/comm").read_text() for pid in children(server.process.pid)}
    control = next(pid for pid, name in names.items() if "control" in name)
    if path != LIVE:
        return control
    started = map(int, re.findall(r"Started server process \[(\d+)\]", server.log.read_text()))
    return next(pid for pid in reversed([*started]) if pid in names and pid != control)


def ids(server: Server, path: str) -> str:
    """Return what the ids of requests of a process begin with, of the process that answers a path."""
    with httpx.Client(base_url=server.url) as client:
        return client.get(path).headers["x-request-id"].partition("-")[0]


def is_from(plane: str, answer: httpx.Response) -> bool:
    return answer.headers["x-request-id"].partition("-")[0] == plane


def kill(server: Server, path: str) -> None:
    """Kill the process that answers a path, and wait until another has taken its place."""
    pid = process_of(server, path)
    before = ids(server, path)
    os.kill(pid, signal.SIGKILL)

    def is_replaced() -> bool:
        try:
            return ids(server, path) != before and server.client.get(READY).is_success
        except httpx.TransportError:
            return False

    eventually(is_replaced)


def samples(server: Server, name: str) -> dict[tuple[str, ...], float]:
    """Return the samples of a metric by labels, without those of checks of health and metrics."""
    with httpx.Client(base_url=server.url) as client:
        families = list(parse(client.get("/metrics").text))
    found = {tuple(s.labels.values()): s.value for family in families for s in family.samples if s.name == name}
    return {labels: number for labels, number in found.items() if not any("health" in label for label in labels)}


def counted(server: Server) -> dict[tuple[str, str, str], float]:
    found = samples(server, "lipserve_requests_total")
    return {labels: number for labels, number in found.items() if "/metrics" not in labels}


@pytest.fixture(scope="module")
def service(tmp_path_factory) -> Iterator[Server]:
    with two_planes(tmp_path_factory.mktemp("sums") / "home") as server:
        yield server


def send_requests(server: Server, seen: Counter) -> set[bool]:
    """Send requests of each kind; return which planes have answered them: whether it was the data plane."""
    planes, data_plane = set(), ids(server, LIVE)
    with httpx.Client(base_url=server.url, timeout=30.0) as client:
        for number, route, send in (
            (7, "/v1/models/{model}/predict", lambda: client.post(PREDICT, json=MOTION)),
            (3, "/v1/models/{model}/predict", lambda: client.post(PREDICT, json=BATCH)),
            (2, "/v1/models/{model}/predict", lambda: client.post(PREDICT, json={})),
            (5, "/v2/models/{model}/infer", lambda: client.post(INFER, json=message(MOTION))),
            (4, "/v2/models/{model}/infer", lambda: client.post(INFER, json=message(BATCH))),
            (2, "/v1/echo", lambda: client.post("/v1/echo", json=MOTION)),
            (3, "/v1/models", lambda: client.get(MODELS)),
        ):
            for _ in range(number):
                answer = send()
                seen[answer.request.method, route, str(answer.status_code)] += 1
                planes.add(is_from(data_plane, answer))
    with open_stream(server, STREAM) as connection:
        read_hello(connection)
        for sequence in range(FRAMES):
            send_frame(connection, frame(np.reshape([*MOTION.values()], (3, 7)), sequence + 1))
        send_frame(connection, b"short")
    seen["WEBSOCKET", "/v1/models/{model}/stream", "101"] += 1
    return planes


def test_metrics_are_sums_of_both_planes_and_outlive_them(service):
    before, seen = counted(service), Counter()
    inferred = service.client.get(f"/v2/models/{MODEL}/stats").json()["model_stats"][0]["inference_count"]
    seen["GET", "/v2/models/{model}/stats", "200"] += 1
    for path in (LIVE, READY, None):
        assert send_requests(service, seen) == {True, False}
        if path is not None:
            kill(service, path)

    def difference() -> dict[tuple[str, str, str], float]:
        return {labels: number - before.get(labels, 0) for labels, number in counted(service).items()}

    # a stream is counted when it has ended
    eventually(lambda: {labels: number for labels, number in difference().items() if number} == seen)
    after = service.client.get(f"/v2/models/{MODEL}/stats").json()["model_stats"][0]
    assert after["inference_count"] - inferred == 3 * (5 + 4 * 3)
    assert samples(service, "lipserve_stream_frame_duration_seconds_count") == {(MODEL,): 3 * FRAMES}
    assert samples(service, "lipserve_stream_errors_total") == {("invalid_request", MODEL): 3}
    assert sum(samples(service, "lipserve_errors_total").values()) == 3 * 2
    assert samples(service, "lipserve_requests_in_flight") == {(): 1}  # this one
    assert samples(service, "lipserve_streams_open") == {(): 0}


def test_memory_of_each_process_is_shown(service):
    def shown() -> set[str]:
        return {process for (process,) in samples(service, "lipserve_process_memory_bytes")}

    eventually(lambda: {"data plane", "weigher"} <= shown())
    assert samples(service, "lipserve_process_cpu_seconds_total")["data plane",] > 0


@pytest.mark.slow
def test_streams_of_a_killed_plane_free_their_places(tmp_path):
    with two_planes(tmp_path / "home", LIPSERVE_MAX_STREAMS="3") as server:

        def fill() -> None:
            with ExitStack() as stack:
                for _ in range(3):
                    read_hello(stack.enter_context(open_stream(server, STREAM)))
                assert samples(server, "lipserve_streams_open") == {(): 3}
                with pytest.raises(InvalidStatus) as refused, open_stream(server, STREAM):
                    pass
                assert refused.value.response.status_code == 429
                kill(server, LIVE)

        fill()
        with ExitStack() as stack:
            for _ in range(3):
                read_hello(stack.enter_context(open_stream(server, STREAM)))


@pytest.mark.slow
def test_rates_and_last_use_of_keys_are_counted_in_both_planes(tmp_path):
    home = tmp_path / "home"
    database = Database.of(Settings(home=home))
    row, secret = keys.create(database, "own", ["read", "predict"], None, max_requests_per_s=0.01)
    _, other = keys.create(database, "other", ["read", "predict"], None)
    limits = {"LIPSERVE_MAX_REQUESTS_PER_S": "0.01", "LIPSERVE_MAX_REQUEST_BURST": "6"}
    with two_planes(home, LIPSERVE_KEYS="on", **limits) as server, httpx.Client(base_url=server.url) as client:
        for headers, allowed in ((bearer(other), 6), (bearer(secret), 1)):
            answers = []
            for number in range(allowed + 3):
                request = {"method": "GET", "url": MODELS} if number % 2 else {"method": "POST", "url": "/v1/echo"}
                answers.append(client.request(**request, headers=headers | {"content-type": "application/json"}))
            assert [each.status_code for each in answers] == [200] * allowed + [429] * 3
            data_plane = ids(server, LIVE)
            assert {is_from(data_plane, each) for each in answers} == {True, False}
            kill(server, READY)
            assert client.post("/v1/echo", headers=headers).status_code == 429
        server.terminate()
    used = {each.id: each.used_at for each in keys.list_keys(database)}
    database.close()
    assert used[row.id] is not None
