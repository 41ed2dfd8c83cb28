"""Reader of server-sent events in the process of the service."""

import asyncio
import json
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any

from tests.service.data import eventually


class EventListener:
    """Events received so far, as (kind, data), with the HTTP status (None before the response) and whether it ended."""

    def __init__(self) -> None:
        self.status: int | None = None
        self.events: list[tuple[str, Any]] = []
        self.ended = False
        self.left = asyncio.Event()
        self._requested = False
        self._text = ""

    def list_data(self, kind: str) -> list[Any]:
        """Return the data of all events of a kind."""
        return [data for event, data in list(self.events) if event == kind]

    def list_parts(self) -> list[dict[str, Any]]:
        """Return the parts of all `rows` events."""
        return [part for data in self.list_data("rows") for part in data["parts"]]

    def count_rows(self) -> int:
        """Return the number of rows in all parts."""
        return sum(part["rows"] for part in self.list_parts())

    async def receive(self) -> dict[str, Any]:
        """Return the request, then wait until the reader disconnects."""
        if not self._requested:
            self._requested = True
            return {"type": "http.request", "body": b"", "more_body": False}
        await self.left.wait()
        return {"type": "http.disconnect"}

    async def send(self, message: Any) -> None:
        """Parse a message of the service."""
        if message["type"] == "http.response.start":
            self.status = message["status"]
            return
        *blocks, self._text = (self._text + message.get("body", b"").decode()).split("\n\n")
        for block in blocks:
            fields = dict(line.split(": ", 1) for line in block.splitlines() if not line.startswith(":"))
            if fields:
                self.events.append((fields["event"], json.loads(fields["data"])))


@contextmanager
def follow_events(client: Any, path: str) -> Iterator[EventListener]:
    """Follow events until the end of the block; return once the first event has arrived."""
    listener = EventListener()

    async def run_request() -> None:
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
            "asgi": {"version": "3.0", "spec_version": "2.3"},  # the version that reports disconnects
            "app": client.app,
            "state": {},
        }
        try:
            await client.app(scope, listener.receive, listener.send)
        finally:
            listener.ended = True

    task = client.portal.start_task_soon(run_request)
    try:
        eventually(lambda: listener.events or listener.ended)
        yield listener
    finally:
        client.portal.call(listener.left.set)
        task.result(30)


def follow_model(client: Any, model: str) -> AbstractContextManager[EventListener]:
    """Follow the live events of a model."""
    return follow_events(client, f"/v1/models/{model}/live")
