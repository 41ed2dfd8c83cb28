"""The extensions of uvicorn match the installed and allowed versions, which `HOLDS_FOR` names."""

import logging
import socket
import tomllib
from importlib.metadata import version

import pytest
import uvicorn
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from service.api.server import HOLDS_FOR
from service.api.server.connections import GuardedProtocol
from service.api.server.sockets import Server
from service.api.server.streams import StreamProtocol
from service.planes.control import ControlServer
from service.planes.data import DataServer
from service.planes.pulse import Pulse
from tests import ROOT

PYPROJECT = ROOT / "pyproject.toml"
REPLACED = {
    GuardedProtocol: (
        HttpToolsProtocol,
        *("connection_made", "connection_lost", "data_received", "on_body", "on_response_complete", "pause_writing"),
        *("resume_writing", "handle_websocket_upgrade", "send_400_response", "_unsupported_upgrade_warning"),
    ),
    StreamProtocol: (WebSocketsSansIOProtocol, "data_received", "shutdown"),
    Server: (uvicorn.Server, "startup", "shutdown", "handle_exit"),
    ControlServer: (uvicorn.Server, "startup", "handle_exit"),
    DataServer: (uvicorn.Server, "startup", "shutdown", "handle_exit"),
}
"""Methods of uvicorn that subclasses replace, and the classes that define them; uvicorn must call these names."""


@pytest.mark.parametrize("library", HOLDS_FOR)
def test_checked_versions_are_the_installed_and_allowed_ones(library):
    needed = (Requirement(each) for each in tomllib.loads(PYPROJECT.read_text())["project"]["dependencies"])
    bounds = {each.name: each.specifier for each in needed}
    assert version(library) in SpecifierSet(HOLDS_FOR[library])
    assert bounds[library] == SpecifierSet(HOLDS_FOR[library])


@pytest.mark.parametrize("kind", REPLACED)
def test_replaced_methods_exist(kind):
    base, *names = REPLACED[kind]
    assert issubclass(kind, base)
    for name in names:
        assert name in vars(kind), name
        assert callable(getattr(base, name)), name


def test_message_of_a_start_names_the_address(caplog, monkeypatch):
    """The data plane logs it itself, as uvicorn logs none for listeners that it is given."""
    caplog.set_level("INFO", "uvicorn.error")
    monkeypatch.setattr(logging.getLogger("uvicorn"), "propagate", True)  # other tests configure it
    config = uvicorn.Config(print, port=0, lifespan="off", log_config=None)
    config.load()
    with socket.create_server(("127.0.0.1", 0)) as listener:
        DataServer(config, None, 0.0, Pulse())._log_started_message([listener])
        assert f"running on http://127.0.0.1:{listener.getsockname()[1]}" in caplog.text
