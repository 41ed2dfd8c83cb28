"""The cage that reads files: return values, limits, and what the confined process is not allowed to do."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from unittest.mock import Mock

import pytest

from lipcore.extras import MissingExtraError
from service.foundation.errors import InvalidDataError, NotReadyError, TooLargeError
from service.foundation.settings import Settings
from service.runtime import cage
from service.runtime.cage import MAX_ANSWER_BYTES
from service.runtime.confinement import FORBIDDEN, build_filter, protections

MiB = 1024 * 1024
HERE = "tests.service.runtime.inmates"
memory_is_limited = pytest.mark.skipif(not protections()["memory"], reason="this system does not limit memory")
landlocked = pytest.mark.skipif(not protections()["landlock"], reason="a kernel without Landlock")
filtered = pytest.mark.skipif(not protections()["seccomp"], reason="a system without seccomp, or an unknown processor")


@pytest.fixture(autouse=True)
def _little_processor_time(monkeypatch):
    monkeypatch.setattr(cage, "CPU_SHARE", 1 / 30)


@pytest.fixture
def settings(tmp_path):
    """Limits that a test reaches quickly."""
    limits = {"parser_memory_bytes": 200 * MiB, "parser_s": 30, "max_unpacked_bytes": 10 * MiB}
    return Settings(home=tmp_path, **limits)


def call(name, returns, *given, settings, **options):
    return cage.run(f"{HERE}:{name}", returns, *given, settings=settings, **options)


def failure_message(name, *given, settings, error=InvalidDataError, **options):
    """Return the message of a call that fails."""
    with pytest.raises(error) as caught:
        call(name, object, *given, settings=settings, **options)
    return caught.value.message


def test_value_is_returned_and_its_type_checked(settings, tmp_path):
    given = (2, 0.5, tmp_path)
    assert call("add", dict[str, float | str], *given, settings=settings) == {"sum": 2.5, "path": str(tmp_path)}
    with pytest.raises(InvalidDataError, match="could not be read"):
        cage.run(f"{HERE}:text", int, settings=settings)


def test_answer_above_the_size_limit_is_rejected(settings):
    assert len(call("long_text", str, MAX_ANSWER_BYTES - 100, settings=settings)) == MAX_ANSWER_BYTES - 100
    assert "could not be read" in failure_message("long_text", MAX_ANSWER_BYTES, settings=settings)


def test_errors_of_readers_are_passed_on_unchanged(settings):
    with pytest.raises(InvalidDataError) as caught:
        call("raise_reader_error", object, "data", settings=settings)
    (item,) = caught.value.detail
    assert (item.field, item.value, item.expected) == ("q1, row 3", "x", "a number")
    assert failure_message("raise_reader_error", "size", settings=settings, error=TooLargeError) == "too large"


def test_bug_in_a_reader_is_reported_with_its_traceback(settings, capfd):
    with pytest.raises(cage.UnexpectedReaderError, match="in raise_key_error") as caught:
        call("raise_key_error", object, settings=settings)
    assert "KeyError: 'a bug'" in str(caught.value)
    assert "noise" not in capfd.readouterr().err


@pytest.mark.parametrize(
    ("name", "limits", "parts"),
    [
        ("crash", {}, ("The upload could not be read", "SIGSEGV")),
        ("exit_at_once", {}, ("The upload could not be read", "exit code 3")),
        ("sleep", {"parser_s": 0.2}, ("more than 0.2 s of time", "LIPSERVE_PARSER_S")),
        ("close_all_and_sleep", {"parser_s": 0.2}, ("more than 0.2 s of time", "LIPSERVE_PARSER_S")),
    ],
)
def test_reader_that_crashes_or_hangs_is_reported(settings, name, limits, parts):
    message = failure_message(name, settings=settings.model_copy(update=limits), field="urdf")
    assert [part for part in parts if part not in message] == []
    assert call("write_output", int, 0, settings=settings) == 7


@memory_is_limited
def test_memory_is_limited(settings):
    assert call("allocate", int, 100 * MiB, settings=settings) == 100 * MiB
    message = failure_message("allocate", 300 * MiB, settings=settings)
    assert f"more than {200 * MiB} bytes of memory" in message
    assert "LIPSERVE_PARSER_MEMORY_BYTES" in message


def test_file_size_and_count_are_limited(settings, tmp_path):
    call("write", type(None), tmp_path, 10 * MiB, settings=settings, folder=tmp_path)
    message = failure_message("write", tmp_path, 11 * MiB, settings=settings, folder=tmp_path, error=TooLargeError)
    assert "LIPSERVE_MAX_UNPACKED_BYTES" in message
    assert "open files" in failure_message("open_files", tmp_path / "large", settings=settings)


@pytest.mark.slow
def test_cpu_time_is_limited_while_others_are_read(settings):
    with ThreadPoolExecutor() as pool:
        long = pool.submit(failure_message, "spin", settings=settings)
        several = pool.map(lambda _: call("write_output", int, 0, settings=settings), range(8))
        assert list(several) == [7] * 8
        message = long.result()
    assert "more than 1 s of processor time" in message
    assert "LIPSERVE_PARSER_S" in message


def test_reader_sees_no_environment_or_files_of_the_service(settings, monkeypatch):
    monkeypatch.setenv("LIPSERVE_DATABASE_URL", "postgresql://secret")
    seen = call("environment", str, settings=settings.model_copy(update={"database_url": "postgresql://secret"}))
    assert "LANG" in seen
    assert "secret" not in seen
    with open(os.devnull), open(os.devnull):
        numbers = call("open_descriptors", list[int], settings=settings)
    assert numbers[:3] == [0, 1, 2]
    assert len(numbers) == 4  # the fourth is for the reader's answer


@filtered
@pytest.mark.parametrize(
    "action",
    ["socket", "fork", "exec", "spawn", "kill", "kill all", "priority", "limit of another", "more processor time"],
)
def test_reader_has_no_network_and_no_other_process(settings, tmp_path, action):
    result = call("attempt", str, action, str(tmp_path), os.getpid(), settings=settings)
    assert result in ("PermissionError", "ValueError")
    assert call("count_threads", int, settings=settings) == 1


@landlocked
@pytest.mark.parametrize("action", ["read", "write", "list", "link", "symbolic link", "memory"])
def test_reader_opens_only_the_files_it_is_given(settings, tmp_path, action):
    secret, folder = tmp_path / "home" / "secret", tmp_path / "folder"
    secret.parent.mkdir()
    folder.mkdir()
    secret.write_text("key")
    result = call("attempt", str, action, str(secret), os.getpid(), settings=settings, folder=folder)
    assert result == ("OSError" if action == "link" else "PermissionError")
    assert secret.read_text() == "key"


def test_call_fails_if_no_process_can_be_started(settings, monkeypatch):
    start = Mock(side_effect=BlockingIOError(11, "Resource temporarily unavailable"))
    monkeypatch.setattr(cage, "_context", lambda: Mock(Process=lambda **_: Mock(start=start)))
    assert "uploads cannot be read at present" in failure_message("text", settings=settings, error=NotReadyError)


def test_missing_extra_is_named(settings):
    answer = cage.Answer(error="extra", detail=[("ingest", "pyarrow", "")])
    error = cage._error(answer, "reader", "file", settings)
    assert isinstance(error, MissingExtraError)
    assert "lipserve[ingest]" in str(error)


@pytest.mark.parametrize(("machine", "place"), [(0xC000003E, 0), (0xC00000B7, 1)])
def test_filter_decides_each_system_call_as_its_tables_do(machine, place):
    """Interpret the filter program for each listed system call and for some that are not listed."""
    program = build_filter(machine, place)

    def answer(number, first=0, seen=machine):
        at = accumulator = 0
        while True:
            code, yes, no, k = program[at]
            if code == 0x20:
                accumulator = {0: number, 4: seen, 16: first}[k]
            elif code == 0x06:
                return {0x7FFF0000: "allow", 0x80000000: "kill"}.get(k, f"error {k & 0xFFFF}")
            else:
                true = {0x15: accumulator == k, 0x35: accumulator >= k, 0x45: bool(accumulator & k)}[code]
                at += yes if true else no
            at += 1

    for numbers in FORBIDDEN.values():
        if numbers[place] is not None:
            assert answer(numbers[place]) == "error 1"
    clone = (56, 220)[place]
    assert [answer(clone, flags) for flags in (0x10000 | 0x100, 17)] == ["allow", "error 1"]
    assert answer(435) == "error 38"
    assert answer(0) == answer((9, 222)[place]) == "allow"
    assert answer(0x40000000 + 41) == "error 1"
    assert answer(0, seen=0x40000003) == "kill"


DECODE_IN_THREADS = """
import sys, threading
from importlib import import_module

sys.setswitchinterval(1e-6)  # s, between two threads
module, _, name = sys.argv[1].partition(":")
make, encode = getattr(import_module(module), name), import_module(sys.argv[2]).encode
for _ in range(1000):
    exec(sys.argv[3])
    barrier = threading.Barrier(4)

    def decode():
        barrier.wait()
        assert make(Outer).decode(encode(Outer(1, Inner("x")))).inner.text == "x"

    threads = [threading.Thread(target=decode) for _ in range(4)]
    [thread.start() for thread in threads]
    [thread.join() for thread in threads]
print("done")
"""
TYPES = """
from __future__ import annotations
import msgspec

class Inner(msgspec.Struct):
    text: str
    names: list[tuple[str, str | None, str]] = []

class Outer(msgspec.Struct):
    number: int
    inner: Inner | None = None
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("maker", "encoder"),
    [("service.runtime.cage:_decoder", "msgspec.msgpack"), ("lipserve.call:decoder", "msgspec.json")],
)
def test_threads_can_build_a_decoder_at_the_same_time(maker, encoder):
    """msgspec builds type information in steps and without a lock: a second thread crashes the process (SIGSEGV)."""
    command = [sys.executable, "-c", DECODE_IN_THREADS, maker, encoder, TYPES]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (0, "done\n"), done.stderr
