"""The Unix-domain socket beside the port: its permissions, and which existing files it replaces."""

import os
import re
import signal
import socket
import stat

import numpy as np
import pytest
from websockets.sync.client import unix_connect

from lipserve import Client
from service.api.server.sockets import SocketError, UnixSocket
from tests.service.data import DEADLINE
from tests.service.server import Server
from tests.service.warm import Served

QUERY = {"q": [0, -0.5, 0, -2, 0, 1.5, 0.7], "dq": [0.1] * 7, "ddq": [0.2] * 7}


@pytest.fixture
def path(tmp_path):
    """A path at which nothing exists."""
    return tmp_path / "lip.sock"


def leave_dead_socket(path):
    """Leave at the path the socket of a service that was killed."""
    with socket.socket(socket.AF_UNIX) as other:
        other.bind(str(path))


def bind_rejected(path):
    with pytest.raises(SocketError) as caught:
        UnixSocket(path, 0o660)
    assert repr(str(path)) in str(caught.value)
    return str(caught.value)


def can_connect(path):
    with socket.socket(socket.AF_UNIX) as client:
        return client.connect_ex(str(path)) == 0


@pytest.mark.parametrize("mode", [0o660, 0o600])
def test_socket_has_its_mode_whatever_the_umask(path, mode):
    before = os.umask(0o077)
    try:
        opened = UnixSocket(path, mode)
    finally:
        os.umask(before)
    assert stat.S_IMODE(path.lstat().st_mode) == mode
    opened.close()
    assert not path.exists()


def test_socket_of_a_dead_service_is_replaced(path):
    leave_dead_socket(path)
    assert not can_connect(path)
    opened = UnixSocket(path, 0o660)
    assert can_connect(path)
    opened.close()


@pytest.mark.parametrize("full", [False, True])
def test_live_socket_is_left_alone(path, full):
    """Also if its queue is full."""
    with socket.socket(socket.AF_UNIX) as other, socket.socket(socket.AF_UNIX) as first:
        other.bind(str(path))
        other.listen(0 if full else 9)
        if full:
            first.connect(str(path))
        assert "Another service listens at" in bind_rejected(path)
        assert full or can_connect(path)
    assert path.is_socket()


def test_socket_of_another_kind_is_left_alone(path):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as other:
        other.bind(str(path))
        assert "does not answer" in bind_rejected(path)
        assert path.is_socket()


@pytest.mark.parametrize("kind", ["file", "link to nothing", "link to a dead socket"])
def test_other_files_are_left_alone(path, tmp_path, kind):
    if kind == "link to a dead socket":
        leave_dead_socket(tmp_path / "target")
    if kind == "file":
        path.write_text("precious")
    else:
        path.symlink_to(tmp_path / "target")
    before = path.lstat()
    assert "exists and is not a socket" in bind_rejected(path)
    assert path.lstat() == before


@pytest.mark.parametrize("folder", ["nowhere", "x" * 150])
def test_impossible_path_is_reported(tmp_path, folder):
    if len(folder) > 100:
        (tmp_path / folder).mkdir()
    assert re.search("No such file or directory|too long", bind_rejected(tmp_path / folder / "lip.sock"))


@pytest.mark.slow
def test_service_listens_on_socket_and_port(home, path):
    """Then it is killed, restarted on the remaining socket, and terminated."""
    with Server(home, warm=True, LIPSERVE_UDS=str(path)) as server, Client(f"unix://{path}") as client:
        reply = server.client.post("/v1/models/panda-sim/predict", json=QUERY).json()
        assert client.predict("panda-sim", **QUERY).as_dict() == reply
        assert stat.S_IMODE(path.lstat().st_mode) == 0o660
        with unix_connect(str(path), "ws://localhost/v1/echo/stream") as stream:
            stream.send(b"12345678")
            assert stream.recv() == b"12345678"
        server.kill()
    assert path.is_socket()

    again = Server(home, warm=True, LIPSERVE_UDS=str(path), LIPSERVE_UDS_MODE="600")
    with again as server, Client(f"unix://{path}") as client:
        assert stat.S_IMODE(path.lstat().st_mode) == 0o600
        zero = np.zeros(7)
        assert client.predict("panda-sim", zero, zero, zero).model == "panda-sim"
        log, other = home.with_name("second.log"), {**os.environ, "LIPSERVE_HOME": str(home.with_name("other"))}
        second = Served(["serve", "--port", "0", "--uds", str(path)], other, log)
        assert second.wait(DEADLINE) == 1
        assert ("Another service listens" in log.read_text(), "Traceback" in log.read_text()) == (True, False)
        assert client.ready()
        assert server.terminate() == -signal.SIGTERM
        assert not path.exists()


def test_socket_of_a_successor_is_not_removed(path):
    opened = UnixSocket(path, 0o660)
    path.unlink()
    successor = UnixSocket(path, 0o660)
    opened.close()
    assert can_connect(path)
    successor.close()


@pytest.mark.parametrize("url", ["unix://lip.sock", "unix://"])
def test_client_needs_an_absolute_path(url):
    with pytest.raises(ValueError, match="expected unix:// and an absolute path"):
        Client(url)
