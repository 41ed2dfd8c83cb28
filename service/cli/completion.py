"""Names that a shell completes: those of a running service, if it answers within a second; else none.

It asks with the least of a client, as nothing may be imported that takes time.
"""

from __future__ import annotations

import http.client
import json
import os
import socket
from collections.abc import Callable
from http.client import HTTPException
from typing import Any
from urllib.parse import quote, urlsplit

import typer

from service.foundation.settings import DEFAULT_URL

UNIX = "unix://"


class _UnixConnection(http.client.HTTPConnection):
    """HTTP over a Unix-domain socket."""

    def __init__(self, path: str, timeout: float) -> None:
        super().__init__("localhost", timeout=timeout)
        self._path = path

    def connect(self) -> None:
        self.sock = socket.socket(socket.AF_UNIX)
        self.sock.settimeout(self.timeout)
        self.sock.connect(self._path)


def ask(url: str, path: str, timeout: float = 1.0) -> Any:
    """Return the JSON at a path of a service, with the key in LIPSERVE_KEY.

    Raise OSError, HTTPException or ValueError where none answers in time, it refuses, or it is no such service.
    """
    parts = urlsplit(url)
    connection: http.client.HTTPConnection
    if url.startswith(UNIX):
        connection = _UnixConnection(url.removeprefix(UNIX), timeout)
    else:
        kind = http.client.HTTPSConnection if parts.scheme == "https" else http.client.HTTPConnection
        connection = kind(parts.netloc, timeout=timeout)
    key = os.environ.get("LIPSERVE_KEY", "").strip()
    try:
        connection.request("GET", path, headers={"Authorization": f"Bearer {key}"} if key else {})
        answer = connection.getresponse()
        if answer.status != http.client.OK:
            raise ValueError(f"status {answer.status}")
        return json.loads(answer.read())
    finally:
        connection.close()


Names = list[str | tuple[str, str]]
"""What may stand there, with what it is."""


def models(context: typer.Context) -> Names:
    """Names of models."""
    return _listed(context, "/v1/models?limit=100", lambda each: (each["name"], f"version {each['serving_version']}"))


def datasets(context: typer.Context) -> Names:
    """Ids of data sets with their names."""
    return _listed(context, "/v1/datasets?limit=100", lambda each: (each["id"], each["name"]))


def jobs(context: typer.Context) -> Names:
    """Ids of jobs with what they train."""
    return _listed(context, "/v1/jobs?limit=100", lambda each: (each["id"], f"{each['state']}: {each['model']}"))


def versions(context: typer.Context) -> Names:
    """Versions of the model that the command line names."""
    return [(str(each["version"]), each["estimator"]) for each in _model(context).get("versions", ())]


def aliases(context: typer.Context) -> Names:
    """Aliases of the model that the command line names."""
    return [("serving", "what answers"), *((name, f"version {at}") for name, at in _model(context)["aliases"].items())]


def _model(context: typer.Context) -> dict[str, Any]:
    name = context.params.get("model")
    record = _asked(context, f"/v1/models/{quote(name, safe='')}") if name else None
    return record if isinstance(record, dict) else {"aliases": {}}


def _listed(context: typer.Context, path: str, name: Callable[[dict[str, Any]], tuple[str, str]]) -> Names:
    listed = _asked(context, path)
    return [name(each) for each in listed["items"]] if isinstance(listed, dict) else []


def _asked(context: typer.Context, path: str) -> Any:
    url = context.params.get("url") or os.environ.get("LIPSERVE_URL") or DEFAULT_URL
    try:
        return ask(url, path)
    except (OSError, HTTPException, ValueError):
        return None
