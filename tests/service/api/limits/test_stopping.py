"""Shutdown: the service reports it, completes what has begun, and keeps what it has learnt."""

import signal
import subprocess
import sys

import pytest
from sqlalchemy import select

from service.foundation.settings import Settings
from service.storage.database import Database, JobRow, SnapshotRow
from tests.service.api.limits.serving import RawConnection, Serving
from tests.service.data import DEADLINE, ENDLESS, error, eventually, queue, running, stream, upload
from tests.service.server import Server
from tests.service.streams import frame, open_stream, read_hello, send_frame

PANDA = "/v1/models/panda-sim/stream"
QUERY = {each: [0.1] * 7 for each in ("q", "dq", "ddq")}
GET = b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n"
HELD = GET.replace(b"/ ", b"/held ", 1)
NEVER_ANSWERING_SERVER = """
import asyncio, sys, uvicorn
from service.telemetry.readiness import StopState
from service.api.server.sockets import serve

async def app(scope, receive, send):
    print("begun", flush=True)
    await asyncio.Event().wait()

config = uvicorn.Config(app, port=0, lifespan="off", timeout_graceful_shutdown=600)
serve(config, None, 0, StopState())
"""
"""A server whose application never answers."""


def begin_request(serving):
    """Send a request that waits for `go`, and return its connection."""
    client = serving.connect(HELD)
    eventually(lambda: serving.app.begun == 1)
    return client


def test_stopping_server_answers_during_its_notice_period():
    with Serving(notice_s=0.5) as serving:
        assert not serving.stopping.begun
        serving.server.should_exit = True
        eventually(lambda: serving.stopping.begun)
        with RawConnection(serving.port) as client:
            assert client.ask(GET) == (200, b"hello")
            eventually(serving.stopping.closing.is_set)
            assert client.read_to_end() == b""
        with pytest.raises(ConnectionError):
            eventually(lambda: RawConnection(serving.port).read_to_end())


def test_begun_answers_are_completed_before_closing():
    with Serving(drain_s=60) as serving, begin_request(serving) as client:
        serving.server.should_exit = True
        eventually(serving.stopping.closing.is_set)
        assert serving.thread.is_alive()
        serving.server.servers[0].get_loop().call_soon_threadsafe(serving.app.go.set)
        assert client.read_answer() == (200, b"hello")
        assert client.read_to_end() == b""


@pytest.mark.slow
def test_answers_that_take_too_long_are_dropped():
    with Serving(drain_s=1) as serving, begin_request(serving) as client:
        serving.server.should_exit = True
        assert b"200" not in client.read_to_end()


def test_second_signal_stops_at_once():
    command, pipe = [sys.executable, "-c", NEVER_ANSWERING_SERVER], subprocess.PIPE
    process = subprocess.Popen(command, stdout=pipe, stderr=subprocess.STDOUT, text=True, bufsize=1)
    try:
        lines = iter(process.stdout.readline, "")
        port = next(line for line in lines if "running on" in line).split("127.0.0.1:")[1].split()[0]
        with RawConnection(int(port)) as client:
            client.send(GET)
            assert next(lines) == "begun\n"
            process.terminate()
            assert any("Waiting for connections to close" in line for line in lines)
            process.send_signal(signal.SIGINT)
            assert process.wait(DEADLINE) == -signal.SIGINT
    finally:
        process.kill()
        process.communicate()


@pytest.mark.slow
def test_stopping_service_says_so_and_answers_until_the_second_signal(home):
    with Server(home, warm=True, LIPSERVE_STOP_NOTICE_S="3600") as server, open_stream(server, PANDA) as connection:
        read_hello(connection)
        server.process.terminate()
        refused = eventually(lambda: (seen := server.client.get("/health/ready")).status_code == 503 and seen)
        assert "stopping" in error(refused, 503, "not_ready")["message"]
        assert server.client.post("/v1/models/panda-sim/predict", json=QUERY).status_code == 200
        send_frame(connection, frame([[0.0] * 7] * 3))
        assert server.terminate() == -signal.SIGTERM
        assert "Traceback" not in server.log.read_text()


@pytest.mark.slow
def test_stopping_service_keeps_learning_results_and_jobs(home):
    with Server(home) as server:
        rows = {each: [[0.1] * 7] * 5 for each in ("q", "dq", "ddq", "tau")}
        body = {"stream_id": "arm", "sequence": 0, "t": [0.0, 0.1, 0.2, 0.3, 0.4], **rows}
        assert server.client.post("/v1/models/panda-sim/observations", json=body).status_code == 200
        eventually(lambda: server.client.post("/v1/models/panda-sim/predict", json=QUERY).json()["revision"] > 0)
        name = queue(server.client, "stopped", upload(server.client, stream("panda", 200))["id"], options=ENDLESS)["id"]
        running(server.client, name)
        assert server.terminate() == -signal.SIGTERM
    database = Database.of(Settings(home=home))
    with database.session() as session:
        row = session.scalars(select(JobRow)).one()
        assert (row.state, row.attempts) == ("queued", 0)
        assert session.scalars(select(SnapshotRow.number)).all() == [1]
    database.close()
