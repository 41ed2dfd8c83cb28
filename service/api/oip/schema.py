"""Messages of the Open Inference Protocol, which msgspec decodes and encodes, and what the documentation says of it."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import msgspec
from msgspec import UNSET, Meta, Struct, UnsetType
from pydantic import BaseModel, Field

INPUTS = ("q", "dq", "ddq")
"""Tensors that every request brings; `forward_dynamics` and `tau_external` also need TORQUE."""
TORQUE = "tau"
DATATYPES = ("FP64", "FP32")
HEADER = "Inference-Header-Content-Length"
BINARY = "binary_tensor_data"
"""The extension that is supported, by its name in the server's metadata."""

Size = Annotated[int, Meta(ge=0)]
Numbers = list[float | list[float]]


class InputParameters(Struct):
    """Parameters of an input that are understood; others are ignored, as the protocol has it."""

    binary_data_size: Annotated[Size | None, Meta(description="Bytes of this tensor after the JSON")] = None
    shared_memory_region: Annotated[str | None, Meta(description="Not supported")] = None


class OutputParameters(Struct):
    """Parameters of an output that are understood; others are ignored."""

    binary_data: Annotated[bool | None, Meta(description="Whether to answer this tensor after the JSON")] = None
    shared_memory_region: Annotated[str | None, Meta(description="Not supported")] = None
    classification: Annotated[int | None, Meta(description="Not supported")] = None


class RequestParameters(Struct):
    """Parameters of a request that are understood; others are ignored."""

    binary_data_output: Annotated[
        bool | None, Meta(description="Whether to answer all tensors after the JSON that do not say otherwise")
    ] = None


class InferInput(Struct, forbid_unknown_fields=True):
    """One tensor: its numbers in `data`, or after the JSON with `binary_data_size`."""

    name: Annotated[str, Meta(description="q, dq, ddq or, for `forward_dynamics` and `tau_external`, tau")]
    shape: Annotated[list[Size], Meta(description="[n] for one query, [N, n] for a batch")]
    datatype: Annotated[str, Meta(description="FP64 or FP32")]
    data: Annotated[Numbers | None, Meta(description="Numbers in row-major order, flat or in rows")] = None
    parameters: InputParameters | None = None


class InferOutput(Struct, forbid_unknown_fields=True):
    """A tensor to answer."""

    name: str
    parameters: OutputParameters | None = None


class InferRequest(Struct, forbid_unknown_fields=True):
    """A query, or a batch of them, in SI units."""

    inputs: list[InferInput]
    outputs: Annotated[
        list[InferOutput] | None, Meta(description="What to compute; tau and tau_std where left out or empty")
    ] = None
    id: Annotated[str | None, Meta(description="Returned as it is")] = None
    parameters: RequestParameters | None = None
    model_name: Annotated[str | None, Meta(description="May repeat the name in the path")] = None
    model_version: Annotated[str | None, Meta(description="May repeat the version in the path")] = None


class TensorParameters(Struct):
    """Parameters of an answered tensor."""

    binary_data_size: Annotated[int, Meta(description="Bytes of this tensor after the JSON")]


class InferTensor(Struct):
    """An answered tensor: its numbers in `data`, flat and in row-major order, or after the JSON."""

    name: str
    datatype: Literal["FP64"]
    shape: list[int]
    parameters: TensorParameters | UnsetType = UNSET
    data: list[float] | UnsetType = UNSET


class AnswerParameters(Struct):
    """What an answer is to be taken for."""

    revision: Annotated[int, Meta(description="Online updates applied to the version")]
    torque_convention: Annotated[str, Meta(description="gravity_included or gravity_compensated")]


class InferResponse(Struct):
    """The tensors asked for, in that order, and the version that answered."""

    model_name: str
    model_version: str
    parameters: AnswerParameters
    outputs: list[InferTensor]
    id: str | UnsetType = UNSET


class Failure(BaseModel):
    """The body of every /v2 answer with a status of 400 and above."""

    error: str = Field(examples=["q[3] is nan, expected a finite number"])


class ServerMetadata(BaseModel):
    """What serves, and which extensions of the protocol it speaks."""

    name: str = Field(examples=["lipserve"])
    version: str
    extensions: list[str] = Field(examples=[[BINARY]])


class ServerLive(BaseModel):
    """The process answers."""

    live: Literal[True] = True


class ServerReady(BaseModel):
    """The service can answer queries."""

    ready: Literal[True] = True


class ModelReady(BaseModel):
    """The version is in memory and answers."""

    name: str
    ready: Literal[True] = True


class TensorMetadata(BaseModel):
    """A tensor of a model. -1 stands for the number of queries N; an input of one query may leave this axis out."""

    name: str
    datatype: Literal["FP64"] = Field("FP64", description="Inputs may also be FP32")
    shape: list[int]
    parameters: dict[str, Any] | None = Field(None, description="`optional`: an input that only some outputs need")


class ModelMetadata(BaseModel):
    """The tensors of a model and its versions."""

    name: str
    versions: list[str] = Field(description="Versions that a path may name; without one the latest answers")
    platform: str = Field(description="`lipserve_` and the estimator", examples=["lipserve_lip-chain"])
    inputs: list[TensorMetadata]
    outputs: list[TensorMetadata]
    parameters: dict[str, Any] = Field(
        description="`version` and `revision` described here, `torque_convention`, and `joint_names`, joined by commas",
    )


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
    document = msgspec.json.schema(message)
    inlined: dict[str, Any] = _inline(document["$defs"][message.__name__], document["$defs"])
    return inlined


def _inline(node: Any, known: dict[str, Any]) -> Any:
    if isinstance(node, dict):
        if "$ref" in node:
            return _inline(known[node["$ref"].rpartition("/")[2]], known)
        return {key: _inline(value, known) for key, value in node.items()}
    return [_inline(item, known) for item in node] if isinstance(node, list) else node
