"""A reader of server-sent events, inside the process of the service."""

import asyncio
import json
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any

from tests.service.data import eventually


class Listener:
    """What was sent so far. events: (kind, data); status: of the answer, None before it began; ended: whether it is."""

    def __init__(self) -> None:
        self.status: int | None = None
        self.events: list[tuple[str, Any]] = []
        self.ended = False
        self.leave = asyncio.Event()
        self._asked = False
        self._text = ""

    def of(self, kind: str) -> list[Any]:
        """Data of the events of a kind."""
        return [data for event, data in list(self.events) if event == kind]

    def parts(self) -> list[dict[str, Any]]:
        """All parts of rows."""
        return [part for data in self.of("rows") for part in data["parts"]]

    def rows(self) -> int:
        """Rows that were counted."""
        return sum(part["rows"] for part in self.parts())

    async def receive(self) -> dict[str, Any]:
        """The request, and nothing more until it leaves."""
        if not self._asked:
            self._asked = True
            return {"type": "http.request", "body": b"", "more_body": False}
        await self.leave.wait()
        return {"type": "http.disconnect"}

    async def send(self, message: Any) -> None:
        """Read what the service sends."""
        if message["type"] == "http.response.start":
            self.status = message["status"]
            return
        *blocks, self._text = (self._text + message.get("body", b"").decode()).split("\n\n")
        for block in blocks:
            fields = dict(line.split(": ", 1) for line in block.splitlines() if not line.startswith(":"))
            if fields:
                self.events.append((fields["event"], json.loads(fields["data"])))


@contextmanager
def followed(client: Any, path: str) -> Iterator[Listener]:
    """Follow events until the end of the block, where the reader leaves; the first one is there."""
    listener = client.portal.call(_listener)

    async def talk() -> None:
        scope = {
            "type": "http",
            "method": "GET",
            "path": path,
            "raw_path": b"",
            "query_string": b"",
            "headers": [(b"host", b"127.0.0.1")],
            "client": ("127.0.0.1", 1),
            "server": ("127.0.0.1", 80),
            "scheme": "http",
            "root_path": "",
            "http_version": "1.1",
            "asgi": {"version": "3.0", "spec_version": "2.3"},  # in which the server says that the client has left
            "app": client.app,
            "state": {},
        }
        try:
            await client.app(scope, listener.receive, listener.send)
        finally:
            listener.ended = True

    task = client.portal.start_task_soon(talk)
    try:
        eventually(lambda: listener.events or listener.ended)
        yield listener
    finally:
        client.portal.call(listener.leave.set)
        task.result(30)


def following(client: Any, model: str) -> AbstractContextManager[Listener]:
    """Follow a model."""
    return followed(client, f"/v1/models/{model}/live")


async def _listener() -> Listener:
    return Listener()
