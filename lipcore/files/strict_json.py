"""JSON from untrusted sources: of limited size and depth, and of the expected types."""

from __future__ import annotations

import re
from typing import Any, TypeVar

import msgspec

from lipcore.model.selection import shortened

T = TypeVar("T")

MAX_DEPTH = 32
"""Max depth of nested objects and lists: writing and checking recurse as deep."""
MAX_QUOTE = 80
"""Max characters of a quoted value."""


class StrictJsonError(ValueError):
    """The bytes are not the expected JSON; the message names the mistake and its place."""


def read(payload: bytes, max_bytes: int) -> Any:
    """Return the value of a JSON document, its numbers finite; raise StrictJsonError."""
    if len(payload) > max_bytes:
        raise StrictJsonError(f"it has {len(payload)} bytes, expected at most {max_bytes}")
    try:
        value = msgspec.json.decode(payload)
    except RecursionError:
        raise StrictJsonError(f"it nests more than {MAX_DEPTH} deep") from None
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise StrictJsonError(f"it is not JSON: {mistake(payload, error)}") from None
    _check_tree(value, MAX_DEPTH)
    return value


def decode(decoder: msgspec.json.Decoder[T], payload: bytes, max_bytes: int) -> T:
    """Return the typed value of a JSON document.

    Raise StrictJsonError that names the field, its value and the expected one.
    """
    value = read(payload, max_bytes)
    try:
        return decoder.decode(payload)
    except msgspec.ValidationError as error:
        raise StrictJsonError(_explain(str(error), value)) from None


def mistake(payload: bytes, error: Exception) -> str:
    """Return why msgspec could not decode a document. It names the first byte that is not UTF-8, in any version."""
    if "utf-8" in str(error).lower():
        try:
            payload.decode()
        except UnicodeDecodeError as found:
            return str(found)
    return str(error).removeprefix("JSON is malformed: ")


def check_texts(where: str, value: Any) -> None:
    """Raise StrictJsonError for a text that a terminal or a log would not show unchanged."""
    if isinstance(value, str):
        if not all(each.isprintable() or each == "\N{NO-BREAK SPACE}" for each in value):
            raise StrictJsonError(f"{where} is {quote(value)}, which has an unprintable character")
    elif isinstance(value, dict):
        for name, each in value.items():
            check_texts("a name" + f" in {where}" * bool(where), name)
            check_texts(f"{where}.{name}".lstrip("."), each)
    elif isinstance(value, list):
        for index, each in enumerate(value):
            check_texts(f"{where}[{index}]", each)


def quote(value: object) -> str:
    """Return a value as a message quotes it: escaped, and cut if it is long."""
    text = ascii(value) if not isinstance(value, list | dict) else f"a {type(value).__name__} of {len(value)} entries"
    return text if len(text) <= MAX_QUOTE else text[:MAX_QUOTE] + "…"


def _check_tree(value: Any, left: int) -> None:
    """Raise StrictJsonError for deep nesting, and for integers that no float can represent."""
    if isinstance(value, int) and not -(2**63) <= value < 2**63:
        raise StrictJsonError(f"the number {quote(value)} is too large")
    if isinstance(value, list | dict):
        if not left:
            raise StrictJsonError(f"it nests more than {MAX_DEPTH} deep")
        for each in value.values() if isinstance(value, dict) else value:
            _check_tree(each, left - 1)


def _explain(error: str, value: Any) -> str:
    """Return msgspec's error in our words: "noise_std[1] is -1, expected `float` >= 0.0"."""
    found = re.fullmatch(r"(.*?)(?: - at `\$\.?(.*)`)?", error, re.DOTALL)
    assert found is not None  # the pattern matches any text
    what, path = found[1], found[2] or ""
    if not what.startswith("Expected "):
        return shortened(f"{path}: {what}" if path else what)
    for key in re.findall(r"[^.\[\]]+", path):
        value = value[int(key) if isinstance(value, list) else key]
    expected = what.removeprefix("Expected ").partition(", got ")[0]
    if words := re.fullmatch(r"`str` matching regex '\^\((.*)\)\\\\Z'", expected):
        expected = "one of " + words[1].replace("\\", "").replace("|", ", ")
    return f"{path or 'it'} is {quote(value)}, expected {expected}"
