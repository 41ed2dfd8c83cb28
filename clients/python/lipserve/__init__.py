"""Python client of LIPServe: asks a service for torques, teaches it, trains and manages its models.

`LIPSERVE_URL` and `LIPSERVE_API_KEY` say which service is asked, with which key, where a client is told neither.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lipserve.asynchronous import AsyncClient
    from lipserve.exchange import StreamError
    from lipserve.results.evaluation import Comparison, Evaluation
    from lipserve.results.series import Component, LiveRows, Prediction, Preview, Trace
    from lipserve.sending import ApiError, ServiceUnreachableError
    from lipserve.stream import AsyncStreamClient, StreamClient
    from lipserve.sync import Client

__version__ = "0.2.0"
"""Of the client and of the service: both distributions read it here."""

_HOMES = {
    "ApiError": "sending",
    "AsyncClient": "asynchronous",
    "AsyncStreamClient": "stream",
    "Client": "sync",
    "Comparison": "results.evaluation",
    "Component": "results.series",
    "Evaluation": "results.evaluation",
    "LiveRows": "results.series",
    "Prediction": "results.series",
    "Preview": "results.series",
    "ServiceUnreachableError": "sending",
    "StreamClient": "stream",
    "StreamError": "exchange",
    "Trace": "results.series",
}
"""Where each name is made: imported when it is asked for, as the service shares modules here and starts no client."""

__all__ = [
    "ApiError",
    "AsyncClient",
    "AsyncStreamClient",
    "Client",
    "Comparison",
    "Component",
    "Evaluation",
    "LiveRows",
    "Prediction",
    "Preview",
    "ServiceUnreachableError",
    "StreamClient",
    "StreamError",
    "Trace",
    "__version__",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
