"""A function called in a cage: what it returns, what it may take, and what it cannot do."""

import logging
import os
import signal
import socket
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from lipcore.extras import MissingExtraError
from service.foundation.errors import InvalidDataError, NotReadyError, TooLargeError
from service.foundation.settings import Settings
from service.runtime import cage
from service.runtime.cage import start
from service.runtime.confinement import FORBIDDEN_CALLS, SELF_ONLY_CALLS, build_filter, protections
from service.runtime.reader_messages import MAX_ANSWER_BYTES, MAX_OUTPUT_BYTES, Failure
from tests.service.data import eventually
from tests.service.server import children

MiB = 1024 * 1024
HERE = "tests.service.runtime.inmates"
memory_is_limited = pytest.mark.skipif(not protections()["memory"], reason="this system does not limit memory")
landlocked = pytest.mark.skipif(not protections()["landlock"], reason="a kernel without Landlock")
filtered = pytest.mark.skipif(not protections()["seccomp"], reason="a system without seccomp, or an unknown processor")


@pytest.fixture(scope="module", autouse=True)
def _as_a_service_does():
    """Start processes as a service does, not as its tests."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(cage, "start", start)
        patched.setattr(cage, "CPU_SHARE", 1 / 30)
        patched.setattr(cage, "_spawner", cage._Spawner())
        yield


@pytest.fixture
def settings(tmp_path):
    """Limits that a test reaches in a moment."""
    limits = {"parser_memory_bytes": 200 * MiB, "parser_s": 30, "max_unpacked_bytes": 10 * MiB}
    return Settings(home=tmp_path, **limits)


def call(name, returns, *given, settings, **options):
    return cage.run(f"{HERE}:{name}", returns, *given, settings=settings, **options)


def refused(name, *given, settings, error=InvalidDataError, **options):
    """What is said of a call that fails."""
    with pytest.raises(error) as caught:
        call(name, object, *given, settings=settings, **options)
    return caught.value.message


def test_a_value_comes_back_and_is_of_the_type_that_was_asked_for(settings, tmp_path):
    given = (2, 0.5, tmp_path)
    assert call("add", dict[str, float | str], *given, settings=settings) == {"sum": 2.5, "path": str(tmp_path)}
    with pytest.raises(InvalidDataError, match="cannot be read"):
        cage.run(f"{HERE}:text", int, settings=settings)


def test_an_answer_that_is_too_large_is_none(settings):
    assert len(call("long_text", str, MAX_ANSWER_BYTES - 100, settings=settings)) == MAX_ANSWER_BYTES - 100
    assert "exit code 0" in refused("long_text", MAX_ANSWER_BYTES, settings=settings)


def test_errors_that_a_reader_may_raise_come_back_as_they_are(settings):
    with pytest.raises(InvalidDataError) as caught:
        call("refuse", object, "data", settings=settings)
    (item,) = caught.value.detail
    assert (item.field, item.value, item.expected) == ("q1, row 3", "x", "a number")
    assert refused("refuse", "size", settings=settings, error=TooLargeError) == "too large"


def test_an_error_of_ours_is_none_of_the_file_and_is_logged_with_what_was_written(settings, caplog):
    with pytest.raises(cage.UnexpectedReaderError, match="KeyError: 'a bug'"):
        call("bug", object, settings=settings)
    (record,) = [each for each in caplog.records if each.name == "service.runtime.cage"]
    assert "noise\\n\\x1b[31m of a library" in record.fields["output"]
    assert "in bug" in record.fields["output"]


def test_what_libraries_write_is_kept_short_and_printable(settings, caplog, capfd):
    assert call("noise", int, 100_000, settings=settings) == 7
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert record.fields["reader"] == f"{HERE}:noise"
    assert record.fields["output"].startswith("out\\n\\x1b[2Jxxx")
    assert len(record.fields["output"]) <= MAX_OUTPUT_BYTES
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("name", "ending"), [("crash", "SIGSEGV"), ("kill_itself", "SIGKILL"), ("leave", "exit code 3")]
)
def test_a_reader_that_crashes_says_that_the_file_cannot_be_read(settings, name, ending):
    message = refused(name, settings=settings, field="urdf")
    assert message.startswith("urdf is one that cannot be read")
    assert ending in message
    assert call("noise", int, 0, settings=settings) == 7


@memory_is_limited
def test_memory_is_limited_whatever_a_reader_makes_of_that(settings):
    assert call("allocate", int, 100 * MiB, settings=settings) == 100 * MiB
    message = refused("allocate", 300 * MiB, settings=settings)
    assert f"more than {200 * MiB} bytes of memory" in message
    assert "LIPSERVE_PARSER_MEMORY_BYTES" in message


@pytest.mark.parametrize("name", ["sleep", "close_all_and_sleep"])
def test_time_is_limited(settings, name):
    message = refused(name, settings=settings.model_copy(update={"parser_s": 0.2}))
    assert "more than 0.2 s of time" in message
    assert "LIPSERVE_PARSER_S" in message


def test_files_are_limited_in_size_and_number(settings, tmp_path):
    call("write", type(None), tmp_path, 10 * MiB, settings=settings, folder=tmp_path)
    message = refused("write", tmp_path, 11 * MiB, settings=settings, folder=tmp_path, error=TooLargeError)
    assert "LIPSERVE_MAX_UNPACKED_BYTES" in message
    assert "open files" in refused("open_files", tmp_path / "large", settings=settings)


def test_processor_time_is_limited_and_others_are_read_meanwhile(settings):
    with ThreadPoolExecutor() as pool:
        long = pool.submit(refused, "spin", settings=settings)
        several = pool.map(lambda _: call("noise", int, 0, settings=settings), range(8))
        assert list(several) == [7] * 8
        message = long.result()
    assert "more than 1 s of processor time" in message
    assert "LIPSERVE_PARSER_S" in message


def test_a_reader_has_neither_the_environment_nor_the_files_of_the_service(settings, monkeypatch):
    monkeypatch.setenv("LIPSERVE_DATABASE_URL", "postgresql://secret")
    monkeypatch.setattr(cage, "_spawner", cage._Spawner())  # one that is started with it
    seen = call("environment", str, settings=settings.model_copy(update={"database_url": "postgresql://secret"}))
    assert "LANG" in seen
    assert "secret" not in seen
    with open(os.devnull), open(os.devnull):
        numbers = call("descriptors", list[int], settings=settings)
    assert numbers[:3] == [0, 1, 2]
    assert len(numbers) == 4  # and that for its answer


@filtered
@pytest.mark.parametrize(
    "deed",
    ["socket", "fork", "exec", "spawn", "kill", "kill all", "priority", "limit of another", "more processor time"],
)
def test_a_reader_has_no_network_and_no_other_process(settings, tmp_path, deed):
    assert call("tried", str, deed, str(tmp_path), os.getpid(), settings=settings) in ("PermissionError", "ValueError")
    assert call("threads", int, settings=settings) == 1


@landlocked
@pytest.mark.parametrize("deed", ["read", "write", "list", "link", "symbolic link", "memory"])
def test_a_reader_has_no_files_but_those_it_is_given(settings, tmp_path, deed):
    secret, folder = tmp_path / "home" / "secret", tmp_path / "folder"
    secret.parent.mkdir()
    folder.mkdir()
    secret.write_text("key")
    result = call("tried", str, deed, str(secret), os.getpid(), settings=settings, folder=folder)
    assert result == ("OSError" if deed == "link" else "PermissionError")
    assert secret.read_text() == "key"


def test_a_process_that_waits_for_calls_is_replaced_once_it_has_ended(settings):
    assert call("noise", int, 0, settings=settings) == 7
    process = cage._spawner._process
    process.kill()
    process.wait()
    assert call("noise", int, 0, settings=settings) == 7
    assert cage._spawner._process.pid != process.pid


def test_a_process_that_waits_for_calls_and_hangs_is_replaced(settings, caplog):
    assert call("noise", int, 0, settings=settings) == 7
    process = cage._spawner._process
    process.send_signal(signal.SIGSTOP)
    hasty = settings.model_copy(update={"parser_s": 4.0})
    with ThreadPoolExecutor() as pool:
        waiting = [pool.submit(call, "noise", int, 0, settings=hasty) for _ in range(3)]
        assert [each.result() for each in waiting] == [7, 7, 7]
    assert process.wait(60) == -signal.SIGKILL
    assert "hangs and is killed: it has not got on for 4 s" in caplog.text


def test_it_ends_with_the_one_that_has_started_it(settings):
    assert call("noise", int, 0, settings=settings) == 7
    process = cage._spawner._process
    eventually(lambda: _confined(process.pid))
    others = [*children(process.pid), *_confined(process.pid)]
    cage._spawner._control.close()
    assert process.wait(60) == 0
    eventually(lambda: not any(map(_runs, others)))


def _runs(pid):
    """Whether a process is there and has not ended, whether or not anybody has asked how."""
    try:
        return "State:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_nobody_waits_for_ever_where_no_process_can_be_started(settings, monkeypatch):
    monkeypatch.setattr(cage, "_spawner", cage._Spawner())

    def fail(control):
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(cage, "start", fail)
    assert "uploads cannot be read now" in refused("text", settings=settings, error=NotReadyError)


def test_a_caller_that_goes_away_ends_its_process(settings, monkeypatch):
    """A reader that would go on for an hour, when the connection of the thread that waits for it breaks."""
    connections = []

    class Watched(cage._Spawner):
        def connect(self):
            connection, process = super().connect()
            connections.append(connection)
            return connection, process

    own = Watched()
    monkeypatch.setattr(cage, "_spawner", own)
    with ThreadPoolExecutor() as pool:
        waiting = pool.submit(refused, "sleep", settings=settings, error=NotReadyError)
        for _ in range(2):  # it is tried again
            eventually(lambda: connections and len(_confined(own._process.pid)) == 2)
            connections.pop().shutdown(socket.SHUT_RDWR)
        assert "uploads cannot be read now" in waiting.result()
    eventually(lambda: len(_confined(own._process.pid)) == 1)


def _confined(pid):
    """Processes that read a file, and the one that will read the next."""
    return [each for child in children(pid) for each in children(child)]


def test_a_missing_extra_is_told(settings):
    failure = Failure("extra", "", [("ingest", "pyarrow", "")])
    error = cage._error(failure, "reader", "file", settings)
    assert isinstance(error, MissingExtraError)
    assert "lipserve[ingest]" in str(error)


@pytest.mark.parametrize(("machine", "place"), [(0xC000003E, 0), (0xC00000B7, 1)])
def test_a_filter_answers_each_call_as_its_tables_say(machine, place):
    """The program, interpreted here, for each call that it knows and some that it does not."""
    program = build_filter(machine, place, 4242)

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

    for numbers in FORBIDDEN_CALLS.values():
        if numbers[place] is not None:
            assert answer(numbers[place]) == "error 1"
    for numbers in SELF_ONLY_CALLS.values():
        assert [answer(numbers[place], pid) for pid in (4242, 0, 1)] == ["allow", "allow", "error 1"]
    clone = (56, 220)[place]
    assert [answer(clone, flags) for flags in (0x10000 | 0x100, 17)] == ["allow", "error 1"]
    assert answer(435) == "error 38"
    assert answer(0) == answer((9, 222)[place]) == "allow"
    assert answer(0x40000000 + 41) == "error 1"
    assert answer(0, seen=0x40000003) == "kill"


FIRST_AT_ONCE = """
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


@pytest.mark.parametrize(
    ("maker", "encoder"),
    [("service.runtime.cage:_decoder", "msgspec.msgpack"), ("lipserve.call:decoder", "msgspec.json")],
)
def test_threads_that_are_the_first_to_read_a_type_at_once_all_read_it(maker, encoder):
    """msgspec makes what it knows of a type in steps, without a lock: a second thread ends the process (SIGSEGV)."""
    command = [sys.executable, "-c", FIRST_AT_ONCE, maker, encoder, TYPES]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (0, "done\n"), done.stderr
