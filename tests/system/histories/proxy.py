"""A proxy between a service and its database that simulates network faults."""

from __future__ import annotations

import asyncio
import threading
from contextlib import suppress
from typing import Literal
from urllib.parse import parse_qs, urlsplit

Fault = Literal["cut", "stalled", "deaf"]
FAULTS: tuple[Fault, ...] = ("cut", "stalled", "deaf")
CHUNK_BYTES = 1 << 16


class Proxy:
    """Forwards a local port to a PostgreSQL server's Unix socket, in its own thread.

    Faults: `cut` closes all connections and accepts none; `stalled` forwards nothing; `deaf` forwards requests but no
    responses.
    """

    def __init__(self, url: str) -> None:
        parts = urlsplit(url)
        self._socket = f"{parse_qs(parts.query)['host'][0]}/.s.PGSQL.5432"
        self._database = parts.path
        self._loop = asyncio.new_event_loop()
        self._requests_open, self._responses_open = asyncio.Event(), asyncio.Event()
        self._fault: Fault | None = None
        self._ends: set[asyncio.StreamWriter] = set()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True, name="proxy")
        self._thread.start()
        self._server = asyncio.run_coroutine_threadsafe(self._listen(), self._loop).result()
        self.port = int(self._server.sockets[0].getsockname()[1])

    @property
    def url(self) -> str:
        """The URL of the database through the proxy."""
        return f"postgresql://postgres@127.0.0.1:{self.port}{self._database}"

    def set(self, fault: Fault | None) -> None:
        """Set or clear the fault; stalled connections continue, cut ones stay closed."""
        self._loop.call_soon_threadsafe(self._set, fault)

    def reset(self) -> None:
        """Close all connections; new ones are accepted unless there is a fault."""
        self._loop.call_soon_threadsafe(self._end_all)

    def close(self) -> None:
        """Stop the proxy."""
        asyncio.run_coroutine_threadsafe(self._close(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    async def _listen(self) -> asyncio.Server:
        self._set(None)
        return await asyncio.start_server(self._connected, "127.0.0.1", 0)

    async def _close(self) -> None:
        self._server.close()
        self._set("cut")
        tasks = asyncio.all_tasks() - {asyncio.current_task()}  # type: ignore[arg-type]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    def _set(self, fault: Fault | None) -> None:
        self._fault = fault
        for event, open_ in ((self._requests_open, fault != "stalled"), (self._responses_open, fault in (None, "cut"))):
            event.set() if open_ else event.clear()
        if fault == "cut":
            self._end_all()

    def _end_all(self) -> None:
        for end in self._ends:
            end.transport.abort()

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self._fault == "cut":
            writer.transport.abort()
            return
        try:
            upstream_reader, upstream_writer = await asyncio.open_unix_connection(self._socket)
        except OSError:  # the server is down
            writer.transport.abort()
            return
        ends = {writer, upstream_writer}
        self._ends |= ends
        try:
            await asyncio.gather(
                self._forward(reader, upstream_writer, self._requests_open),
                self._forward(upstream_reader, writer, self._responses_open),
            )
        except asyncio.CancelledError:  # the proxy is closed
            return
        finally:
            self._ends -= ends
            for end in ends:
                end.transport.abort()

    async def _forward(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, is_open: asyncio.Event
    ) -> None:
        with suppress(OSError):
            while chunk := await reader.read(CHUNK_BYTES):
                await is_open.wait()
                writer.write(chunk)
                await writer.drain()
        writer.close()
