"""An inference request over HTTP: JSON, and binary tensors after it; and the bytes of its answer."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator
from math import isfinite, prod
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from service.api.oip.schema import HEADER, InferInput, InferRequest, InferResponse, InferTensor, TensorParameters
from service.api.oip.tensors import Answer, Header
from service.api.route import OCTETS, Reply
from service.foundation.errors import InvalidRequestError, UnsupportedMediaTypeError, invalid_request, problem, sentence

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
    "int": "a whole number",
    "int` >= 0": "a whole number of at least 0",
    "bool": "true or false",
    "array": "a list",
    "object": "an object",
}


Headers = Iterable[tuple[bytes, bytes]]


class Message:
    """A request, with what its body holds after the JSON."""

    def __init__(self, request: InferRequest, body: bytes, offset: int) -> None:
        self.request, self._body, self._offset = request, body, offset

    def check(self) -> None:
        """Compare the bytes after the JSON with those that the inputs announce; raise InvalidRequestError."""
        sizes = (each.parameters.binary_data_size or 0 for each in self.request.inputs if each.parameters)
        announced, present = sum(sizes), len(self._body) - self._offset
        if announced != present:
            expected = (
                f"{announced} bytes, the sum of every binary_data_size, after the JSON whose length {HEADER} gives"
            )
            raise invalid_request("the binary data", f"{present} bytes", expected)

    def numbers(self, place: int, dtype: np.dtype[np.floating]) -> NDArray[np.floating]:
        """Numbers of an input, flat or in rows; to be asked in the order of the inputs, as binary data lie."""
        tensor = self.request.inputs[place]
        name, count = tensor.name, prod(tensor.shape)
        size = None if tensor.parameters is None else tensor.parameters.binary_data_size
        if (size is None) == (tensor.data is None):
            given_data = "missing" if size is None else "given, and binary_data_size too"
            raise invalid_request(f"{name}.data", given_data, "numbers in data, or binary_data_size and binary data")
        if size is None:
            return _listed(tensor, count)
        if size != count * dtype.itemsize:
            expected = f"{count * dtype.itemsize} bytes: the shape {tensor.shape} of {tensor.datatype}"
            raise invalid_request(f"{name}.parameters.binary_data_size", size, expected)
        begin, self._offset = self._offset, self._offset + size
        return np.frombuffer(self._body, dtype, count, begin)

    def encode(self, header: Header, answers: list[Answer]) -> Reply:
        """Encode an answer, each tensor as it was asked for."""
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


def decode(body: bytes, headers: Headers) -> Message:
    """Decode the JSON of a body; raise InvalidRequestError, or UnsupportedMediaTypeError where it is compressed.
    headers: of the request, their names in lower case."""
    length: bytes | None = None
    for name, value in headers:
        if name == _HEADER:
            length = value
        elif name == _ENCODING and value.lower() != b"identity":
            item = problem("Content-Encoding", value.decode("latin-1"), "none: bodies are taken uncompressed")
            raise UnsupportedMediaTypeError(sentence(item), [item])
    offset = len(body) if length is None else _length(length, len(body))
    text = body if offset == len(body) else memoryview(body)[:offset]
    try:
        return Message(_decode(text), body, offset)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise _explain(error, bytes(text), length is None) from error


def _listed(tensor: InferInput, count: int) -> NDArray[np.float64]:
    field, expected = f"{tensor.name}.data", f"{count} numbers or rows of them, as the shape {tensor.shape} has"
    try:
        values = np.array(tensor.data, np.float64)
    except ValueError:
        raise invalid_request(field, "numbers and lists, or lists of different lengths", expected) from None
    if values.size != count or (values.ndim == 2 and list(values.shape) != tensor.shape):
        given = f"{values.size} numbers" if values.ndim == 1 else f"rows of shape {list(values.shape)}"
        raise invalid_request(field, given, expected)
    return values


def _tensor(name: str, values: NDArray[np.float64], payload: list[bytes] | None) -> InferTensor:
    """Describe a tensor that lies in the JSON, or at the end of the payload."""
    shape = list(values.shape)
    if payload is None:
        return InferTensor(name, "FP64", shape, data=values.ravel().tolist())
    data = values.astype("<f8", copy=False).tobytes()
    payload.append(data)
    return InferTensor(name, "FP64", shape, TensorParameters(len(data)))


def _length(value: bytes, total: int) -> int:
    number = int(value) if value.isdigit() and len(value) < 20 else 0
    if not 1 <= number <= total:
        expected = f"the length of the JSON in bytes, from 1 to the {total} of the body"
        raise invalid_request(HEADER, value.decode("latin-1"), expected)
    return number


def _explain(error: Exception, text: bytes, alone: bool) -> InvalidRequestError:
    """Say what is wrong with a request's JSON. alone: nothing was said to follow it."""
    loose = _loosely(text)
    if isinstance(error, msgspec.ValidationError):
        match = _MESSAGE.fullmatch(str(error))
        assert match is not None  # the pattern takes any text
        return _explain_value(match["what"], match["path"] or "", loose)
    for path, value in _leaves(loose):
        if isinstance(value, float) and not isfinite(value):  # Python and others write NaN, which JSON does not know
            return invalid_request(path or "the body", value, "a finite number" if path else "an object")
    reason = f"not JSON: {str(error).removeprefix('JSON is malformed: ')}"
    where, expected = "the body", "an inference request as JSON"
    if alone:
        expected += f"; the length of JSON that binary tensors follow is to be given in {HEADER}"
    else:
        where = f"the body, up to byte {len(text)} as {HEADER} says,"
    return invalid_request(where, reason, expected)


def _explain_value(what: str, path: str, loose: Any) -> InvalidRequestError:
    if field := _FIELD.fullmatch(what):
        name = f"{path}.{field['name']}".lstrip(".")
        if field["kind"] == "missing required":
            return invalid_request(name, "missing", "a value")
        return invalid_request(name, "given", "no field of that name")
    if what == "Number out of range":
        return invalid_request(path, _at(loose, path, "out of range"), "a finite number")
    kind, _, got = what.removeprefix("Expected `").partition("`, got ")
    return invalid_request(
        path or "the body", _at(loose, path, got.strip("`")), _KINDS.get(kind.removesuffix(" | null"), what)
    )


def _loosely(text: bytes) -> Any:
    """JSON with what only Python takes for JSON; None where it is not even that."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return None


def _at(value: Any, path: str, otherwise: str) -> Any:
    """What lies at a path such as `inputs[0].shape`; `otherwise` where equal keys hide it."""
    try:
        for key, index in _PART.findall(path):
            value = value[key] if key else value[int(index)]
    except (LookupError, TypeError):
        return otherwise
    return otherwise if value is None else value


def _leaves(value: Any) -> Iterator[tuple[str, Any]]:
    """Every value that is no list and no object, with its path, in order."""
    waiting = [("", value)]
    while waiting:
        path, value = waiting.pop()
        if isinstance(value, dict):
            waiting += reversed([(f"{path}.{key}".lstrip("."), item) for key, item in value.items()])
        elif isinstance(value, list):
            waiting += reversed([(f"{path}[{index}]", item) for index, item in enumerate(value)])
        else:
            yield path, value
