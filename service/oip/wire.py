"""Bytes of an inference message: JSON, and binary tensors after it."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator
from math import isfinite
from typing import Any, NamedTuple

import msgspec

from service.foundation.errors import InvalidRequestError, UnsupportedMediaTypeError, invalid_request, problem, sentence
from service.oip.schema import HEADER, InferRequest, InferResponse
from service.web.route import OCTETS, Reply

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


class Message(NamedTuple):
    """A request and where its binary tensors begin in the body."""

    request: InferRequest
    offset: int


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
        return Message(_decode(text), offset)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise _explain(error, bytes(text), length is None) from error


def encode(response: InferResponse, tensors: list[bytes]) -> Reply:
    """Encode a response with its binary tensors."""
    text = _encode(response)
    if not tensors:
        return Reply(text)
    return Reply(b"".join([text, *tensors]), OCTETS, ((_HEADER, b"%d" % len(text)),))


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
