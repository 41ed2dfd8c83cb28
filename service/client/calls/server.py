"""Calls about the service itself, and those of the Open Inference Protocol."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from service.client.call import Answer, Call, Route, document, given, record, route
from service.client.results.arrays import Array, array
from service.oip.schema import ModelMetadata, ModelReady, ServerLive, ServerMetadata, ServerReady
from service.web.health_schema import Live, Ready

V2_MODEL, V2_VERSION = "/v2/models/{model}", "/v2/models/{model}/versions/{version}"


@route("GET", "/health/live")
def live_health(at: Route) -> Call[Live]:
    """Whether the process is alive: it answers."""
    return at(record(Live), names={})


@route("GET", "/health/ready", repeatable=False)
def health(at: Route) -> Call[Ready]:
    """What works of the service; raise ApiError where it cannot answer queries now. See `ready`."""
    return at(record(Ready), names={})


@route("GET", "/metrics")
def metrics(at: Route) -> Call[str]:
    """Metrics in the text format of Prometheus."""
    return at(lambda answer: answer.body.decode(), names={})


@route("POST", "/v1/echo", repeatable=True)
def echo(at: Route, body: Any) -> Call[Any]:
    """What was sent, as JSON: what a request costs before anything is computed."""
    return at(document, names={}, json=body)


@route("GET", "/v2")
def server_metadata(at: Route) -> Call[ServerMetadata]:
    """Name and version of the server, and the extensions of the Open Inference Protocol that it speaks."""
    return at(record(ServerMetadata), names={})


@route("GET", "/v2/health/live")
def server_live(at: Route) -> Call[ServerLive]:
    """Whether the server lives, by the Open Inference Protocol."""
    return at(record(ServerLive), names={})


@route("GET", "/v2/health/ready", repeatable=False)
def server_ready(at: Route) -> Call[ServerReady]:
    """Whether the server is ready, by the Open Inference Protocol."""
    return at(record(ServerReady), names={})


@route("GET", V2_MODEL, V2_VERSION)
def model_metadata(at: Route, model: str, version: int | None = None) -> Call[ModelMetadata]:
    """The tensors of a model, by the Open Inference Protocol."""
    return at(record(ModelMetadata), names={"model": model, "version": version})


@route("GET", V2_MODEL + "/ready", V2_VERSION + "/ready")
def model_ready(at: Route, model: str, version: int | None = None) -> Call[ModelReady]:
    """Whether a model answers, by the Open Inference Protocol."""
    return at(record(ModelReady), names={"model": model, "version": version})


@route("POST", V2_MODEL + "/infer", V2_VERSION + "/infer", repeatable=True)
def infer(
    at: Route, model: str, inputs: Mapping[str, ArrayLike], outputs: Sequence[str] = (), version: int | None = None
) -> Call[dict[str, Array]]:
    """Tensors by name for tensors by name, by the Open Inference Protocol; `predict` says more of what it answers."""
    tensors = []
    for name, values in inputs.items():
        numbers = np.asarray(values, np.float64)
        shape = list(numbers.shape)
        tensors.append({"name": name, "shape": shape, "datatype": "FP64", "data": numbers.ravel().tolist()})
    body: dict[str, Any] = {"inputs": tensors, **given(outputs=[{"name": name} for name in outputs] or None)}
    return at(_tensors, names={"model": model, "version": version}, json=body)


def _tensors(answer: Answer) -> dict[str, Array]:
    said = msgspec.json.decode(answer.body)
    return {each["name"]: array(each["data"]).reshape(each["shape"]) for each in said["outputs"]}
