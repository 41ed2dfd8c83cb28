"""Decodes inference requests over gRPC, with raw or typed numbers, and encodes their answers."""

from __future__ import annotations

from collections.abc import Iterable
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
from service.inference.predicting import Buffer

PROTOBUF = b"application/grpc"
InferRequest, InferResponse = message("ModelInferRequest"), message("ModelInferResponse")
MAX_ITEMS = 100
"""Max inputs, outputs and axes that are read. No valid request has as many; later checks reject one that has.

A message of the max size may have millions of them, which need more memory than the message itself.
"""
_FIELDS = {"FP64": "fp64_contents", "FP32": "fp32_contents"}


def decode(kind: Any, data: bytes) -> Any:
    """Decode a message; raise InvalidRequestError."""
    try:
        return kind.FromString(data)
    except DecodeError as error:
        expected = kind.DESCRIPTOR.full_name
        sentence = f"The message is not a valid {expected}: {error}"
        raise invalid_request("the message", f"not valid protobuf: {error}", expected, sentence) from error


def decode_request(data: Buffer) -> Message:
    """Decode an InferRequest; raise InvalidRequestError."""
    return Message(decode(InferRequest, bytes(data)))


def encode(answer: Any) -> Reply:
    """Return the reply with a message."""
    return Reply(answer.SerializeToString(), PROTOBUF)


class Message:
    """An inference request. Its answer has raw numbers if the request has, else typed numbers."""

    def __init__(self, sent: Any) -> None:
        """Read an InferRequest; raise InvalidRequestError for a negative shape or a wrong parameter."""
        self._sent, self._raw = sent, len(sent.raw_input_contents) > 0
        self.request = schema.InferRequest(
            [_input(place, tensor) for place, tensor in enumerate(sent.inputs[:MAX_ITEMS])],
            [schema.InferOutput(each.name, _output_parameters(each.parameters)) for each in sent.outputs[:MAX_ITEMS]]
            or None,
            parameters=_parameters(sent.parameters),
        )

    def is_binary(self, outputs: Iterable[bool]) -> bool:
        """Return whether the numbers are raw: then those of the answer are, too."""
        return self._raw

    def check(self) -> None:
        """Check that the numbers are all raw or all typed; raise InvalidRequestError."""
        if not self._raw:
            return
        given, needed = len(self._sent.raw_input_contents), len(self._sent.inputs)
        if given != needed:
            message = f"`raw_input_contents` has {given} entries, expected one for each of the {needed} inputs."
            raise invalid_request("raw_input_contents", f"{given} entries", f"{needed} entries", message)
        for tensor in self._sent.inputs:
            if tensor.HasField("contents"):
                field = f"{tensor.name}.contents"
                message = f"Both `{field}` and `raw_input_contents` are given. Use one of them for all inputs."
                raise invalid_request(field, "given, and raw_input_contents too", "one of the two", message)

    def numbers(self, place: int, dtype: np.dtype[np.floating]) -> NDArray[np.floating]:
        """Return the numbers of an input, flat; raise InvalidRequestError if their count does not match the shape."""
        tensor = self._sent.inputs[place]
        count = prod(tensor.shape)
        if self._raw:
            data: bytes = self._sent.raw_input_contents[place]
            if len(data) != count * dtype.itemsize:
                shape = f"shape {list(tensor.shape)} of {tensor.datatype}"
                expected = f"{count * dtype.itemsize} bytes for {tensor.name} with {shape}"
                raise invalid_request(f"raw_input_contents[{place}]", f"{len(data)} bytes", expected)
            return np.frombuffer(data, dtype)
        field = _FIELDS[tensor.datatype]
        values = np.array(getattr(tensor.contents, field), dtype)
        if values.size != count:
            path, expected = f"{tensor.name}.contents.{field}", f"{count} for shape {list(tensor.shape)}"
            message = f"`{path}` has {values.size} numbers, expected {expected}."
            raise invalid_request(path, f"{values.size} numbers", expected, message)
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
    shape = list(tensor.shape[:MAX_ITEMS])
    for axis, size in enumerate(shape):
        if size < 0:
            raise invalid_request(f"inputs[{place}].shape[{axis}]", size, "a whole number of at least 0")
    region = _text(tensor.parameters, "shared_memory_region")
    return schema.InferInput(
        tensor.name, shape, tensor.datatype, None, schema.InputParameters(shared_memory_region=region)
    )


def _parameters(given: Any) -> schema.RequestParameters | None:
    """Return the parameters of a request; raise InvalidRequestError."""
    if not given:
        return None
    name = _value(given, "sequence_id")
    if not (name is None or isinstance(name, str) or type(name) is int):
        raise invalid_request("parameters.sequence_id", name, schema.SEQUENCE_ID)
    flags = {each: _value(given, each) for each in ("sequence_start", "sequence_end")}
    for each, value in flags.items():
        if not (value is None or isinstance(value, bool)):
            raise invalid_request(f"parameters.{each}", value, "true or false")
    return schema.RequestParameters(sequence_id=name, **flags)


def _value(given: Any, name: str) -> Any:
    """Return the value of a parameter, None if it is not given."""
    kind = given[name].WhichOneof("parameter_choice") if name in given else None
    return None if kind is None else getattr(given[name], kind)


def _output_parameters(given: Any) -> schema.OutputParameters:
    classes = given["classification"].int64_param if "classification" in given else None
    return schema.OutputParameters(None, _text(given, "shared_memory_region"), classes)


def _text(given: Any, name: str) -> str | None:
    """Return a text parameter, None if it is not given."""
    return str(given[name].string_param) if name in given else None
