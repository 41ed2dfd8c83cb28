"""Log lines for people and as JSON: they name ids, stay on one line, and reveal no key."""

import json
import logging
import multiprocessing
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor

import pytest

from service.runtime.process import ProcessOptions, start_process
from service.telemetry import logs
from service.telemetry.logs import LogOptions, job_id, request_id


def record(message="said %s", *args, **more):
    return logging.getLogger("service.x").makeRecord(
        "service.x", logging.WARNING, __file__, 1, message, args, more.pop("failure", None), extra=more
    )


def as_json(entry):
    text = logs._formatter("json").format(entry)
    assert "\n" not in text
    return json.loads(text)


@pytest.fixture
def ids():
    tokens = request_id.set("req-1"), job_id.set("job_1")
    yield
    request_id.reset(tokens[0])
    job_id.reset(tokens[1])


def test_json_line_is_an_object():
    line = as_json(record("Größe %s", "αβ ☃"))
    assert line["event"] == "Größe αβ ☃"
    assert not {"request_id", "job", "trace_id"} & set(line)  # outside of requests


def test_lines_name_the_same_fields(ids):
    entry = record("said %s", "so", fields={"status": 200})
    line = as_json(entry)
    assert line.pop("timestamp").endswith("Z")
    named = {"event": "said so", "level": "warning", "logger": "service.x"}
    assert line == named | {"status": 200, "request_id": "req-1", "job": "job_1"}
    text = logs._formatter("console").format(entry)
    parts = ("warning", "said so", "service.x", "status=200", "request_id=req-1", "job=job_1")
    assert [part for part in parts if part not in text] == []
    assert text.isprintable()


FORMS = pytest.mark.parametrize("form", ["json", "console"])


@FORMS
@pytest.mark.parametrize(
    "text", ["a\nlevel=error forged", "a\r\nb", "a\x1b[2Jb", "a\u202eb", "a\u2028b", "a\x9bb", "a\0b"]
)
def test_client_text_stays_on_its_line(form, text):
    assert logs._formatter(form).format(record("%s", text, fields={"path": text})).isprintable()


@FORMS
def test_traceback_is_complete_and_escaped(form):
    try:
        raise ValueError("sent: \x1b[2J")
    except ValueError:
        line = logs._formatter(form).format(record("failed", failure=sys.exc_info()))
    assert ("test_traceback_is_complete" in line, "ValueError" in line, "\x1b" in line) == (True, True, False)


CONFIGURED = """
import json, logging, warnings
from service.telemetry import logs
logs.configure(logs.LogOptions("debug", "json"))
logs.configure(logs.LogOptions("debug", "json"))
logging.getLogger("service.a").debug("ours")
logging.getLogger("uvicorn.error").info("theirs")
for name in ("uvicorn.error", "websockets.server", "httpx", "sqlalchemy.engine", "alembic.runtime.plugins"):
    logging.getLogger(name).debug("Authorization: Bearer lip_secret")
try:
    raise ValueError
except ValueError:
    logging.getLogger("uvicorn.error").error("Exception in ASGI application\\n", exc_info=True)
theirs = logging.getLogger("uvicorn.error")
theirs.info('%s - "WebSocket %s" [accepted]', "127.0.0.1:1", "/v1/models/m/stream?stream_id=private")
theirs.info("connection open")
warnings.warn("careful")
assert logging.getLogger("uvicorn.error").level > 5, "uvicorn would trace"
"""


def test_each_process_logs_once_and_no_headers():
    done = subprocess.run([sys.executable, "-c", CONFIGURED], capture_output=True, text=True, check=True)
    lines = [json.loads(line) for line in done.stderr.splitlines()]
    assert [line["logger"] for line in lines] == ["service.a", "uvicorn.error", "py.warnings"]
    assert [line["event"] for line in lines[:2]] == ["ours", "theirs"]
    assert done.stdout == ""


def _options():
    return logs.current_options(), logging.getLogger("service").level


def test_child_processes_log_as_their_parent():
    options = LogOptions("error", "json")
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, context, start_process, (ProcessOptions(threads=1, log=options),)) as pool:
        assert pool.submit(_options).result() == (options, logging.ERROR)
