"""What the documentation says of the protocol's routes: their bodies are no pydantic models, and are described here."""

from __future__ import annotations

from typing import Any

import msgspec

from service.oip.schema import Failure, InferRequest, InferResponse
from service.oip.wire import HEADER

MODEL = {"name": "model", "in": "path", "required": True, "schema": {"type": "string"}}
VERSION = {
    "name": "version",
    "in": "path",
    "required": True,
    "schema": {"type": "string"},
    "description": "A version's number, or an alias",
}
_POSTURE = [0.0, -0.5, 0.0, -2.0, 0.0, 1.5, 0.7]
REQUEST: dict[str, Any] = {
    "id": "42",
    "inputs": [
        {"name": "q", "shape": [7], "datatype": "FP64", "data": _POSTURE},
        {"name": "dq", "shape": [7], "datatype": "FP64", "data": [0.1, 0.0, 0.0, 0.2, 0.0, 0.0, 0.0]},
        {"name": "ddq", "shape": [7], "datatype": "FP64", "data": [0.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0]},
    ],
    "outputs": [{"name": "tau"}, {"name": "tau_std"}],
}
RESPONSE: dict[str, Any] = {
    "id": "42",
    "model_name": "panda-sim",
    "model_version": "1",
    "parameters": {"revision": 0, "torque_convention": "gravity_included"},
    "outputs": [
        {"name": "tau", "datatype": "FP64", "shape": [7], "data": [-0.01, -11.28, -0.46, 21.11, 0.62, 2.26, 0.0]},
        {"name": "tau_std", "datatype": "FP64", "shape": [7], "data": [0.01, 0.01, 0.0, 0.01, 0.0, 0.0, 0.0]},
    ],
}
_FAILURES = {
    400: "The request is wrong: `error` names the field, its value and what was expected",
    404: "No model or version of that name",
    413: "The body has more bytes than are taken",
    415: "The body is compressed",
    503: "The service, or the version, cannot answer now",
}
_LENGTH = "Bytes of the JSON, where binary tensors follow it in the order of the tensors"
_BINARY = {
    "schema": {
        "type": "string",
        "format": "binary",
        "description": "The JSON, then the binary tensors: little-endian, row-major, without padding",
    }
}


def failures(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """OpenAPI responses of a route for the errors that it can answer with."""
    return {status: {"model": Failure, "description": _FAILURES[status]} for status in statuses}


def infer_body(path: dict[str, Any]) -> dict[str, Any]:
    """Body and parameters of an inference request, those of its path among them."""
    content = {"application/json": {"schema": _schema(InferRequest), "example": REQUEST}}
    header = {"name": HEADER, "in": "header", "required": False, "schema": {"type": "integer"}, "description": _LENGTH}
    return {
        "requestBody": {"required": True, "content": {**content, "application/octet-stream": {**_BINARY}}},
        "parameters": [*path["parameters"], header],
    }


def infer_answer() -> dict[str, Any]:
    """The answer to an inference request."""
    return {
        "description": "The tensors asked for, shaped as the query",
        "headers": {HEADER: {"schema": {"type": "integer"}, "description": _LENGTH}},
        "content": {
            "application/json": {"schema": _schema(InferResponse), "example": RESPONSE},
            "application/octet-stream": {**_BINARY},
        },
    }


def _schema(message: type[msgspec.Struct]) -> dict[str, Any]:
    """JSON schema of a message with all that it refers to in place."""
    whole = msgspec.json.schema(message)
    inlined: dict[str, Any] = _inline(whole["$defs"][message.__name__], whole["$defs"])
    return inlined


def _inline(node: Any, known: dict[str, Any]) -> Any:
    if isinstance(node, dict):
        if "$ref" in node:
            return _inline(known[node["$ref"].rpartition("/")[2]], known)
        return {key: _inline(value, known) for key, value in node.items()}
    return [_inline(item, known) for item in node] if isinstance(node, list) else node
