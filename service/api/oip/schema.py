"""Messages of the Open Inference Protocol, decoded and encoded by msgspec, and their OpenAPI documentation."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import msgspec
from msgspec import UNSET, Meta, Struct, UnsetType
from pydantic import BaseModel, Field

INPUTS = ("q", "dq", "ddq")
"""Inputs that every request needs; `forward_dynamics` and `tau_external` also need TORQUE."""
TORQUE = "tau"
DATATYPES = ("FP64", "FP32")
HEADER = "Inference-Header-Content-Length"
BINARY = "binary_tensor_data"
EXTENSIONS = [BINARY, "sequence", "sequence(string_id)", "model_repository", "model_configuration", "statistics"]
"""Supported extensions in the server's metadata."""
SEQUENCE_ID_CHARACTERS = 128
SEQUENCE_ID = f"a whole number from 1 to {2**64 - 1}, or a string of 1 to {SEQUENCE_ID_CHARACTERS} characters"
"""The values that `sequence_id` may have."""

Size = Annotated[int, Meta(ge=0)]
Numbers = list[float | list[float]]


class InputParameters(Struct):
    """Supported parameters of an input. Others are ignored, as the protocol requires."""

    binary_data_size: Annotated[Size | None, Meta(description="Size of this tensor after the JSON, bytes")] = None
    shared_memory_region: Annotated[str | None, Meta(description="Not supported")] = None


class OutputParameters(Struct):
    """Supported parameters of an output. Others are ignored."""

    binary_data: Annotated[bool | None, Meta(description="Return this tensor in binary, after the JSON")] = None
    shared_memory_region: Annotated[str | None, Meta(description="Not supported")] = None
    classification: Annotated[int | None, Meta(description="Not supported")] = None


class RequestParameters(Struct):
    """Supported parameters of a request. Others are ignored."""

    binary_data_output: Annotated[
        bool | None, Meta(description="Return all tensors in binary, unless their own `binary_data` is given")
    ] = None
    sequence_id: Annotated[
        int | str | None,
        Meta(description=f"Sequence of the request, whose queries are one motion: {SEQUENCE_ID}"),
    ] = None
    sequence_start: Annotated[bool | None, Meta(description="Forget the earlier queries of the sequence")] = None
    sequence_end: Annotated[bool | None, Meta(description="Forget the sequence after this request")] = None


class InferInput(Struct, forbid_unknown_fields=True):
    """An input tensor. Its numbers are in `data`, or in binary after the JSON if `binary_data_size` is given."""

    name: Annotated[str, Meta(description="q, dq or ddq; also tau for `forward_dynamics` and `tau_external`")]
    shape: Annotated[list[Size], Meta(description="[n] for one query, [N, n] for a batch")]
    datatype: Annotated[str, Meta(description="FP64 or FP32")]
    data: Annotated[Numbers | None, Meta(description="Numbers in row-major order, flat or in rows")] = None
    parameters: InputParameters | None = None


class InferOutput(Struct, forbid_unknown_fields=True):
    """A requested output tensor."""

    name: str
    parameters: OutputParameters | None = None


class InferRequest(Struct, forbid_unknown_fields=True):
    """A query or a batch of queries, in SI units."""

    inputs: list[InferInput]
    outputs: Annotated[
        list[InferOutput] | None, Meta(description="Outputs to compute. Default, also if empty: tau and tau_std")
    ] = None
    id: Annotated[str | None, Meta(description="Returned unchanged")] = None
    parameters: RequestParameters | None = None
    model_name: Annotated[str | None, Meta(description="If given, the name in the path")] = None
    model_version: Annotated[str | None, Meta(description="If given, the number of the version that answers")] = None


class TensorParameters(Struct):
    """Parameters of an output tensor."""

    binary_data_size: Annotated[int, Meta(description="Size of this tensor after the JSON, bytes")]


class InferTensor(Struct):
    """An output tensor. Its numbers are in `data`, flat in row-major order, or in binary after the JSON."""

    name: str
    datatype: Literal["FP64"]
    shape: list[int]
    parameters: TensorParameters | UnsetType = UNSET
    data: list[float] | UnsetType = UNSET


class AnswerParameters(Struct):
    """Revision and torque convention of an answer."""

    revision: Annotated[int, Meta(description="Number of online updates applied to the version")]
    torque_convention: Annotated[str, Meta(description="gravity_included or gravity_compensated")]


class InferResponse(Struct):
    """The requested outputs, in the requested order, and the version that answered."""

    model_name: str
    model_version: str
    parameters: AnswerParameters
    outputs: list[InferTensor]
    id: str | UnsetType = UNSET


class Failure(BaseModel):
    """The body of every /v2 answer with a status of 400 or above."""

    error: str = Field(examples=["q[3] is nan, expected a finite number"])


class ServerMetadata(BaseModel):
    """Name and version of the server, and the supported extensions of the protocol."""

    name: str = Field(examples=["lipserve"])
    version: str
    extensions: list[str] = Field(examples=[EXTENSIONS])


class ServerLive(BaseModel):
    """The process is alive."""

    live: Literal[True] = True


class ServerReady(BaseModel):
    """The service can answer queries."""

    ready: Literal[True] = True


class ModelReady(BaseModel):
    """The version is in memory and can answer."""

    name: str
    ready: Literal[True] = True


class TensorMetadata(BaseModel):
    """A tensor of a model. -1 stands for the number of queries N; the inputs of a single query may omit this axis."""

    name: str
    datatype: Literal["FP64"] = Field("FP64", description="Inputs may also be FP32")
    shape: list[int]
    parameters: dict[str, Any] | None = Field(None, description="`optional`: only some outputs need this input")


class ModelMetadata(BaseModel):
    """Tensors and versions of a model."""

    name: str
    versions: list[str] = Field(description="Versions that a path may name; without one, the serving version answers")
    platform: str = Field(description="`lipserve_` and the name of the estimator", examples=["lipserve_lip-chain"])
    inputs: list[TensorMetadata]
    outputs: list[TensorMetadata]
    parameters: dict[str, Any] = Field(
        description="`version` and `revision` described here, `torque_convention`, and `joint_names`, comma-separated",
    )


MODEL = {"name": "model", "in": "path", "required": True, "schema": {"type": "string"}}
VERSION = {
    "name": "version",
    "in": "path",
    "required": True,
    "schema": {"type": "string"},
    "description": "A version's number or an alias",
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
    400: "The request is wrong. `error` names the field, its value and what was expected",
    404: "The model or version does not exist",
    413: "The body is too large",
    415: "The body is compressed",
    503: "The service or the version is not ready",
}
_LENGTH = "Length of the JSON in bytes, if binary tensors follow it. They are in the order of the tensors"
_BINARY = {
    "schema": {
        "type": "string",
        "format": "binary",
        "description": "The JSON followed by the binary tensors: little-endian, row-major, without padding",
    }
}


def failures(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Return the OpenAPI responses for error statuses."""
    return {status: {"model": Failure, "description": _FAILURES[status]} for status in statuses}


def infer_body(path: dict[str, Any]) -> dict[str, Any]:
    """Return the OpenAPI body and parameters of an inference request, including those of its path."""
    content = {"application/json": {"schema": _schema(InferRequest), "example": REQUEST}}
    header = {"name": HEADER, "in": "header", "required": False, "schema": {"type": "integer"}, "description": _LENGTH}
    return {
        "requestBody": {"required": True, "content": {**content, "application/octet-stream": {**_BINARY}}},
        "parameters": [*path["parameters"], header],
    }


def infer_answer() -> dict[str, Any]:
    """Return the OpenAPI response of an inference request."""
    return {
        "description": "The requested outputs, with the shape of the query",
        "headers": {HEADER: {"schema": {"type": "integer"}, "description": _LENGTH}},
        "content": {
            "application/json": {"schema": _schema(InferResponse), "example": RESPONSE},
            "application/octet-stream": {**_BINARY},
        },
    }


def _schema(message: type[msgspec.Struct]) -> dict[str, Any]:
    """Return the JSON schema of a message with all references inlined."""
    document = msgspec.json.schema(message)
    inlined: dict[str, Any] = _inline(document["$defs"][message.__name__], document["$defs"])
    return inlined


def _inline(node: Any, known: dict[str, Any]) -> Any:
    if isinstance(node, dict):
        if "$ref" in node:
            return _inline(known[node["$ref"].rpartition("/")[2]], known)
        return {key: _inline(value, known) for key, value in node.items()}
    return [_inline(item, known) for item in node] if isinstance(node, list) else node
