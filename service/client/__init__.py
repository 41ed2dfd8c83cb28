"""Python client of the service."""

from service.client.asynchronous import AsyncClient
from service.client.results.evaluation import Comparison, Evaluation
from service.client.results.series import Component, LiveRows, Prediction, Preview, Trace
from service.client.sending import ApiError, ServiceUnreachableError
from service.client.sync import Client

__all__ = [
    "ApiError",
    "AsyncClient",
    "Client",
    "Comparison",
    "Component",
    "Evaluation",
    "LiveRows",
    "Prediction",
    "Preview",
    "ServiceUnreachableError",
    "Trace",
]
