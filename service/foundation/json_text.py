"""Strict reader of JSON request bodies: each field once, UTF-8 only."""

from __future__ import annotations

import json
from typing import Any

from service.foundation.errors import InvalidRequestError, invalid_request, problem, sentence
from service.foundation.fields import first_repeat

MAX_FIELDS = 1000
"""Max fields of a JSON object."""
_OPEN, _CLOSE = b"{}"
_NO_BRACES = bytes(set(range(256)) - {_OPEN, _CLOSE})


def read_json(body: bytes) -> Any:
    """Return the value of a JSON text (RFC 8259); NaN and Infinity are accepted here and rejected by the fields.

    Raise InvalidRequestError if the text is not UTF-8, is not JSON, is nested too deeply or repeats a field.
    """
    try:
        return json.loads(body.decode("utf-8-sig"), object_pairs_hook=_object)
    except UnicodeDecodeError as error:
        reason = f"not UTF-8 at byte {error.start}"
    except json.JSONDecodeError as error:
        reason = f"not JSON at character {error.pos}: {error.msg}"
    except RecursionError:
        reason = "nested too deep"
    except ValueError:  # Python limits the digits of a whole number
        reason = "not JSON that can be read: a whole number has more than 4300 digits"
    raise invalid_request("body", reason, "JSON")


def has_unique_fields(body: bytes) -> bool:
    """Return True if valid JSON surely repeats no field; False means that `read_json` has to check."""
    if b"\\" in body:
        return False
    pieces = body.split(b'"')
    quoted = pieces[1::2]
    if len(set(quoted)) == len(quoted):
        return True
    objects: list[set[bytes]] = []
    for between, text in zip(pieces[::2], quoted, strict=False):
        for brace in between.translate(None, _NO_BRACES):
            if brace == _OPEN:
                objects.append(set())
            else:
                objects.pop()
        if not objects or text in objects[-1]:
            return False
        objects[-1].add(text)
    return True


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    if len(pairs) > MAX_FIELDS:
        raise invalid_request("body", f"an object of {len(pairs)} fields", f"at most {MAX_FIELDS}")
    value = dict(pairs)
    if len(value) < len(pairs):
        index = first_repeat(name for name, _ in pairs)
        assert index is not None
        item = problem(pairs[index][0], "given twice", "each field once")
        raise InvalidRequestError(sentence(item), [item])
    return value
