"""The Open Inference Protocol over gRPC: its messages, its methods, and who listens. Needs the extra `grpc`, which is
imported where a service listens for it."""

import socket

from lipcore import extras
from service.foundation.settings import Settings


class PortError(OSError):
    """Nothing can listen at the port; the message says why."""


def check_installed(settings: Settings) -> bool:
    """Whether the service shall listen for gRPC; raise MissingExtraError."""
    if settings.grpc_port is None:
        return False
    extras.check_extra("grpc", "LIPSERVE_GRPC_PORT is set")
    return True


def check_port(settings: Settings) -> None:
    """Look before the service starts whether its port for gRPC is free; raise PortError."""
    if not settings.grpc_port:
        return
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    try:
        socket.create_server((settings.host, settings.grpc_port), family=family).close()
    except OSError as error:
        raise taken(settings, error.strerror or str(error)) from error


def taken(settings: Settings, reason: str) -> PortError:
    """The error of a port at which nothing can listen."""
    return PortError(f"LIPSERVE_GRPC_PORT is {settings.grpc_port}, expected a port that is free: {reason}")
