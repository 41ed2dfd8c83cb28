"""Calls for predictions and evaluations, the Open Inference Protocol, and the state of the service."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from lipserve.call import Answer, Call, Route, document, given, record, route, split_name
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
from lipserve.results.series import (
    Component,
    Prediction,
    Trace,
    Wrench,
    read_component,
    read_prediction,
    read_trace,
    read_wrench,
)


def _query(
    model: str,
    version: int | None,
    alias: str | None,
    min_revision: int | None,
    payload: Mapping[str, ArrayLike] | None,
    **arrays: ArrayLike | None,
) -> tuple[str, dict[str, Any]]:
    """Return the name of a model and the body of a query. arrays: those that are not None are sent, as numbers."""
    name, which = split_name(model, version, alias)
    body = {key: np.asarray(each, dtype=np.float64).tolist() for key, each in arrays.items() if each is not None}
    if payload is not None:
        body["payload"] = {key: np.asarray(each).tolist() for key, each in payload.items()}
    return name, body | which | given(min_revision=min_revision)


@route("POST", "/v1/models/{model}/predict", repeatable=True)
def predict(
    _route: Route,
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
    t: ArrayLike | None = None,
    history: tuple[ArrayLike, ArrayLike, ArrayLike] | None = None,
) -> Call[Prediction]:
    """Predict torques and their standard deviations at one or N motions.

    Args:
        model: Name of the model, also as `NAME@3` or `NAME@ALIAS`.
        q: (n,) or (N, n) positions, rad (prismatic: m).
        dq: Velocities, rad/s, shaped as q.
        ddq: Accelerations, rad/s², shaped as q.
        version: Version number. Default: the serving version.
        covariance: Return the covariance between joints too.
        components: Components to return too, e.g. `gravity` or `inertia_matrix`.
        tau: Torques, N·m, shaped as q; only for the component `forward_dynamics`.
        alias: Alias of the version, instead of its number.
        min_revision: Min revision of the answer, e.g. that of an acknowledged observation batch. The service waits
            for it and answers 503 if that takes too long.
        payload: `mass`, kg; `com`, (3,) m, in the frame of the last link; optional `inertia`, (3, 3) kg·m², about
            the centre of mass (default: a point mass).
        t: Times, s: (N,) if the rows are one motion in order of time, which friction that remembers then follows; or
            one number for one motion with a history. Default: each row is a query alone.
        history: Motion before the first row: times (M,) by the same clock, positions (M, n), velocities (M, n).

    Returns:
        The prediction, shaped as q.

    Raises:
        ApiError: The request is invalid, or there is no such model or version.

    Example:
        >>> answer = client.predict("panda-sim", [0.0] * 7, [0.0] * 7, [0.0] * 7)
        >>> lower, upper = answer.interval(0.95)
        >>> rows = client.predict("panda-sim", q, dq, ddq, t=t, history=(t_before, q_before, dq_before))
    """
    name, body = _query(model, version, alias, min_revision, payload, q=q, dq=dq, ddq=ddq, tau=tau, t=t)
    body |= {"covariance": covariance, "components": list(components)}
    if t is not None and np.ndim(q) > 1:
        body["trajectory"] = True
    if history is not None:
        parts = zip(("t", "q", "dq"), history, (1, 2, 2), strict=True)
        body["history"] = {name: np.array(values, np.float64, ndmin=axes).tolist() for name, values, axes in parts}
    return _route(read_prediction, names={"model": name}, json=body)


@route("POST", "/v1/models/{model}/gravity", repeatable=True)
def gravity(
    _route: Route,
    model: str,
    q: ArrayLike,
    version: int | None = None,
    alias: str | None = None,
    min_revision: int | None = None,
    payload: Mapping[str, ArrayLike] | None = None,
) -> Call[Component]:
    """Return the torque that holds the arm against gravity at one or N postures.

    Args:
        model: Name of the model, also as `NAME@3` or `NAME@ALIAS`.
        q: (n,) or (N, n) positions, rad (prismatic: m).
        version: Version number. Default: the serving version.
        alias: Alias of the version, instead of its number.
        min_revision: Min revision of the answer; see `predict`.
        payload: As in `predict`.

    Returns:
        Mean and standard deviation, shaped as q, N·m (prismatic: N).

    Example:
        >>> client.gravity("panda-sim", [0.0] * 7).mean
    """
    name, body = _query(model, version, alias, min_revision, payload, q=q)
    return _route(read_component, names={"model": name}, json=body)


@route("POST", "/v1/models/{model}/wrench", repeatable=True)
def wrench(
    _route: Route,
    model: str,
    q: ArrayLike,
    dq: ArrayLike,
    ddq: ArrayLike,
    tau: ArrayLike,
    tool: ArrayLike | None = None,
    version: int | None = None,
    alias: str | None = None,
    min_revision: int | None = None,
    payload: Mapping[str, ArrayLike] | None = None,
) -> Call[Wrench]:
    """Return the force and moment on the last link that explain a measured torque, at one or N motions.

    It is not a safety function.

    Args:
        model: Name of the model, also as `NAME@3` or `NAME@ALIAS`. It needs the geometry of a URDF.
        q: (n,) or (N, n) positions, rad (prismatic: m).
        dq: Velocities, same shape, rad/s (m/s).
        ddq: Accelerations, same shape, rad/s² (m/s²).
        tau: Measured torque, same shape, N·m (N).
        tool: Pose of the tool's frame in the last link's, (4, 4), m. Default: the last link's own frame.
        version: Version number. Default: the serving version.
        alias: Alias of the version, instead of its number.
        min_revision: Min revision of the answer; see `predict`.
        payload: As in `predict`.

    Returns:
        Force and moment in the axes of the last link or tool and of the base, with their covariances.

    Raises:
        ApiError: The model has no such geometry, or the posture is singular.

    Example:
        >>> client.wrench("my-ur10", q, dq, ddq, tau).base
    """
    name, body = _query(model, version, alias, min_revision, payload, q=q, dq=dq, ddq=ddq, tau=tau, tool=tool)
    return _route(read_wrench, names={"model": name}, json=body)


@route("POST", "/v1/models/{model}/evaluate", repeatable=True)
def evaluate(
    _route: Route,
    model: str,
    dataset: str,
    version: int | None = None,
    alias: str | None = None,
    part: Literal["all", "held_out"] = "all",
    min_revision: int | None = None,
) -> Call[Evaluation]:
    """Evaluate a model on a data set.

    Args:
        model: Name of the model, also as `NAME@3` or `NAME@ALIAS`.
        dataset: Id or name of the data set.
        version: Version number. Default: the serving version.
        alias: Alias of the version, instead of its number.
        part: `held_out`: only the part that the version's training held out. If the version was trained on that part
            afterwards, the figures are those of the fit without it.
        min_revision: Min revision of the version; see `predict`.

    Returns:
        Figures per joint.

    Example:
        >>> print(client.evaluate("panda-sim", "ds_0123456789abcdef"))
    """
    name, which = split_name(model, version, alias)
    body = {"dataset": dataset, "part": part} | which | given(min_revision=min_revision)
    return _route(read_evaluation, names={"model": name}, json=body)


@route("POST", "/v1/models/{model}/compare", repeatable=True)
def compare(_route: Route, model: str, dataset: str, first: int | str, second: int | str) -> Call[Comparison]:
    """Compare two versions on a data set. first, second: version numbers or aliases."""
    body = {"dataset": dataset, "versions": [first, second]}
    return _route(read_comparison, names={"model": model}, json=body)


@route("POST", "/v1/models/{model}/trace", repeatable=True)
def trace(
    _route: Route,
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
    """Return measured and predicted torque at rows of a data set.

    Args:
        model: Name of the model, also as `NAME@3` or `NAME@ALIAS`.
        dataset: Id or name of the data set.
        version: Version number. Default: the serving version.
        alias: Alias of the version, instead of its number.
        part: `held_out`: only the part that the version's training held out.
        start: First row.
        stop: Row to stop before. Default: the end.
        points: Max number of rows; if there are more, they are chosen evenly.
        components: Components of the torque to return too.
    """
    body = {"dataset": dataset, "part": part, "start": start, "points": points, "components": list(components)}
    name, which = split_name(model, version, alias)
    body |= which | given(stop=stop)
    return _route(read_trace, names={"model": name}, json=body)


V2_MODEL, V2_VERSION = "/v2/models/{model}", "/v2/models/{model}/versions/{version}"


@route("GET", "/health")
def abilities(_route: Route) -> Call[Health]:
    """Return the abilities of the service: which extras are installed."""
    return _route(record(Health), names={})


@route("GET", "/health/live")
def live_health(_route: Route) -> Call[Live]:
    """Check that the process of the service is alive."""
    return _route(record(Live), names={})


@route("GET", "/health/ready", repeatable=False)
def health(_route: Route) -> Call[Ready]:
    """Return the state of the parts of the service; raise ApiError if it is not ready. See `ready`."""
    return _route(record(Ready), names={})


@route("GET", "/metrics")
def metrics(_route: Route) -> Call[str]:
    """Return the metrics in the text format of Prometheus."""
    return _route(lambda answer: answer.body.decode(), names={})


@route("POST", "/v1/echo", repeatable=True)
def echo(_route: Route, body: Any) -> Call[Any]:
    """Return the JSON that was sent. It measures the cost of a request without computation."""
    return _route(document, names={}, json=body)


@route("GET", "/v2")
def server_metadata(_route: Route) -> Call[ServerMetadata]:
    """Return name, version and extensions of the server (Open Inference Protocol)."""
    return _route(record(ServerMetadata), names={})


@route("GET", "/v2/health/live")
def server_live(_route: Route) -> Call[ServerLive]:
    """Return whether the server is alive (Open Inference Protocol)."""
    return _route(record(ServerLive), names={})


@route("GET", "/v2/health/ready", repeatable=False)
def server_ready(_route: Route) -> Call[ServerReady]:
    """Return whether the server is ready (Open Inference Protocol)."""
    return _route(record(ServerReady), names={})


@route("GET", V2_MODEL, V2_VERSION)
def model_metadata(_route: Route, model: str, version: int | None = None) -> Call[ModelMetadata]:
    """Return the tensors of a model (Open Inference Protocol)."""
    return _route(record(ModelMetadata), names={"model": model, "version": version})


@route("GET", V2_MODEL + "/ready", V2_VERSION + "/ready")
def model_ready(_route: Route, model: str, version: int | None = None) -> Call[ModelReady]:
    """Return whether a model is ready (Open Inference Protocol)."""
    return _route(record(ModelReady), names={"model": model, "version": version})


@route("POST", V2_MODEL + "/infer", V2_VERSION + "/infer", repeatable=True)
def infer(
    _route: Route, model: str, inputs: Mapping[str, ArrayLike], outputs: Sequence[str] = (), version: int | None = None
) -> Call[dict[str, Array]]:
    """Run a model on named tensors (Open Inference Protocol). `predict` does the same with described results.

    Args:
        model: Name of the model, also as `NAME@3` or `NAME@ALIAS`.
        inputs: Tensors by name, sent as FP64.
        outputs: Names of the outputs. Default: all.
        version: Version number. Default: the serving version.

    Returns:
        Tensors by name.
    """
    tensors = []
    for name, values in inputs.items():
        numbers = np.asarray(values, np.float64)
        shape = list(numbers.shape)
        tensors.append({"name": name, "shape": shape, "datatype": "FP64", "data": numbers.ravel().tolist()})
    body: dict[str, Any] = {"inputs": tensors, **given(outputs=[{"name": name} for name in outputs] or None)}
    return _route(_tensors, names={"model": model, "version": version}, json=body)


def _tensors(answer: Answer) -> dict[str, Array]:
    document = msgspec.json.decode(answer.body)
    return {each["name"]: array(each["data"]).reshape(each["shape"]) for each in document["outputs"]}
