"""The least of a client: one answer of a running service within a second, and nothing that takes time to import."""

from __future__ import annotations

import http.client
import json
import os
import socket
from typing import Any
from urllib.parse import urlsplit

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
