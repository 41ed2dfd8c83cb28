"""What both clients share of sending: addresses, requests, files, server-sent events."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import httpx

from service.client.call import Answer, Call

UNIX = "unix://"
NO_HOST = "http://localhost"
"""What HTTP says the host is where a socket leads to the service."""
CHUNK = 1 << 18
"""Bytes of a file that are sent together."""


@dataclass(frozen=True)
class Address:
    """Where a service is. base: of its routes; unix: path of its Unix-domain socket, None where a host is named."""

    base: str
    unix: Path | None

    @classmethod
    def of(cls, url: str) -> Address:
        """Read http://host:port or unix:///path; raise ValueError."""
        if not url.startswith(UNIX):
            return cls(url, None)
        path = url.removeprefix(UNIX)
        if not path.startswith("/"):
            raise ValueError(f"url is {url!r}, expected unix:// and an absolute path, as unix:///run/lipserve.sock")
        return cls(NO_HOST, Path(path))


def request_of(call: Call[Any]) -> dict[str, Any]:
    """How httpx is to be asked, but for the content of a file."""
    asked: dict[str, Any] = {"method": call.method, "url": call.path, "params": call.params, "headers": call.headers}
    if call.json is not None:
        asked["json"] = call.json
    if call.content is not None:
        asked["content"] = call.content
    if call.timeout is not None:
        asked["timeout"] = call.timeout
    return asked


def answer_of(response: httpx.Response, body: bytes = b"") -> Answer:
    """What came back; body: empty where it was written to a file."""
    return Answer(response.status_code, body, response.headers)


def pieces(file: BinaryIO) -> Iterator[bytes]:
    """A file in pieces."""
    while piece := file.read(CHUNK):
        yield piece


def draft_of(path: Path) -> Path:
    """Where a file is written until it is whole."""
    return path.with_name(f"{path.name}.part")


class Events:
    """Server-sent events of the lines of an answer."""

    def __init__(self) -> None:
        self._event, self._data = "", list[str]()

    def take(self, line: str) -> Answer | None:
        """Take a line, without its end; return the event that it completes, None where it completes none."""
        if line.startswith("event:"):
            self._event = line.removeprefix("event:").strip()
        elif line.startswith("data:"):
            self._data.append(line.removeprefix("data:").removeprefix(" "))
        elif not line:
            found = Answer(200, "\n".join(self._data).encode(), event=self._event) if self._data else None
            self._event, self._data = "", []
            return found
        return None  # comments keep the connection alive
