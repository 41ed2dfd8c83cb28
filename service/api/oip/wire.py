"""Decodes inference requests over HTTP, JSON followed by binary tensors, and encodes their answers."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator
from math import isfinite, prod
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from lipcore.files.strict_json import mistake
from service.api.oip.schema import (
    HEADER,
    SEQUENCE_ID,
    InferInput,
    InferRequest,
    InferResponse,
    InferTensor,
    TensorParameters,
)
from service.api.oip.tensors import Answer, Header
from service.api.route import OCTETS, Reply
from service.foundation.errors import InvalidRequestError, UnsupportedMediaTypeError, invalid_request, problem, sentence
from service.inference.predicting import Buffer

_HEADER, _ENCODING = HEADER.lower().encode(), b"content-encoding"
_decode = msgspec.json.Decoder(InferRequest).decode
_encode = msgspec.json.Encoder().encode

_MESSAGE = re.compile(r"(?P<what>.*?)(?: - at `\$\.?(?P<path>.*)`)?", re.DOTALL)
_FIELD = re.compile(r"Object (?P<kind>missing required|contains unknown) field `(?P<name>.*)`")
_PART = re.compile(r"(\w+)|\[(\d+)\]")
_KINDS = {
    "float | array": "a number, or a list of numbers",
    "float": "a number",
    "str": "a string",
    "int | str": SEQUENCE_ID,
    "int": "a whole number",
    "int` >= 0": "a whole number of at least 0",
    "bool": "true or false",
    "array": "a list",
    "object": "an object",
}


Headers = Iterable[tuple[bytes, bytes]]


class Message:
    """A request, with the binary data that follow its JSON."""

    def __init__(self, request: InferRequest, body: Buffer, offset: int) -> None:
        self.request, self._body, self._offset = request, body, offset

    def is_binary(self, outputs: Iterable[bool]) -> bool:
        """Return whether all inputs follow the JSON, and all outputs are requested in binary."""
        sent = (each.parameters is not None and each.parameters.binary_data_size for each in self.request.inputs)
        return all(sent) and all(outputs)

    def check(self) -> None:
        """Raise InvalidRequestError unless as many bytes follow the JSON as the inputs announce."""
        sizes = (each.parameters.binary_data_size or 0 for each in self.request.inputs if each.parameters)
        announced, present = sum(sizes), len(self._body) - self._offset
        if announced != present:
            expected = f"{announced} bytes, the sum of all binary_data_size"
            message = f"{present} bytes follow the JSON, expected {expected}. {HEADER} gives the length of the JSON."
            raise invalid_request("the binary data", f"{present} bytes", expected, message)

    def numbers(self, place: int, dtype: np.dtype[np.floating]) -> NDArray[np.floating]:
        """Return the numbers of an input, flat or in rows. Call it in the order of the inputs."""
        tensor = self.request.inputs[place]
        name, count = tensor.name, prod(tensor.shape)
        size = None if tensor.parameters is None else tensor.parameters.binary_data_size
        if (size is None) == (tensor.data is None):
            given_data = "missing" if size is None else "given, and binary_data_size too"
            fault = "neither `data` nor" if size is None else "both `data` and"
            message = f"Input `{name}` has {fault} `binary_data_size`. Give exactly one of them."
            raise invalid_request(f"{name}.data", given_data, "either data or binary_data_size", message)
        if size is None:
            return _read_list(tensor, count)
        if size != count * dtype.itemsize:
            expected = f"{count * dtype.itemsize} bytes for shape {tensor.shape} of {tensor.datatype}"
            raise invalid_request(f"{name}.parameters.binary_data_size", size, expected)
        begin, self._offset = self._offset, self._offset + size
        return np.frombuffer(self._body, dtype, count, begin)

    def encode(self, header: Header, answers: list[Answer]) -> Reply:
        """Encode an answer, each tensor in the requested form."""
        tensors: list[InferTensor] = []
        payload: list[bytes] = []
        for name, values, binary in answers:
            tensors.append(_tensor(name, values, payload if binary else None))
        response = InferResponse(header.model, header.version, header.parameters, tensors)
        if self.request.id is not None:
            response.id = self.request.id
        text = _encode(response)
        if not payload:
            return Reply(text)
        return Reply(b"".join([text, *payload]), OCTETS, ((_HEADER, b"%d" % len(text)),))


def decode(body: Buffer, headers: Headers) -> Message:
    """Decode the JSON of a body; raise InvalidRequestError, or UnsupportedMediaTypeError if it is compressed.

    `headers` are those of the request, with names in lower case.
    """
    length: bytes | None = None
    for name, value in headers:
        if name == _HEADER:
            length = value
        elif name == _ENCODING and value.lower() != b"identity":
            item = problem("Content-Encoding", value.decode("latin-1"), "an uncompressed body")
            raise UnsupportedMediaTypeError(sentence(item), [item])
    offset = len(body) if length is None else _length(length, len(body))
    text = body if offset == len(body) else memoryview(body)[:offset]
    try:
        return Message(_decode(text), body, offset)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise _explain(error, bytes(text), length is None) from error


def _read_list(tensor: InferInput, count: int) -> NDArray[np.float64]:
    field, expected = f"{tensor.name}.data", f"{count} numbers, flat or in rows, for shape {tensor.shape}"
    try:
        values = np.array(tensor.data, np.float64)
    except ValueError:
        given = "numbers and lists, or lists of different lengths"
        raise invalid_request(field, given, expected, f"`{field}` has {given}, expected {expected}.") from None
    if values.size != count or (values.ndim == 2 and list(values.shape) != tensor.shape):
        given = f"{values.size} numbers" if values.ndim == 1 else f"rows of shape {list(values.shape)}"
        raise invalid_request(field, given, expected, f"`{field}` has {given}, expected {expected}.")
    return values


def _tensor(name: str, values: NDArray[np.float64], payload: list[bytes] | None) -> InferTensor:
    """Return an output tensor with its numbers in the JSON, or append them to the payload."""
    shape = list(values.shape)
    if payload is None:
        return InferTensor(name, "FP64", shape, data=values.ravel().tolist())
    data = values.astype("<f8", copy=False).tobytes()
    payload.append(data)
    return InferTensor(name, "FP64", shape, TensorParameters(len(data)))


def _length(value: bytes, total: int) -> int:
    number = int(value) if value.isdigit() and len(value) < 20 else 0
    if not 1 <= number <= total:
        expected = f"the length of the JSON in bytes, 1 to {total}, the length of the body"
        raise invalid_request(HEADER, value.decode("latin-1"), expected)
    return number


def _explain(error: Exception, text: bytes, alone: bool) -> InvalidRequestError:
    """Return the error for wrong JSON; `alone`: no header announces binary data after it."""
    loose = _read_loosely(text)
    if isinstance(error, msgspec.ValidationError):
        match = _MESSAGE.fullmatch(str(error))
        assert match is not None  # the pattern matches any text
        return _explain_value(match["what"], match["path"] or "", loose)
    for path, value in _leaves(loose):
        if isinstance(value, float) and not isfinite(value):  # Python and others write NaN, which is not JSON
            return invalid_request(path or "the body", value, "a finite number" if path else "an object")
    reason = f"not JSON: {mistake(text, error)}"
    if alone:
        message = f"The body is {reason}. If binary tensors follow the JSON, give its length in {HEADER}."
    else:
        message = f"The first {len(text)} bytes of the body, the length in {HEADER}, are {reason}"
    return invalid_request("the body", reason, "an inference request as JSON", message)


def _explain_value(what: str, path: str, loose: Any) -> InvalidRequestError:
    if field := _FIELD.fullmatch(what):
        name = f"{path}.{field['name']}".lstrip(".")
        if field["kind"] == "missing required":
            return invalid_request(name, "missing", "a value", f"`{name}` is required.")
        return invalid_request(name, "given", "a known field", f"Unknown field `{name}`.")
    if what == "Number out of range":
        return invalid_request(path, _value_at(loose, path, "out of range"), "a finite number")
    kind, _, got = what.removeprefix("Expected `").partition("`, got ")
    return invalid_request(
        path or "the body", _value_at(loose, path, got.strip("`")), _KINDS.get(kind.removesuffix(" | null"), what)
    )


def _read_loosely(text: bytes) -> Any:
    """Parse JSON and Python's extensions of it, such as NaN; return None if it is neither."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return None


def _value_at(value: Any, path: str, otherwise: str) -> Any:
    """Return the value at a path such as `inputs[0].shape`, or `otherwise` if duplicate keys hide it."""
    try:
        for key, index in _PART.findall(path):
            value = value[key] if key else value[int(index)]
    except (LookupError, TypeError):
        return otherwise
    return otherwise if value is None else value


def _leaves(value: Any) -> Iterator[tuple[str, Any]]:
    """Yield every value that is not a list or object, with its path, in order."""
    waiting = [("", value)]
    while waiting:
        path, value = waiting.pop()
        if isinstance(value, dict):
            waiting += reversed([(f"{path}.{key}".lstrip("."), item) for key, item in value.items()])
        elif isinstance(value, list):
            waiting += reversed([(f"{path}[{index}]", item) for index, item in enumerate(value)])
        else:
            yield path, value
