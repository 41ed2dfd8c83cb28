"""The real server process: sizes and broken connections over HTTP, and a home that is taken."""

from __future__ import annotations

import os
import socket
import subprocess
import sys

import pytest

from tests.service.data import DEADLINE, error, eventually, stream, upload
from tests.service.server import free_port


@pytest.mark.parametrize("body", [b"x" * 1_000_000, (b"x" * 10_000 for _ in range(100))], ids=["announced", "chunked"])
def test_uploads_beyond_the_limit_are_answered_before_they_are_read(server, body):
    answer = server.client.post("/v1/datasets", content=body, headers={"content-type": "text/csv"})
    assert "200000 bytes" in error(answer, 413, "too_large")["message"]
    assert list((server.home / "uploads").iterdir()) == []


def test_queries_beyond_the_limit_are_refused(server):
    answer = server.client.post("/v1/models/panda-sim/predict", json={"q": [0.0] * 10_000})
    error(answer, 413, "too_large")


def test_a_client_that_goes_away_leaves_nothing_behind(server):
    head = f"POST /v1/datasets HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\ncontent-type: text/csv\r\n"
    datasets = set((server.home / "datasets").iterdir())
    with socket.create_connection(("127.0.0.1", server.port)) as connection:
        connection.sendall(head.encode() + b"content-length: 100000\r\n\r\nt,q1,dq1,ddq1,tau1\n0,0,0,0,0\n")
        eventually(lambda: list((server.home / "uploads").iterdir()))
    eventually(lambda: not list((server.home / "uploads").iterdir()))
    assert set((server.home / "datasets").iterdir()) == datasets
    assert server.client.get("/health/ready").status_code == 200


def test_a_second_server_on_the_same_home_says_why_it_ends(server):
    ended = subprocess.run(
        [sys.executable, "-m", "service", "serve", "--port", str(free_port())],
        env={**os.environ, "LIPSERVE_HOME": str(server.home)},
        capture_output=True,
        text=True,
        timeout=DEADLINE,
        check=False,
    )
    assert ended.returncode != 0
    assert f"another service uses {server.home}: stop it, or set LIPSERVE_HOME" in ended.stdout + ended.stderr
    assert "Traceback" not in ended.stdout + ended.stderr


def test_data_sets_are_served_over_http(server):
    dataset = upload(server.client, stream(seed=20))
    assert server.client.get(f"/v1/datasets/{dataset['id']}").json() == dataset
    assert server.client.delete(f"/v1/datasets/{dataset['id']}").status_code == 204
