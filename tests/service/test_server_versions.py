"""What extends uvicorn holds for the versions that are installed and for all that may be: `HOLDS_FOR` names them."""

import tomllib
from importlib.metadata import version
from pathlib import Path

import pytest
import uvicorn
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from service.api.server import HOLDS_FOR
from service.api.server.connections import GuardedProtocol, StreamProtocol
from service.api.server.sockets import Server

PYPROJECT = Path(__file__).parents[2] / "pyproject.toml"
REPLACED = {
    GuardedProtocol: (
        HttpToolsProtocol,
        *("connection_made", "connection_lost", "data_received", "on_body", "on_response_complete", "pause_writing"),
        *("resume_writing", "handle_websocket_upgrade", "send_400_response", "_unsupported_upgrade_warning"),
    ),
    StreamProtocol: (WebSocketsSansIOProtocol, "data_received", "shutdown"),
    Server: (uvicorn.Server, "startup", "shutdown", "handle_exit"),
}
"""Methods of uvicorn that classes replace, and whose they are: uvicorn has to call them by these names."""


@pytest.mark.parametrize("library", HOLDS_FOR)
def test_the_versions_are_those_installed_and_those_allowed(library):
    needed = (Requirement(each) for each in tomllib.loads(PYPROJECT.read_text())["project"]["dependencies"])
    bounds = {each.name: each.specifier for each in needed}
    assert version(library) in SpecifierSet(HOLDS_FOR[library])
    assert bounds[library] == SpecifierSet(HOLDS_FOR[library])


@pytest.mark.parametrize("kind", REPLACED)
def test_what_is_replaced_is_there(kind):
    base, *names = REPLACED[kind]
    assert issubclass(kind, base)
    for name in names:
        assert name in vars(kind), name
        assert callable(getattr(base, name)), name
