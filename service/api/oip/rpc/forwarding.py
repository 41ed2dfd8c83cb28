"""Forwards gRPC calls to another process of the service, without reading their messages."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import grpc

from service.api.oip.rpc.listening import CLIENT, COUNTED_CALL, ERROR_CODE

MAX_RECONNECT_MS, MAX_CONNECT_MS = 250, 5000
"""Max pause between two tries to connect, while the other process starts again, and max time of a try."""
_OPTIONS = (
    ("grpc.max_receive_message_length", -1),
    ("grpc.max_send_message_length", -1),
    ("grpc.initial_reconnect_backoff_ms", 50),
    ("grpc.min_reconnect_backoff_ms", MAX_CONNECT_MS),  # gRPC's name for the max time of a try
    ("grpc.max_reconnect_backoff_ms", MAX_RECONNECT_MS),
    ("grpc.enable_http_proxy", 0),
)
_OF_TRANSPORT = ("grpc-", "user-agent", CLIENT, COUNTED_CALL)
"""How keys of metadata begin that are not forwarded."""


class Forwarding:
    """Forwards calls to the process that listens at a Unix-domain socket. Use it in the event loop."""

    def __init__(self, path: Path) -> None:
        self._channel = grpc.aio.insecure_channel(f"unix:{path}", options=_OPTIONS)

    async def forward(self, path: str, body: bytes, context: Any, counted: bool) -> bytes:
        """Answer a call with what the other process answers, see `Forward`. It is cancelled with the call."""
        metadata = tuple(_forwarded(context, counted))
        call = self._channel.unary_unary(path)(body, timeout=context.time_remaining(), metadata=metadata)
        try:
            answer: bytes = await call
        except grpc.aio.AioRpcError as error:
            trailing = tuple(error.trailing_metadata() or ())
            code, words = error.code(), error.details() or ""
            if code is grpc.StatusCode.UNAVAILABLE and not any(name == ERROR_CODE for name, _ in trailing):
                words = "The control plane of the service does not answer. Try again later."
                trailing = ((ERROR_CODE, "not_ready"),)
            await context.abort(code, words, trailing)
            raise AssertionError("context.abort did not raise") from error
        context.set_trailing_metadata(tuple(await call.trailing_metadata() or ()))
        return answer

    async def close(self) -> None:
        """Close the connection."""
        await self._channel.close()


def _forwarded(context: Any, counted: bool) -> Iterator[tuple[str, str | bytes]]:
    """Yield the metadata of a call for the other process."""
    for name, value in context.invocation_metadata() or ():
        if not name.startswith(_OF_TRANSPORT):
            yield name, value
    yield CLIENT, context.peer()
    if counted:
        yield COUNTED_CALL, "1"
