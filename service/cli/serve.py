"""`lipserve serve`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from service.api.oip import rpc
from service.api.server import sockets
from service.api.server.configuration import configure_server
from service.app import create_app
from service.cli.options import alone, settings_of, start_logs
from service.runtime.allocator import limit_free_memory
from service.runtime.forking import ThreadsError
from service.storage.storage import HomeError, check_home

app = alone()
ERRORS = (HomeError, ThreadsError)


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
    rpc.check_installed(settings)
    rpc.check_port(settings)
    start_logs(settings)
    if settings.data_plane and sys.platform == "linux":
        from service.planes import serving  # noqa: PLC0415 - Linux only

        serving.serve(settings)
        return
    check_home(settings)  # before the app opens it, so that errors are printed without a traceback
    limit_free_memory()
    served = create_app(settings)
    config = configure_server(served, settings)
    sockets.serve(config, settings.uds, settings.uds_mode, served.state.stopping, settings.stop_notice_s)
