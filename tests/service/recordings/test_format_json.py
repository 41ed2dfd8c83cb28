"""JSON, one object a line or in one document, as Python, pandas and robots' loggers write it."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.foundation.errors import InvalidDataError, TooLargeError
from tests.service.recordings.reading import read, refused

LEAVES = st.none() | st.floats(width=64) | st.integers(-(2**70), 2**70)
ROW = {"t": 0.5, "q": [1, 2.5], "joint": {"pos": 3, "name": "a", "w": [{"x": 4}, {"x": 5}]}, "on": True}
FLAT = {"t": 0.5, "q[0]": 1, "q[1]": 2.5, "joint.pos": 3, "joint.w[0].x": 4, "joint.w[1].x": 5}


def lines(rows):
    return "".join(json.dumps(row) + "\n" for row in rows).encode()


def test_what_is_nested_gets_names(tmp_path):
    found = read(tmp_path, lines([ROW, ROW]), "json_lines")
    assert {name: values[1] for name, values in found.columns.items()} == FLAT
    assert any("joint.name, on" in fact for fact in found.facts)


@pytest.mark.parametrize(
    "body",
    [
        pytest.param(lines([ROW] * 3), id="lines"),
        pytest.param(b"\n" + lines([ROW]) + b"\r\n  \n" + lines([ROW, ROW]), id="empty lines"),
        pytest.param(b"\xef\xbb\xbf" + lines([ROW] * 3), id="byte order mark"),
        pytest.param(lines([ROW] * 3).rstrip(), id="no line end"),
        pytest.param(json.dumps([ROW] * 3).encode(), id="array"),
        pytest.param(json.dumps([ROW] * 3, indent=4).encode(), id="array, indented"),
        pytest.param(json.dumps({key: [value] * 3 for key, value in ROW.items()}).encode(), id="object of arrays"),
        pytest.param(json.dumps({"data": [ROW] * 3, "rate": 3}, indent=1).encode(), id="rows as data"),
    ],
)
@pytest.mark.parametrize("kind", ["json", "json_lines"])
def test_one_table_in_many_forms(tmp_path, body, kind):
    if kind == "json_lines" and b"data" in body:
        pytest.skip("a document over several lines is none of lines")
    found = read(tmp_path, body, kind)
    assert {name: list(values) for name, values in found.columns.items()} == {k: [v] * 3 for k, v in FLAT.items()}


@pytest.mark.parametrize("orient", ["records", "columns", "split", "table"])
@pytest.mark.parametrize("as_lines", [False, True])
def test_pandas_is_read_back(tmp_path, orient, as_lines):
    if as_lines and orient != "records":
        pytest.skip("pandas writes lines of records only")
    frame = pd.DataFrame({"t": [0.0, 0.5, 1.0], "q1": [1.25, np.nan, 3.0], "phase": ["a", "b", "c"]})
    body = frame.to_json(orient=orient, lines=as_lines).encode()
    found = read(tmp_path, body, "json_lines" if as_lines else "json")
    np.testing.assert_array_equal(found["q1"], frame["q1"])
    np.testing.assert_array_equal(found["t"], frame["t"])


def test_nested_objects_of_arrays(tmp_path):
    body = {"joint_names": ["a", "b"], "rate": 100, "state": {"q": [[1, 2], [3, 4], [5, 6]], "t": [0, 1, 2]}}
    found = read(tmp_path, json.dumps(body).encode(), "json")
    assert found.names == ("state.q[0]", "state.q[1]", "state.t")
    assert found.joint_names == ("a", "b")
    assert any("rate" in fact for fact in found.facts)


@given(rows=st.lists(st.tuples(LEAVES, LEAVES, LEAVES), min_size=2, max_size=5))
def test_python_writes_and_we_read(tmp_path_factory, rows):
    written = [{"t": t, "q": [first, second]} for t, first, second in rows]
    found = read(tmp_path_factory.mktemp("json"), lines(written), "json_lines")
    wanted = [[np.nan if value is None else float(value) for value in row] for row in rows]
    np.testing.assert_array_equal(np.column_stack(list(found.columns.values())), wanted)


def test_missing_values(tmp_path):
    rows = [{"t": 0, "q": [1, 2]}, {"t": 1}, {"q": None}, {"t": 3, "q": []}, {"t": 4, "q": [float("nan"), None]}]
    found = read(tmp_path, lines(rows), "json_lines")
    np.testing.assert_array_equal(found["t"], [0, 1, np.nan, 3, 4])
    np.testing.assert_array_equal(found["q[0]"], [1, np.nan, np.nan, np.nan, np.nan])


def test_more_rows_than_a_block(tmp_path):
    rows = 40_000
    body = b"".join(b'{"t":%d,"q":[%d,1]}\n' % (row, -row) for row in range(rows))
    np.testing.assert_array_equal(read(tmp_path, body, "json_lines")["q[0]"], -np.arange(rows))


def test_lists_of_different_lengths_are_left_out(tmp_path):
    rows = [{"t": row, "contacts": [0] * (row % 4)} for row in range(40)]
    found = read(tmp_path, lines(rows), "json_lines")
    assert found.names == ("t",)
    assert any("contacts[0]" in fact for fact in found.facts)


@pytest.mark.parametrize(
    ("number", "row", "field", "message"),
    [
        (5, {"t": 1, "q": [1, "abc"]}, "q[1], row 5", "a number"),
        (1500, {"t": True, "q": [1, 2]}, "t, row 1500", "a number"),
        (20_000, {"t": 1, "q": [1]}, "q[0], row 20000", "1 values"),
        (20_000, {"t": 1, "q": [1, 2, 3]}, "q[0], row 20000", "3 values"),
        (1500, {"t": 1, "q": 5}, "q[0], row 1500", "a list"),
        (1500, {"t": {"sec": 1}, "q": [1, 2]}, "t, row 1500", "a number"),
        (1500, [1, 2], "row 1500", "an object"),
        (3, 7, "row 3", "an object"),
    ],
)
def test_a_bad_row_is_named_wherever_it_is(tmp_path, number, row, field, message):
    rows = [{"t": 1, "q": [1, 2]}] * 20_001
    rows[number - 1] = row
    said = refused(tmp_path, lines(rows), "json_lines", error=InvalidDataError)
    assert said[0] == field
    assert message in " ".join(said)


@pytest.mark.parametrize(
    ("body", "kind", "field", "message"),
    [
        (b'{"t":1}\n{"t":2\n', "json_lines", "line 2", "not JSON"),
        (b'{"t":1}\n{"t":\xff}\n', "json_lines", "line 2", "not JSON"),
        (b'{"t":1', "json_lines", "file", "not JSON"),
        (b'{"t":1\n{"t":1}', "json_lines", "line 1", "not JSON"),
        (b'{"t":1}\n{"t":' + b"[" * 100_000 + b"\n", "json_lines", "line 2", "not JSON"),
        (b'{"t":1}\n{"x":"' + b"a" * 5000 + b'"}\n', "json_lines", "line 2", "at most 2000"),
        (b'{"t":[1,2],"q":[1,2', "json", "file", "not JSON"),
        (b'{"t":[1,2],"q":[1,2],"x":[1]}', "json", "x", "2 values"),
        (b'{"t":1,"data":{}}', "json", "file", "an array"),
        (b"[1,2,3]", "json", "row 1", "an object"),
        (b'[{"t":1},{"t":1}', "json", "file", "not JSON"),
        (b"[" * 100_000, "json", "file", "not JSON"),
        (b'"text"', "json", "file", "an array"),
        (json.dumps([{"q": [0] * 100}]).encode(), "json", "q", "at most 40"),
        (json.dumps([{f"c{i}": 1 for i in range(30)}]).encode(), "json", "columns", "at most 20"),
        (json.dumps([{"a": {"a": {"a": {"a": {"a": {"a": {"a": {"a": {"a": {"a": {"a": 1}}}}}}}}}}}]).encode(),
         "json", "a.a.a", "nested"),
        (b'[{"a.b":1,"a":{"b":2}}]', "json", "column 2", "every column once"),
    ],
)  # fmt: skip
def test_refused_with_the_place(tmp_path, body, kind, field, message):
    said = refused(tmp_path, body, kind, error=InvalidDataError, max_json_line_bytes=2000, max_columns=20)
    if b"[" * 5000 in body and kind == "json_lines":
        said = refused(tmp_path, body, kind, error=InvalidDataError)
    assert said[0] == field
    assert message in " ".join(said)


def test_a_large_document_is_refused_with_a_way_out(tmp_path):
    body = json.dumps([ROW] * 100).encode()
    assert "NDJSON" in refused(tmp_path, body, "json", error=TooLargeError, max_json_bytes=1000)
