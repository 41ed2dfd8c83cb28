"""Calls that ask a model for torques, or how well it knows them, in the service's own way and by the Open Inference
Protocol; and calls about the service itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from lipserve.call import Answer, Call, Route, document, given, record, route
from lipserve.records.server import (
    Health,
    Live,
    ModelMetadata,
    ModelReady,
    Ready,
    ServerLive,
    ServerMetadata,
    ServerReady,
)
from lipserve.results import Array, array
from lipserve.results.evaluation import Comparison, Evaluation, read_comparison, read_evaluation
from lipserve.results.series import Prediction, Trace, read_prediction, read_trace


@route("POST", "/v1/models/{model}/predict", repeatable=True)
def predict(
    at: Route,
    model: str,
    q: ArrayLike,
    dq: ArrayLike,
    ddq: ArrayLike,
    version: int | None = None,
    covariance: bool = False,
    components: Sequence[str] = (),
    tau: ArrayLike | None = None,
    alias: str | None = None,
    min_revision: int | None = None,
    payload: Mapping[str, ArrayLike] | None = None,
) -> Call[Prediction]:
    """Torque for arrays of shape (n,) or (N, n), and components by name; tau is for `forward_dynamics` only.

    The version that serves answers, unless one is named by its number or an alias. min_revision: of an acknowledgement,
    so that the answer contains what was taught, whichever service took it; refused with 503 where it takes too long.
    payload: what the arm carries, `mass` in kg, `com` (3,) m and, unless it is a point, `inertia` (3, 3) kg·m², both in
    the frame of the last link, the latter about the centre of mass.
    """
    body: dict[str, Any] = {"covariance": covariance, "components": list(components)}
    for name, values in (("q", q), ("dq", dq), ("ddq", ddq), ("tau", tau)):
        if values is not None:
            body[name] = np.asarray(values, dtype=np.float64).tolist()
    if payload is not None:
        body["payload"] = {name: np.asarray(value).tolist() for name, value in payload.items()}
    body |= given(version=version, alias=alias, min_revision=min_revision)
    return at(read_prediction, names={"model": model}, json=body)


@route("POST", "/v1/models/{model}/evaluate", repeatable=True)
def evaluate(
    at: Route,
    model: str,
    dataset: str,
    version: int | None = None,
    alias: str | None = None,
    part: Literal["all", "held_out"] = "all",
    min_revision: int | None = None,
) -> Call[Evaluation]:
    """Compare a model with a data set: the version that serves, unless one is named by its number or an alias.

    part: `held_out` compares with what the version's training has held out of the data set. If the version has learnt
    that since, the figures are of the judged fit. min_revision: as of `predict`.
    """
    body = {"dataset": dataset, "part": part} | given(version=version, alias=alias, min_revision=min_revision)
    return at(read_evaluation, names={"model": model}, json=body)


@route("POST", "/v1/models/{model}/compare", repeatable=True)
def compare(at: Route, model: str, dataset: str, first: int | str, second: int | str) -> Call[Comparison]:
    """Compare two versions, each a number or an alias, on a data set."""
    body = {"dataset": dataset, "versions": [first, second]}
    return at(read_comparison, names={"model": model}, json=body)


@route("POST", "/v1/models/{model}/trace", repeatable=True)
def trace(
    at: Route,
    model: str,
    dataset: str,
    version: int | None = None,
    alias: str | None = None,
    part: Literal["all", "held_out"] = "all",
    start: int = 0,
    stop: int | None = None,
    points: int = 1000,
    components: Sequence[str] = (),
) -> Call[Trace]:
    """Measured torque beside the model's at rows of a data set, evenly chosen where there are more than `points`.

    start, stop: first row and the one to end before; components: parts of the torque by name.
    """
    body = {"dataset": dataset, "part": part, "start": start, "points": points, "components": list(components)}
    body |= given(version=version, alias=alias, stop=stop)
    return at(read_trace, names={"model": model}, json=body)


V2_MODEL, V2_VERSION = "/v2/models/{model}", "/v2/models/{model}/versions/{version}"


@route("GET", "/health")
def abilities(at: Route) -> Call[Health]:
    """What the service can do: which extras are installed there."""
    return at(record(Health), names={})


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
    document = msgspec.json.decode(answer.body)
    return {each["name"]: array(each["data"]).reshape(each["shape"]) for each in document["outputs"]}
