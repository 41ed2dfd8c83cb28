"""Forked processes: their ends, their errors, and the nursery that forks for a process with threads."""

import os
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from service.foundation.errors import NotFoundError
from service.runtime import forking
from service.telemetry.logs import new_request_id
from tests.service.data import DEADLINE, eventually
from tests.service.runtime import nurses
from tests.service.server import is_running

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="forked processes need Linux")


def run(scenario, **options):
    """Start a process that plays a scenario."""
    command = [sys.executable, "-m", nurses.__name__, scenario]
    return subprocess.Popen(command, text=True, stdout=subprocess.PIPE, stdin=subprocess.PIPE, **options)


@pytest.mark.parametrize(
    ("work", "code"),
    [(lambda: None, 0), (lambda: sys.exit(5), 5), (lambda: sys.exit("why"), 1), (lambda: 1 / 0, 1)],
    ids=["end", "exit code", "exit message", "error"],
)
def test_forked_process_ends_with_the_code_of_its_work(work, code):
    _, status = os.waitpid(forking.fork(work, "test"), 0)
    assert os.waitstatus_to_exitcode(status) == code


def test_forked_process_ignores_ctrl_c_and_blocks_no_signal():
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM])
    try:
        pid = forking.fork(signal.pause, "test")
        eventually(lambda: Path(f"/proc/{pid}/comm").read_text() == "lip-test\n")
        os.kill(pid, signal.SIGINT)
        os.kill(pid, signal.SIGTERM)
        _, status = os.waitpid(pid, 0)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    assert os.waitstatus_to_exitcode(status) == -signal.SIGTERM


def test_called_function_runs_elsewhere_and_its_error_comes_back():
    seen = []
    forking.call(seen.append, 1)
    assert seen == []

    def fail():
        raise NotFoundError("gone")

    with pytest.raises(NotFoundError, match="gone"):
        forking.call(fail)
    with pytest.raises(ChildProcessError, match="exit code -9"):
        forking.call(lambda: os.kill(os.getpid(), signal.SIGKILL))


def test_process_with_threads_is_told_what_to_do():
    output, _ = run("threads").communicate(timeout=DEADLINE)
    assert "cannot fork" in output
    assert "LIPSERVE_DATA_PLANE=off" in output


def test_nursery_forks_processes_for_a_process_with_threads():
    """They share its imports, have no threads of it, and their exit codes are known."""
    output, _ = run("shared").communicate(timeout=DEADLINE)
    assert output.split("\n") == [
        *("one 1 True lip-one True None", "False -9"),
        *("two 1 True lip-two True None", "False -9", "7", ""),
    ]


def test_processes_end_with_their_nursery_and_it_ends_with_its_parent():
    with run("orphaned") as process:
        _, forks, forked = map(int, process.stdout.readline().split())
        os.kill(forks, signal.SIGKILL)
        eventually(lambda: not is_running(forked))
        process.stdin.write("\n")
        process.stdin.flush()
        assert process.stdout.readline().split() in (["NurseryError", "None"], ["BrokenPipeError", "None"])
        process.kill()
    with run("orphaned") as process:
        _, forks, forked = map(int, process.stdout.readline().split())
        process.kill()
        eventually(lambda: not is_running(forks) and not is_running(forked))


def test_forked_processes_have_request_ids_of_their_own():
    def send_id(pipe):
        os.write(pipe, new_request_id().encode())

    reading, writing = os.pipe()
    ids = {new_request_id()}
    for _ in range(2):
        os.waitpid(forking.fork(partial(send_id, writing), "test"), 0)
        ids.add(os.read(reading, 100).decode())
    os.close(reading)
    os.close(writing)
    assert len({each.partition("-")[0] for each in ids}) == 3


def test_companions_set_their_options_before_they_import_numerics():
    code = "import sys, service.runtime.companion; print({'numpy', 'scipy', 'torch'} & sys.modules.keys())"
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=DEADLINE, check=True)
    assert printed.stdout == "set()\n"


def test_orphans_of_the_own_group_are_killed():
    kept, orphan, other = (forking.fork(work, "test") for work in (signal.pause, signal.pause, leave_group))
    try:
        eventually(lambda: os.getpgid(other) == other)
        others = {pid for pid in forking.children() if pid not in (kept, orphan, other)}
        assert forking.kill_orphans({kept, *others})
        _, status = os.waitpid(orphan, 0)
        assert os.waitstatus_to_exitcode(status) == -signal.SIGKILL
        assert is_running(kept)
        assert is_running(other)
        assert not forking.kill_orphans({kept, *others})
    finally:
        for pid in (kept, other):
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)


def leave_group():
    """Wait in a group of its own."""
    os.setpgid(0, 0)
    signal.pause()
