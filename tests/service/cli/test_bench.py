"""`lipserve bench latency` against a service that runs."""

import json

from typer.testing import CliRunner

from service.cli.answers import bench_app as app
from tests.service.conftest import Streaming


def test_latency_is_timed_over_stream_and_http(streaming: Streaming):
    arguments = ["latency", "pendulum", "--queries", "30", "--url", streaming.server.url, "--json"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output or result.exception
    said = json.loads(result.stdout)
    assert said["model"] == "pendulum"
    for figures in said["milliseconds"].values():
        assert 0 < figures["p50"] <= figures["p99"] <= figures["largest"]
    assert set(said["milliseconds"]) == {"stream", "HTTP"}
