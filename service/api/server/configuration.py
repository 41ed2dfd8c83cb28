"""The options of uvicorn, the same in each process that serves."""

from __future__ import annotations

from typing import Any

import uvicorn

from service.api.server import sockets
from service.api.server.connections import guarded
from service.api.server.streams import MAX_FRAME_BYTES, StreamProtocol
from service.foundation.settings import Settings


def configure_server(app: Any, settings: Settings, **others: Any) -> uvicorn.Config:
    """Return the configuration of a server for an application."""
    options: dict[str, Any] = {
        "host": settings.host,
        "port": settings.port,
        "log_config": None,  # configured by `start_logs`
        "access_log": False,  # the service logs requests itself
        "loop": "uvloop",
        "http": guarded(settings),
        "ws": StreamProtocol,
        "ws_max_size": MAX_FRAME_BYTES,
        "ws_per_message_deflate": False,
        "timeout_keep_alive": settings.keep_alive_s,
        "timeout_graceful_shutdown": sockets.DRAIN_S,
        "forwarded_allow_ips": settings.trusted_proxies,
    }
    return uvicorn.Config(app, **{**options, **others})
