"""JSON with one object per line or in one document, as Python, pandas and robot loggers write it."""

import json

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.service.datasets.reading import check_rejected, read

LEAVES = st.none() | st.floats(width=64) | st.integers(-(2**70), 2**70)
ROW = {"t": 0.5, "q": [1, 2.5], "joint": {"pos": 3, "name": "a", "w": [{"x": 4}, {"x": 5}]}, "on": True}
FLAT = {"t": 0.5, "q[0]": 1, "q[1]": 2.5, "joint.pos": 3, "joint.w[0].x": 4, "joint.w[1].x": 5}


def lines(rows):
    return "".join(json.dumps(row) + "\n" for row in rows).encode()


@pytest.mark.parametrize(
    "body",
    [
        pytest.param(lines([ROW] * 3), id="lines"),
        pytest.param(b"\n" + lines([ROW]) + b"\r\n  \n" + lines([ROW, ROW]), id="empty lines"),
        pytest.param(b"\xef\xbb\xbf" + lines([ROW] * 3), id="byte order mark"),
        pytest.param(json.dumps([ROW] * 3).encode(), id="array"),
        pytest.param(json.dumps({key: [value] * 3 for key, value in ROW.items()}).encode(), id="object of arrays"),
        pytest.param(json.dumps({"data": [ROW] * 3, "rate": 3}, indent=1).encode(), id="rows as data"),
    ],
)
@pytest.mark.parametrize("kind", ["json", "json_lines"])
def test_one_table_in_many_forms(tmp_path, body, kind):
    if kind == "json_lines" and b"data" in body:
        pytest.skip("a document over several lines is not JSON lines")
    result = read(tmp_path, body, kind)
    assert {name: list(values) for name, values in result.columns.items()} == {k: [v] * 3 for k, v in FLAT.items()}


@pytest.mark.parametrize(
    ("orient", "kind"),
    [*((orient, "json") for orient in ("records", "columns", "split", "table")), ("records", "json_lines")],
)
def test_pandas_is_read_back(tmp_path, orient, kind):
    frame = pd.DataFrame({"t": [0.0, 0.5, 1.0], "q1": [1.25, np.nan, 3.0], "phase": ["a", "b", "c"]})
    result = read(tmp_path, frame.to_json(orient=orient, lines=kind == "json_lines").encode(), kind)
    for name in ("t", "q1"):
        np.testing.assert_array_equal(result[name], frame[name])


@given(rows=st.lists(st.tuples(LEAVES, LEAVES, LEAVES), min_size=2, max_size=5))
def test_output_of_the_json_module_is_read_back(tmp_path_factory, rows):
    written = [{"t": t, "q": [first, second]} for t, first, second in rows]
    result = read(tmp_path_factory.mktemp("json"), lines(written), "json_lines")
    expected = [[np.nan if value is None else float(value) for value in row] for row in rows]
    np.testing.assert_array_equal(result.rows, expected)


@pytest.mark.parametrize(
    ("number", "row", "field", "message"),
    [
        (5, {"t": 1, "q": [1, "abc"]}, "q[1], row 5", "a number"),
        (20_000, {"t": 1, "q": [1]}, "q[0], row 20000", "1 values"),
        (1500, {"t": 1, "q": 5}, "q[0], row 1500", "a list"),
        (1500, {"t": {"sec": 1}, "q": [1, 2]}, "t, row 1500", "a number"),
        (3, 7, "row 3", "an object"),
    ],
)
def test_error_names_a_bad_row(tmp_path, number, row, field, message):
    rows = [{"t": 1, "q": [1, 2]}] * 20_001
    rows[number - 1] = row
    check_rejected(tmp_path, lines(rows), "json_lines", field, message)


@pytest.mark.parametrize(
    ("body", "kind", "field", "message"),
    [
        (b'{"t":1}\n{"t":2\n', "json_lines", "line 2", "not JSON"),
        (b'{"t":1', "json_lines", "file", "not JSON"),
        (b'{"t":1}\n{"t":' + b"[" * 100_000 + b"\n", "json_lines", "line 2", "not JSON"),
        (b'{"t":1}\n{"x":"' + b"a" * 200_000 + b'"}\n', "json_lines", "line 2", "at most 200000"),
        (b'{"t":[1,2],"q":[1,2', "json", "file", "not JSON"),
        (b'{"t":[1,2],"q":[1,2],"x":[1]}', "json", "x", "2 values"),
        (b'{"t":1,"data":{}}', "json", "file", "an array"),
        (b"[" * 100_000, "json", "file", "not JSON"),
        (b'"text"', "json", "file", "an array"),
        (b'[{"q":1},{"q":' + b"9" * 5000 + b"}]", "json", "row 2", "4300 digits"),
        (json.dumps([{"q": [0] * 100}]).encode(), "json", "q", "at most 40"),
        (json.dumps([{f"c{i}": 1 for i in range(30)}]).encode(), "json", "columns", "at most 20"),
        (b"[" + b'{"a":' * 11 + b"1" + b"}" * 11 + b"]", "json", "a.a.a", "nested"),
        (b'[{"a.b":1,"a":{"b":2}}]', "json", "column 2", "each column only once"),
    ],
)
def test_damaged_json_is_rejected_with_its_place(tmp_path, monkeypatch, body, kind, field, message):
    for module in ("table", "json"):
        monkeypatch.setattr(f"service.datasets.formats.{module}.MAX_COLUMNS", 20)
    monkeypatch.setattr("service.datasets.formats.json.MAX_LINE_BYTES", 200_000)
    check_rejected(tmp_path, body, kind, field, message)


def test_missing_values(tmp_path):
    rows = [{"t": 0, "q": [1, 2]}, {"t": 1}, {"q": None}, {"t": 3, "q": []}, {"t": 4, "q": [float("nan"), None]}]
    result = read(tmp_path, lines(rows), "json_lines")
    np.testing.assert_array_equal(result["t"], [0, 1, np.nan, 3, 4])
    np.testing.assert_array_equal(result["q[0]"], [1, np.nan, np.nan, np.nan, np.nan])
