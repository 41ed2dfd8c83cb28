"""JSON from strangers: one meaning only, and nothing that runs away.

Python's reader takes more than JSON is: NaN and Infinity, numbers that overflow to it, one name twice, halves of
characters that no text can hold, whole numbers of any length. All of these are refused here.
"""

from __future__ import annotations

import json
import math
from typing import Any, NoReturn

MAX_DEPTH = 32
"""Objects and lists within one another: what is written again, checked or quoted recurses as deep."""
MAX_QUOTE = 80
"""Characters of a quoted value."""
MAX_INTEGER = 2**63


class StrictJsonError(ValueError):
    """The bytes are not JSON of one meaning; the message says what is wrong and where."""


def read(payload: bytes, most_bytes: int) -> Any:
    """The value that the bytes of a JSON document hold.

    Raise StrictJsonError for what is not JSON of one meaning, and for more than `most_bytes`.
    """
    if len(payload) > most_bytes:
        raise StrictJsonError(f"it has {len(payload)} bytes, expected at most {most_bytes}")
    try:
        value = json.loads(
            payload.decode(),  # UTF-8 only: json would guess
            parse_constant=_no_number,
            parse_float=_finite,
            parse_int=_integer,
            object_pairs_hook=_object,
        )
    except RecursionError:
        raise StrictJsonError(f"it nests more than {MAX_DEPTH} deep") from None
    except UnicodeDecodeError as error:
        raise StrictJsonError(f"it is not UTF-8 at byte {error.start}") from None
    except json.JSONDecodeError as error:
        raise StrictJsonError(f"it is not JSON: {error}") from None
    _check_tree(value)
    return value


def quote(value: object) -> str:
    """A value as a message quotes it: escaped, and cut where it is long."""
    text = ascii(value) if not isinstance(value, list | dict) else f"a {type(value).__name__} of {len(value)} entries"
    return text if len(text) <= MAX_QUOTE else text[:MAX_QUOTE] + "…"


def _check_tree(root: Any) -> None:
    """Raise StrictJsonError for texts that cannot be stored or quoted, and for a deep nest; does not recurse."""
    waiting = [(root, 1)]
    while waiting:
        value, depth = waiting.pop()
        if isinstance(value, str):
            _check_text(value)
        elif isinstance(value, list | dict):
            if depth > MAX_DEPTH:
                raise StrictJsonError(f"it nests more than {MAX_DEPTH} deep")
            if isinstance(value, dict):
                for name in value:
                    _check_text(name)
            waiting += [(each, depth + 1) for each in (value.values() if isinstance(value, dict) else value)]


def _check_text(text: str) -> None:
    try:
        text.encode()
    except UnicodeEncodeError:
        raise StrictJsonError(f"{quote(text)} holds half a character, which no text can") from None


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    entries: dict[str, Any] = {}
    for name, value in pairs:
        if name in entries:
            raise StrictJsonError(f"the name {quote(name)} is given twice")
        entries[name] = value
    return entries


def _no_number(name: str) -> NoReturn:
    raise StrictJsonError(f"it holds {name}, expected finite numbers")


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise StrictJsonError(f"the number {quote(text)} is too large")
    return value


def _integer(text: str) -> int:
    # by its length first: the time to read a whole number grows with its square
    if len(text) > 20 or not -MAX_INTEGER <= int(text) < MAX_INTEGER:
        raise StrictJsonError(f"the number {quote(text)} is too large")
    return int(text)
