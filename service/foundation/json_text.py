"""JSON of requests, read so that it has one meaning: no field twice, no text that is not UTF-8."""

from __future__ import annotations

import json
from typing import Any

from service.foundation.errors import InvalidRequestError, invalid_request, problem, sentence
from service.foundation.fields import first_repeat

MOST_FIELDS = 1000
"""Fields of a JSON object that are read at all."""


def read_json(body: bytes) -> Any:
    """The value of a JSON text as RFC 8259 has it, besides NaN and Infinity, which are refused where they stand.

    Raise InvalidRequestError naming the place where it is not UTF-8, no JSON, nested too deep, or names a field twice.
    """
    try:
        return json.loads(body.decode("utf-8-sig"), object_pairs_hook=_object)
    except UnicodeDecodeError as error:
        reason = f"not UTF-8 at byte {error.start}"
    except json.JSONDecodeError as error:
        reason = f"not JSON at character {error.pos}: {error.msg}"
    except RecursionError:
        reason = "nested too deep"
    except ValueError:  # Python reads no whole number of more digits
        reason = "not JSON that can be read: a whole number has more than 4300 digits"
    raise invalid_request("body", reason, "JSON")


def each_once(body: bytes) -> bool:
    """Whether an object surely has each field once, in JSON that is known to be right: False may also mean that it is
    not clear, and that `read_json` has to look."""
    if b"\\" in body:
        return False
    quoted = body.split(b'"')[1::2]
    return len(set(quoted)) == len(quoted)


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    if len(pairs) > MOST_FIELDS:
        raise invalid_request("body", f"an object of {len(pairs)} fields", f"at most {MOST_FIELDS}")
    value = dict(pairs)
    if len(value) < len(pairs):
        index = first_repeat(name for name, _ in pairs)
        assert index is not None
        item = problem(pairs[index][0], "given twice", "each field once")
        raise InvalidRequestError(sentence(item), [item])
    return value
