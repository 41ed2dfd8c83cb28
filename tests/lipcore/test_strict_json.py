"""JSON of one meaning only."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lipcore.files.strict_json import MAX_DEPTH, StrictJsonError, quote, read

VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**63 - 1)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=20,
)


@given(VALUES)
def test_what_json_can_say_is_read(value: object) -> None:
    assert read(json.dumps(value).encode(), 10**6) == value


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (b"NaN", "holds NaN"),
        (b"[-Infinity]", "holds -Infinity"),
        (b"1e400", "'1e400' is too large"),
        (b"-1e400", "too large"),
        (b"9223372036854775808", "too large"),
        (b"-9223372036854775809", "too large"),
        (b"1" * 5000, "too large"),
        (b'{"a": 1, "a": 1}', "'a' is given twice"),
        (b'{"a": {"b": 1, "\\u0062": 2}}', "'b' is given twice"),
        (b'"\\udc00"', "half a character"),
        (b'{"\\ud800x": 1}', "half a character"),
        (b"\xff\xfe[\x00]\x00", "not UTF-8 at byte 0"),
        (b"[1,]", "not JSON"),
        (b"", "not JSON"),
        (b"[" * (MAX_DEPTH + 1) + b"]" * (MAX_DEPTH + 1), f"nests more than {MAX_DEPTH} deep"),
        (b"[" * 100_000, f"nests more than {MAX_DEPTH} deep"),
        (b'{"a":' * 100_000, f"nests more than {MAX_DEPTH} deep"),
        (b"[" + b"1," * 500 + b"1]", "1003 bytes, expected at most 1000"),
    ],
    ids=lambda each: repr(each)[:24],
)
def test_what_is_ambiguous_or_runs_away_is_refused(text: bytes, said: str) -> None:
    with pytest.raises(StrictJsonError, match=said):
        read(text, 1000 if b"1,1" in text else 10**6)


def test_the_deepest_nest_is_read() -> None:
    assert read(b"[" * MAX_DEPTH + b"]" * MAX_DEPTH, 1000)


def test_what_is_shown_of_a_value_is_short_and_escaped() -> None:
    assert quote("\x1b[2J\u202e") == "'\\x1b[2J\\u202e'"
    assert len(quote("x" * 1000)) < 100
    assert quote([1, 2, 3]) == "a list of 3 entries"
