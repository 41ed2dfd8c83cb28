"""Messages of the Open Inference Protocol: those of inference are decoded and encoded by msgspec."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from msgspec import UNSET, Meta, Struct, UnsetType
from pydantic import BaseModel, Field

INPUTS = ("q", "dq", "ddq")
"""Tensors that every request brings; `forward_dynamics` also needs TORQUE."""
TORQUE = "tau"
DATATYPES = ("FP64", "FP32")
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

    name: Annotated[str, Meta(description="q, dq, ddq or, for `forward_dynamics`, tau")]
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
