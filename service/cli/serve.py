"""`lipserve serve`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer
import uvicorn

from service.api.oip import rpc
from service.api.server import sockets
from service.api.server.connections import MAX_FRAME_BYTES, StreamProtocol, guarded
from service.app import create_app
from service.cli.options import alone, settings_of, start_logs
from service.runtime.allocator import limit_free_memory
from service.storage.storage import HomeError, check_home

app = alone()
ERRORS = (HomeError,)


@app.command()
def serve(
    host: Annotated[str | None, typer.Option(help="Address to listen on (LIPSERVE_HOST).")] = None,
    port: Annotated[int | None, typer.Option(help="Port to listen on (LIPSERVE_PORT).")] = None,
    grpc_port: Annotated[int | None, typer.Option(help="Port for gRPC (LIPSERVE_GRPC_PORT).")] = None,
    uds: Annotated[Path | None, typer.Option(help="Also listen on this Unix-domain socket (LIPSERVE_UDS).")] = None,
) -> None:
    """Serve models and run training jobs."""
    settings = settings_of(host=host, port=port, grpc_port=grpc_port, uds=uds)
    sockets.check_port(settings.host, settings.port)
    start_logs(settings)
    check_home(settings)  # before the app opens it, so that errors are printed without a traceback
    rpc.check_installed(settings)
    rpc.check_port(settings)
    if settings.data_plane and sys.platform == "linux":
        from service.planes import supervisor  # noqa: PLC0415

        supervisor.serve(settings)
        return
    limit_free_memory()
    served = create_app(settings)
    config = uvicorn.Config(
        served,
        host=settings.host,
        port=settings.port,
        log_config=None,  # configured by `start_logs`
        access_log=False,  # the service logs requests itself
        loop="uvloop",
        http=guarded(settings),
        ws=StreamProtocol,
        ws_max_size=MAX_FRAME_BYTES,
        ws_per_message_deflate=False,
        timeout_keep_alive=settings.keep_alive_s,
        timeout_graceful_shutdown=sockets.DRAIN_S,
        forwarded_allow_ips=settings.trusted_proxies,
    )
    sockets.serve(config, settings.uds, settings.uds_mode, served.state.stopping, settings.stop_notice_s)
