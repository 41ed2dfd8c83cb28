"""A network between a service and its database that a test cuts, silences and heals."""

from __future__ import annotations

import asyncio
import threading
from contextlib import suppress
from typing import Literal
from urllib.parse import parse_qs, urlsplit

Fault = Literal["cut", "stalled", "deaf"]
FAULTS: tuple[Fault, ...] = ("cut", "stalled", "deaf")
PIECE = 1 << 16


class Proxy:
    """Passes a local port on to a PostgreSQL server's Unix socket, in a thread of its own.

    `cut` ends all connections and takes no new ones; `stalled` carries nothing in either direction, and `deaf` no
    answers: what was asked is done, and nobody hears of it.
    """

    def __init__(self, url: str) -> None:
        parts = urlsplit(url)
        self._socket = f"{parse_qs(parts.query)['host'][0]}/.s.PGSQL.5432"
        self._database = parts.path
        self._loop = asyncio.new_event_loop()
        self._asking, self._answering = asyncio.Event(), asyncio.Event()
        self._fault: Fault | None = None
        self._ends: set[asyncio.StreamWriter] = set()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True, name="proxy")
        self._thread.start()
        self._server = asyncio.run_coroutine_threadsafe(self._listen(), self._loop).result()
        self.port = int(self._server.sockets[0].getsockname()[1])

    @property
    def url(self) -> str:
        """Of the database, through here."""
        return f"postgresql://postgres@127.0.0.1:{self.port}{self._database}"

    def set(self, fault: Fault | None) -> None:
        """Begin a fault, or heal the network; connections that were stalled go on, or end if they were cut."""
        self._loop.call_soon_threadsafe(self._set, fault)

    def reset(self) -> None:
        """End all connections at once; new ones are taken, if there is no fault."""
        self._loop.call_soon_threadsafe(self._end_all)

    def close(self) -> None:
        """End it."""
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
        for event, open_ in ((self._asking, fault != "stalled"), (self._answering, fault in (None, "cut"))):
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
            there, onward = await asyncio.open_unix_connection(self._socket)
        except OSError:  # the server is away
            writer.transport.abort()
            return
        ends = {writer, onward}
        self._ends |= ends
        try:
            await asyncio.gather(self._carry(reader, onward, self._asking), self._carry(there, writer, self._answering))
        except asyncio.CancelledError:  # the proxy is closed
            return
        finally:
            self._ends -= ends
            for end in ends:
                end.transport.abort()

    async def _carry(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, may: asyncio.Event) -> None:
        with suppress(OSError):
            while piece := await reader.read(PIECE):
                await may.wait()
                writer.write(piece)
                await writer.drain()
        writer.close()
