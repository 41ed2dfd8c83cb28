"""Python client of LIPServe: predicts torques, sends observations, trains and manages models.

The environment variables `LIPSERVE_URL` and `LIPSERVE_API_KEY` set the default address and API key.

Example:
    >>> from lipserve import Client
    >>> with Client("http://127.0.0.1:8000") as client:
    ...     answer = client.predict("panda-sim", [0.0] * 7, [0.0] * 7, [0.0] * 7)
    >>> answer.tau.shape
    (7,)
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lipserve.alarms import AlarmEvent, SignatureError, read_alarm_event
    from lipserve.answers import StreamError
    from lipserve.asynchronous import AsyncClient
    from lipserve.asynchronous_stream import AsyncStreamClient
    from lipserve.results.evaluation import Comparison, Evaluation
    from lipserve.results.series import Component, LiveRows, Prediction, Preview, Trace, Wrench
    from lipserve.sending import ApiError, ServiceUnreachableError
    from lipserve.stream import StreamClient
    from lipserve.sync import Client

__version__ = "0.2.0"
"""Version of the client and of the service: both distributions read it here."""

_HOMES = {
    "AlarmEvent": "alarms",
    "ApiError": "sending",
    "AsyncClient": "asynchronous",
    "AsyncStreamClient": "asynchronous_stream",
    "Client": "sync",
    "Comparison": "results.evaluation",
    "Component": "results.series",
    "Evaluation": "results.evaluation",
    "LiveRows": "results.series",
    "Prediction": "results.series",
    "Preview": "results.series",
    "ServiceUnreachableError": "sending",
    "SignatureError": "alarms",
    "StreamClient": "stream",
    "StreamError": "answers",
    "Trace": "results.series",
    "Wrench": "results.series",
    "read_alarm_event": "alarms",
}
"""Module of each exported name. Names are imported on first use: the service imports modules of this package."""

__all__ = [
    "AlarmEvent",
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
    "SignatureError",
    "StreamClient",
    "StreamError",
    "Trace",
    "Wrench",
    "__version__",
    "read_alarm_event",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
