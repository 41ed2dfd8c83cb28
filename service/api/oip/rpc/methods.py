"""Methods of the gRPC service, as routes of the application.

A call goes through the same middleware as an HTTP request. HTTP requests do not reach these routes.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any, NamedTuple

from anyio import to_thread
from google.protobuf.json_format import ParseDict
from starlette.datastructures import State
from starlette.routing import BaseRoute, Match
from starlette.types import Receive, Scope, Send

from service import __version__
from service.api.access.scopes import PREDICT, READ, Rule
from service.api.elsewhere import Elsewhere
from service.api.oip import dataplane, extensions, schema
from service.api.oip.rpc.definition import SERVICE, message
from service.api.oip.rpc.messages import InferRequest, Message, decode, decode_request, encode
from service.api.route import Reply
from service.api.routes import health
from service.foundation.errors import NotReadyError, invalid_request

CALL = "lipserve.call"
"""Key that marks the ASGI scope of a gRPC call. HTTP requests do not have it."""

_TYPE_FP64 = 12
"""Number of TYPE_FP64 in the published definition."""
Answerer = Callable[[State, Scope, bytes], Awaitable[Reply]]


class Method(NamedTuple):
    """A method; `path` is its gRPC path, which metrics and logs use as the route."""

    path: str
    answer: Answerer
    rule: Rule


class Methods(BaseRoute):
    """The route of all methods. It has no path of its own."""

    path = ""

    @property
    def calls(self) -> dict[str, Rule]:
        """The access rule of every method, by path."""
        return {path: method.rule for path, method in METHODS.items()}

    def matches(self, scope: Scope) -> tuple[Match, Scope]:
        """Match the scope of a gRPC call to one of the methods."""
        method = METHODS.get(scope["path"]) if CALL in scope else None
        return (Match.NONE, {}) if method is None else (Match.FULL, {"route": method, "path_params": {}})

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a call; raise ServiceError."""
        sent = await receive()
        reply = await scope["route"].answer(scope["app"].state, scope, sent["body"])
        await send({"type": "http.response.start", "status": 200, "headers": reply.headers()})
        await send({"type": "http.response.body", "body": reply.body})


async def _server_live(state: State, scope: Scope, body: bytes) -> Reply:
    decode(message("ServerLiveRequest"), body)
    return encode(message("ServerLiveResponse")(live=True))


async def _server_ready(state: State, scope: Scope, body: bytes) -> Reply:
    decode(message("ServerReadyRequest"), body)
    try:
        await to_thread.run_sync(health.ready, state.readiness)
    except NotReadyError:
        return encode(message("ServerReadyResponse")(ready=False))
    return encode(message("ServerReadyResponse")(ready=True))


async def _server_metadata(state: State, scope: Scope, body: bytes) -> Reply:
    decode(message("ServerMetadataRequest"), body)
    return encode(message("ServerMetadataResponse")(name="lipserve", version=__version__, extensions=schema.EXTENSIONS))


async def _model_ready(state: State, scope: Scope, body: bytes) -> Reply:
    name, version = _model(scope, decode(message("ModelReadyRequest"), body), "name", "version")
    try:
        await dataplane.ready(state.loaded, state.turns.predictions, name, version)
    except NotReadyError:
        return encode(message("ModelReadyResponse")(ready=False))
    return encode(message("ModelReadyResponse")(ready=True))


async def _model_metadata(state: State, scope: Scope, body: bytes) -> Reply:
    name, version = _model(scope, decode(message("ModelMetadataRequest"), body), "name", "version")
    served = await dataplane.find(state.loaded, state.turns.predictions, name, version)
    description = await to_thread.run_sync(dataplane.metadata, state.loaded, served)
    answer = message("ModelMetadataResponse")(
        name=description.name, versions=description.versions, platform=description.platform
    )
    for tensors, described in ((answer.inputs, description.inputs), (answer.outputs, description.outputs)):
        for each in described:
            tensors.add(name=each.name, datatype=each.datatype, shape=each.shape)
    return encode(answer)


async def _model_infer(state: State, scope: Scope, body: bytes) -> Reply:
    sent = decode(InferRequest, body)
    name, version = _model(scope, sent, "model_name", "model_version")
    return await dataplane.infer(
        state.loaded,
        state.sequences,
        state.statistics,
        state.turns.predictions,
        Elsewhere(state),
        name,
        version,
        body,
        partial(Message, sent),
        decode_request,
    )


async def _infer_at_once(state: State, scope: Scope, body: bytes) -> Reply | None:
    """Answer a single query without waiting; return None for any other. Raise ServiceError for a wrong one."""
    if len(body) > dataplane.MAX_INLINE_BYTES:
        return None
    sent = decode(InferRequest, body)
    name, version = _model(scope, sent, "model_name", "model_version")
    return dataplane.infer_at_once(
        state.loaded, state.sequences, state.statistics, name, version, partial(Message, sent)
    )


def _document(name: str, document: dict[str, Any]) -> Reply:
    """Return the reply with a message of these fields; others are left out."""
    return encode(ParseDict(document, message(name)(), ignore_unknown_fields=True))


async def _repository_index(state: State, scope: Scope, body: bytes) -> Reply:
    ready = decode(message("RepositoryIndexRequest"), body).ready
    models = await to_thread.run_sync(extensions.index, state.loaded, ready)
    return _document("RepositoryIndexResponse", {"models": models})


async def _model_load(state: State, scope: Scope, body: bytes) -> Reply:
    raise extensions.refuse_loading(decode(message("RepositoryModelLoadRequest"), body).model_name)


async def _model_config(state: State, scope: Scope, body: bytes) -> Reply:
    name, version = _model(scope, decode(message("ModelConfigRequest"), body), "name", "version")
    served = await dataplane.find(state.loaded, state.turns.predictions, name, version)
    return _document("ModelConfigResponse", {"config": extensions.config(served, _TYPE_FP64)})


async def _model_statistics(state: State, scope: Scope, body: bytes) -> Reply:
    sent = decode(message("ModelStatisticsRequest"), body)
    if sent.version:
        served = await dataplane.find(state.loaded, state.turns.predictions, *_model(scope, sent, "name", "version"))
        found = [state.statistics.show(served.name, served.version)]
    else:
        found = await to_thread.run_sync(extensions.statistics, state.statistics, state.loaded, sent.name or None)
    return _document("ModelStatisticsResponse", {"model_stats": found})


def _model(scope: Scope, sent: Any, name: str, version: str) -> tuple[str, str | None]:
    """Return the model and version that a message names, and store the model for metrics; raise InvalidRequestError."""
    model: str = getattr(sent, name)
    if not model:
        raise invalid_request(name, "missing", "the name of a model", f"`{name}` is required.")
    scope["path_params"]["model"] = model
    return model, getattr(sent, version) or None


METHODS = {
    f"/{SERVICE}/{name}": Method(f"/{SERVICE}/{name}", answer, Rule(scope))
    for name, answer, scope in (
        ("ServerLive", _server_live, None),
        ("ServerReady", _server_ready, None),
        ("ServerMetadata", _server_metadata, READ),
        ("ModelReady", _model_ready, READ),
        ("ModelMetadata", _model_metadata, READ),
        ("ModelInfer", _model_infer, PREDICT),
        ("RepositoryIndex", _repository_index, READ),
        ("RepositoryModelLoad", _model_load, READ),
        ("RepositoryModelUnload", _model_load, READ),
        ("ModelConfig", _model_config, READ),
        ("ModelStatistics", _model_statistics, READ),
    )
}
AT_ONCE = {f"/{SERVICE}/ServerLive": _server_live, f"/{SERVICE}/ModelInfer": _infer_at_once}
"""What the data plane answers, by path: without waiting, or None to leave the call to the control plane."""
