"""Rows of the log come back as they went in."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from lipcore.online.batch import Rows
from lipcore.vocabulary import CODES
from service.journal.log import decode, encode
from tests.service.learning.batches import rows

ANY = st.floats(width=64, allow_nan=True, allow_infinity=True)


@st.composite
def any_rows(draw):
    count, n = draw(st.integers(0, 6)), draw(st.integers(1, 4))
    code = draw(arrays(np.uint8, count, elements=st.integers(0, len(CODES) - 1)))
    return Rows(
        draw(arrays(float, count, elements=ANY)),
        *(draw(arrays(float, (count, n), elements=ANY)) for _ in range(4)),
        code,
        draw(arrays(float, count, elements=ANY)),
    )


def same(one: Rows, other: Rows) -> bool:
    pairs = [(getattr(one, f.name), getattr(other, f.name)) for f in dataclasses.fields(Rows)]
    return all(a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes() for a, b in pairs)


@given(any_rows())
def test_every_bit_comes_back(given_rows):
    assert same(decode(encode(given_rows)), given_rows)


def test_rows_that_are_views_are_written_in_order():
    every_other = rows(9).take(slice(None, None, 2))
    reversed_joints = dataclasses.replace(every_other, tau=every_other.tau[:, ::-1])
    assert same(decode(encode(reversed_joints)), reversed_joints)


def test_any_reader_of_safetensors_understands_it():
    data = encode(rows(3))
    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    assert {name: (entry["dtype"], entry["shape"]) for name, entry in header.items() if name != "__metadata__"} == {
        "time": ("F64", [3]),
        **dict.fromkeys(("q", "dq", "ddq", "tau"), ("F64", [3, 2])),
        "code": ("U8", [3]),
        "weight": ("F64", [3]),
    }


@pytest.mark.parametrize("length", [0, 7, 40, -1])
def test_what_is_cut_off_is_refused(length):
    with pytest.raises(ValueError, match="cannot be read"):
        decode(encode(rows())[:length])


def test_arrays_of_something_else_are_refused():
    data = encode(rows())
    with pytest.raises(ValueError, match="the arrays code, ddq, dq, q, tat, time, weight, expected time, q"):
        decode(data.replace(b'"tau"', b'"tat"'))
