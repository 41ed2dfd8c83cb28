"""An inference request over gRPC, its numbers raw or typed; and the message of its answer."""

from __future__ import annotations

from math import prod
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from service.api.oip import schema
from service.api.oip.rpc.definition import message
from service.api.oip.tensors import Answer, Header
from service.api.route import Reply
from service.foundation.errors import invalid_request

PROTOBUF = b"application/grpc"
InferRequest, InferResponse = message("ModelInferRequest"), message("ModelInferResponse")
MOST = 100
"""Inputs, outputs and axes that are looked at: more than any right request has, so one with more is refused for them.
A message of the largest size may have millions, each of which takes more memory than it has bytes."""
_FIELDS = {"FP64": "fp64_contents", "FP32": "fp32_contents"}


def decode(kind: Any, data: bytes) -> Any:
    """Read a message; raise InvalidRequestError."""
    try:
        return kind.FromString(data)
    except DecodeError as error:
        expected = f"one of {kind.DESCRIPTOR.full_name}"
        raise invalid_request("the message", f"not protobuf that can be read: {error}", expected) from error


def encode(answer: Any) -> Reply:
    """The answer that a message is."""
    return Reply(answer.SerializeToString(), PROTOBUF)


class Message:
    """A request; its answer is raw where it is, and typed where it is."""

    def __init__(self, sent: Any) -> None:
        """sent: an InferRequest. Raise InvalidRequestError for a shape that is none."""
        self._sent, self._raw = sent, len(sent.raw_input_contents) > 0
        self.request = schema.InferRequest(
            [_input(place, tensor) for place, tensor in enumerate(sent.inputs[:MOST])],
            [schema.InferOutput(each.name, _output_parameters(each.parameters)) for each in sent.outputs[:MOST]]
            or None,
        )

    def check(self) -> None:
        """Look that all numbers are raw, or all typed; raise InvalidRequestError."""
        if not self._raw:
            return
        given, needed = len(self._sent.raw_input_contents), len(self._sent.inputs)
        if given != needed:
            raise invalid_request("raw_input_contents", f"{given} of them", f"one of each of the {needed} inputs")
        for tensor in self._sent.inputs:
            if tensor.HasField("contents"):
                expected = f"the numbers of {tensor.name} in one of them"
                raise invalid_request(f"{tensor.name}.contents", "given, and raw_input_contents too", expected)

    def numbers(self, place: int, dtype: np.dtype[np.floating]) -> NDArray[np.floating]:
        """Numbers of an input, flat; raise InvalidRequestError where they are not those of its shape."""
        tensor = self._sent.inputs[place]
        count = prod(tensor.shape)
        if self._raw:
            data: bytes = self._sent.raw_input_contents[place]
            if len(data) != count * dtype.itemsize:
                expected = (
                    f"{count * dtype.itemsize} bytes for {tensor.name}: "
                    f"the shape {list(tensor.shape)} of {tensor.datatype}"
                )
                raise invalid_request(f"raw_input_contents[{place}]", f"{len(data)} bytes", expected)
            return np.frombuffer(data, dtype)
        field = _FIELDS[tensor.datatype]
        values = np.array(getattr(tensor.contents, field), dtype)
        if values.size != count:
            expected = f"{count} numbers, as the shape {list(tensor.shape)} has"
            raise invalid_request(f"{tensor.name}.contents.{field}", f"{values.size} numbers", expected)
        return values

    def encode(self, header: Header, answers: list[Answer]) -> Reply:
        """Encode an answer."""
        answer = InferResponse(model_name=header.model, model_version=header.version, id=self._sent.id)
        answer.parameters["revision"].int64_param = header.parameters.revision
        answer.parameters["torque_convention"].string_param = header.parameters.torque_convention
        for name, values, _ in answers:
            tensor = answer.outputs.add(name=name, datatype="FP64", shape=values.shape)
            if self._raw:
                answer.raw_output_contents.append(values.astype("<f8", copy=False).tobytes())
            else:
                tensor.contents.fp64_contents.extend(values.ravel().tolist())
        return encode(answer)


def _input(place: int, tensor: Any) -> schema.InferInput:
    shape = list(tensor.shape[:MOST])
    for axis, size in enumerate(shape):
        if size < 0:
            raise invalid_request(f"inputs[{place}].shape[{axis}]", size, "a whole number of at least 0")
    region = _text(tensor.parameters, "shared_memory_region")
    return schema.InferInput(
        tensor.name, shape, tensor.datatype, None, schema.InputParameters(shared_memory_region=region)
    )


def _output_parameters(given: Any) -> schema.OutputParameters:
    classes = given["classification"].int64_param if "classification" in given else None
    return schema.OutputParameters(None, _text(given, "shared_memory_region"), classes)


def _text(given: Any, name: str) -> str | None:
    """A parameter that is understood; others are ignored."""
    return str(given[name].string_param) if name in given else None
