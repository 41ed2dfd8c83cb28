"""A service that is told to stop: it says so, finishes what it has begun, and keeps what it has learnt."""

import signal
import subprocess
import sys

import pytest
from sqlalchemy import select

from service.foundation.settings import Settings
from service.storage.database import Database, JobRow, SnapshotRow
from tests.service.data import DEADLINE, ENDLESS, error, eventually, queue, running, stream, upload
from tests.service.limits.serving import Raw, Serving
from tests.service.server import Server
from tests.service.streams import ask, dial, frame, hello

PANDA = "/v1/models/panda-sim/stream"
QUERY = {each: [0.1] * 7 for each in ("q", "dq", "ddq")}
GET = b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n"
HELD = GET.replace(b"/ ", b"/held ", 1)
HOLD = """
import asyncio, sys, uvicorn
from service.telemetry.readiness import StopState
from service.api.server.sockets import serve

async def app(scope, receive, send):
    print("begun", flush=True)
    await asyncio.Event().wait()

config = uvicorn.Config(app, port=0, lifespan="off", timeout_graceful_shutdown=600)
serve(config, None, 0, StopState())
"""
"""A server whose answer never comes."""


def held(serving):
    """A request that is being answered."""
    client = Raw(serving.port)
    client.send(HELD)
    eventually(lambda: serving.app.begun == 1)
    return client


def test_a_server_that_was_told_to_stop_answers_until_its_notice_ends():
    with Serving(notice_s=0.5) as serving:
        assert not serving.stopping.begun
        serving.server.should_exit = True
        eventually(lambda: serving.stopping.begun)
        with Raw(serving.port) as client:
            client.send(GET)
            assert client.answer() == (200, b"hello")
            eventually(serving.stopping.closing.is_set)
            assert client.rest() == b""
        with pytest.raises(ConnectionError):
            eventually(lambda: Raw(serving.port).rest())


def test_answers_that_have_begun_are_finished_and_the_connection_closed():
    with Serving(drain_s=60) as serving, held(serving) as client:
        serving.server.should_exit = True
        eventually(serving.stopping.closing.is_set)
        assert serving.thread.is_alive()
        serving.server.servers[0].get_loop().call_soon_threadsafe(serving.app.go.set)
        assert client.answer() == (200, b"hello")
        assert client.rest() == b""


def test_answers_that_take_too_long_are_given_up():
    with Serving(drain_s=1) as serving, held(serving) as client:
        serving.server.should_exit = True
        assert b"200" not in client.rest()


def test_a_second_signal_ends_what_would_be_waited_for():
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, bufsize=1
    )
    try:
        lines = iter(process.stdout.readline, "")
        port = next(line for line in lines if "running on" in line).split("127.0.0.1:")[1].split()[0]
        with Raw(int(port)) as client:
            client.send(GET)
            assert next(lines) == "begun\n"
            process.terminate()
            assert any("Waiting for connections to close" in line for line in lines)
            process.send_signal(signal.SIGINT)
            assert process.wait(DEADLINE) == -signal.SIGINT
    finally:
        process.kill()
        process.communicate()


def test_a_service_that_was_told_to_stop_says_so_and_answers_until_it_is_told_again(home):
    with Server(home, warm=True, LIPSERVE_STOP_NOTICE_S="3600") as server, dial(server, PANDA) as connection:
        hello(connection)
        server.process.terminate()
        refused = eventually(lambda: (seen := server.client.get("/health/ready")).status_code == 503 and seen)
        assert "stopping" in error(refused, 503, "not_ready")["message"]
        assert server.client.post("/v1/models/panda-sim/predict", json=QUERY).status_code == 200
        ask(connection, frame([[0.0] * 7] * 3))
        assert server.terminate() == -signal.SIGTERM
        assert "Traceback" not in server.log.read_text()


@pytest.mark.slow
def test_a_service_that_stops_keeps_what_it_has_learnt_and_its_jobs(home):
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
