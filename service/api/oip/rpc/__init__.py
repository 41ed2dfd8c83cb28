"""The Open Inference Protocol over gRPC. Its modules need the extra `grpc`."""

import socket

from lipcore import extras
from service.foundation.settings import Settings


class PortError(OSError):
    """The gRPC port cannot be opened."""


def check_installed(settings: Settings) -> bool:
    """Return whether gRPC is enabled; raise MissingExtraError if it is, but not installed."""
    if settings.grpc_port is None:
        return False
    extras.check_extra("grpc", "LIPSERVE_GRPC_PORT is set")
    return True


def choose_port(settings: Settings) -> Settings:
    """Return settings with the number of a free gRPC port if they leave the choice to the system.

    A process that takes the port over from another needs its number.
    """
    if settings.grpc_port != 0:
        return settings
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    with socket.create_server((settings.host, 0), family=family) as free:
        return settings.model_copy(update={"grpc_port": free.getsockname()[1]})


def check_port(settings: Settings) -> None:
    """Check that the gRPC port is free; raise PortError."""
    if not settings.grpc_port:
        return
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    try:
        socket.create_server((settings.host, settings.grpc_port), family=family).close()
    except OSError as error:
        raise port_error(settings, error.strerror or str(error)) from error


def port_error(settings: Settings, reason: str) -> PortError:
    """Return the error for a port that cannot be opened."""
    return PortError(f"LIPSERVE_GRPC_PORT is {settings.grpc_port}, expected a free port: {reason}")
