"""The supervisor: restarts, hanging processes, failed starts, and the order of a stop."""

import os
import signal
import subprocess
import sys

import pytest

from service.planes.pulse import Plane
from service.planes.supervisor import MAX_PAUSE_S, MIN_LIFE_S, Child
from tests.service.data import DEADLINE, eventually
from tests.service.planes import little
from tests.service.server import is_running, state

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="planes need Linux")


class Little:
    """A running `little`, and its lines that were not read yet."""

    def __init__(self, *kind: str) -> None:
        command = [sys.executable, "-m", little.__name__, *kind]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        self.lines: list[str] = []

    def read(self, name: str) -> str:
        """Return the rest of the next line that begins with a name; lines with other names stay."""
        while True:
            for line in self.lines:
                first, _, rest = line.partition(" ")
                if first == name:
                    self.lines.remove(line)
                    return rest
            read = self.process.stdout.readline()
            assert read, self.process.stderr.read()
            self.lines.append(read.strip())

    def pids(self) -> dict[str, int]:
        """Return the ids of both planes."""
        return {name: int(self.read(name)) for name in ("control", "data")}

    def finish(self) -> str:
        """Return what it prints until its end."""
        rest, self.errors = self.process.communicate(timeout=DEADLINE)
        return rest


@pytest.fixture
def start():
    started = []

    def start_one(*kind):
        started.append(Little(*kind))
        return started[-1]

    yield start_one
    for each in started:
        each.process.kill()
        each.process.communicate()


def test_killed_processes_are_restarted_and_stopped_in_order(start):
    service = start()
    first = {name: int(service.read(name)) for name in ("control", "data")}
    second = {}
    for name, pid in first.items():
        os.kill(pid, signal.SIGKILL)
        second[name] = int(service.read(name))
    assert not {*first.values()} & {*second.values()}
    service.process.terminate()
    begin, *middle, last, ending, _ = service.finish().split("\n")
    assert (begin, {*middle}) == ("stopping", {"control told", "data ended"})
    assert (last, ending) == ("control ended", f"ending {-signal.SIGTERM}")
    assert f"process {first['data']} of the data plane ended with exit code -9; it is started again" in service.errors


def test_stopped_data_plane_is_killed_and_a_stopped_supervisor_kills_nothing(start):
    service = start()
    first = service.pids()
    service.process.send_signal(signal.SIGSTOP)
    eventually(lambda: state(service.process.pid) == "T")
    os.kill(first["data"], signal.SIGSTOP)
    eventually(lambda: state(first["data"]) == "T")
    os.kill(first["data"], signal.SIGCONT)
    service.process.send_signal(signal.SIGCONT)
    os.kill(first["control"], signal.SIGKILL)
    assert service.read("control") != str(first["control"])
    assert is_running(first["data"])
    os.kill(first["data"], signal.SIGSTOP)
    assert int(service.read("data")) != first["data"]
    assert not is_running(first["data"])


def test_failed_start_ends_all_with_its_exit_code(start):
    service = start("failing")
    assert f"ending {little.EXIT_CODE}" in service.finish()
    assert "the control plane ended with exit code 42 before the service had started" in service.errors


def test_second_signal_ends_all_at_once(start):
    service = start("quiet")  # its planes ignore SIGTERM
    pids = service.pids()
    service.process.terminate()
    service.read("control")  # told
    service.process.send_signal(signal.SIGINT)
    assert f"ending {-signal.SIGINT}" in service.finish()
    eventually(lambda: not any(map(is_running, pids.values())))


def test_processes_end_with_a_killed_supervisor(start):
    service = start()
    pids = service.pids()
    service.process.kill()
    eventually(lambda: not any(map(is_running, pids.values())))


def test_pauses_grow_until_a_process_lives_long(monkeypatch):
    now = 0.0
    monkeypatch.setattr("service.planes.supervisor.time.monotonic", lambda: now)
    child, pauses = Child(Plane.DATA, lambda: None, "data", began=0.0), []
    for _ in range(12):
        child.put_off()
        pauses.append(round(child.due - now, 9))
        now = child.began = child.due
    assert pauses[:4] == [0.0, 0.1, 0.2, 0.4]
    assert pauses[-2:] == [MAX_PAUSE_S] * 2
    now += MIN_LIFE_S
    child.put_off()
    assert child.due == now


SHARED_START = """
import sys
from service.foundation.settings import Settings
from service.planes.preparation import share_memory
from service.runtime.forking import check_threads
share_memory(Settings(home=sys.argv[1], database_url="postgresql://nowhere/none", files_url="s3://nowhere/none"))
check_threads()
"""


def test_service_with_a_shared_store_can_fork(tmp_path):
    """The client of an object store has a thread from its construction on."""
    pytest.importorskip("s3fs")
    command = [sys.executable, "-c", SHARED_START, str(tmp_path)]
    started = subprocess.run(command, check=False, capture_output=True, text=True, timeout=DEADLINE)
    assert started.returncode == 0, started.stderr
