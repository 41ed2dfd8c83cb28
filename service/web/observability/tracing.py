"""Traces for OpenTelemetry: FastAPI's own, switched on by a setting and told where to by OpenTelemetry's variables."""

from __future__ import annotations

from collections.abc import MutableMapping
from importlib.util import find_spec
from typing import Any

from fastapi.telemetry import TelemetryConfig

from service.foundation.settings import Settings

EXPORTER = "opentelemetry.exporter.otlp.proto.http"
MONITORING = ("/health/", "/v2/health/", "/metrics")


def telemetry(settings: Settings) -> TelemetryConfig:
    """What FastAPI shall report; raise ValueError where the packages for it are missing.

    Metrics are at /metrics, and what went wrong is in the log, with the id of the request: neither goes this way.
    """
    on = settings.opentelemetry
    if on and not _installed():
        raise ValueError(
            f"LIPSERVE_OPENTELEMETRY is set, which needs the package {EXPORTER.replace('.', '-')}: "
            "pip install 'lipserve[opentelemetry]'"
        )
    return {
        "tracing": on,
        "metrics": False,
        "logs": False,
        "operation_spans": on,
        "auto_configure": on,
        "exclude": _of_monitoring,
    }


def _installed() -> bool:
    try:
        return find_spec(EXPORTER) is not None
    except ModuleNotFoundError:
        return False


def _of_monitoring(scope: MutableMapping[str, Any]) -> bool:
    path: str = scope["path"]
    return path.startswith(MONITORING)
