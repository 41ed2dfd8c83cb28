"""CSV in many dialects: separators, headers, missing values, text, dates; and errors in it."""

import csv as writer
import io

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.datasets.options import ReadOptions
from service.foundation.errors import InvalidRequestError
from tests.service.datasets.reading import check_rejected, read

NAMES = ["t", "q1", "tau1"]
ROWS = [[0.0, 1.5, -2.0], [0.125, -2.25, 1e-3], [0.25, 1e3, 7.0]]


def text(rows=ROWS, names=NAMES, sep=",", end="\n", form=str):
    return end.join(sep.join(map(form, row)) for row in [names, *rows]) + end


def comma(value):
    return str(value).replace(".", ",")


@pytest.mark.parametrize(
    "body",
    [
        pytest.param(text(), id="plain"),
        pytest.param(text(sep=";"), id="semicolons"),
        pytest.param(text(sep=";", form=comma), id="decimal commas"),
        pytest.param(text(sep="\t", form=comma), id="tabs and decimal commas"),
        pytest.param(text(sep="     "), id="aligned with blanks"),
        pytest.param("  " + text(sep="  ", end=" \n "), id="blanks at the ends"),
        pytest.param(text(sep=" ", end="\r\n"), id="blanks, windows line ends"),
        pytest.param("# " + text(sep=" "), id="header in a comment"),
        pytest.param(text(form=lambda cell: f'"{cell}"'), id="everything quoted"),
        pytest.param("\n\n" + text(end="\n\n") + "\n\n", id="empty lines"),
        pytest.param("\ufeff" + text(sep=", ", end="\r\n").replace("1.5", "+1.5").rstrip(), id="windows, a plus"),
        pytest.param("# recorded on Monday\n# at noon\n" + text(names=['"t"', '"q1"', '"tau1"']), id="comments above"),
    ],
)
def test_one_table_in_many_dialects(tmp_path, body):
    result = read(tmp_path, body.encode(), "csv")
    assert result.names == tuple(NAMES)
    np.testing.assert_array_equal(result.rows, ROWS)


def test_dates_become_seconds_and_keep_nanoseconds(tmp_path):
    stamps = pd.to_datetime(1_700_000_000_000_000_000 + np.array([0, 1, 1_000_000_007]))
    frame = pd.DataFrame({"stamp": stamps, "q1": [1.0, 2.0, 3.0]})
    result = read(tmp_path, frame.to_csv(index=False).encode(), "csv")
    np.testing.assert_allclose(result["stamp"], [0, 1e-9, 1.000000007], rtol=1e-15)
    assert result.units == {"stamp": "s"}
    zoned = b"stamp,q1\n2024-01-01T00:00:00Z,1\n2024-01-01T02:00:00.5+01:00,2\n,3\n"
    np.testing.assert_array_equal(read(tmp_path, zoned, "csv")["stamp"], [0, 3600.5, np.nan])


@pytest.mark.parametrize("word", ["", "NaN", "NA", "null", "None", " "])
def test_words_for_missing_values_become_nan(tmp_path, word):
    np.testing.assert_array_equal(read(tmp_path, f"t,q1\n0,1\n1,{word}\n2,3\n".encode(), "csv")["q1"], [1, np.nan, 3])


@pytest.mark.parametrize(("reply", "sep"), [("tab", "\t"), ("^", "^"), ("blank", "   ")])
def test_delimiter_can_be_given(tmp_path, reply, sep):
    result = read(tmp_path, text(sep=sep).encode(), "csv", ReadOptions(delimiter=reply))
    assert result.names == tuple(NAMES)


@pytest.mark.parametrize("reply", ["ab", "1", '"', "é"])
def test_invalid_delimiter_is_rejected(tmp_path, reply):
    given = ReadOptions(delimiter=reply)
    check_rejected(tmp_path, text().encode(), "csv", "delimiter", "blank", given, InvalidRequestError)


@pytest.mark.parametrize("row", [1, 16_384, 16_385, 49_999])
def test_error_names_row_and_column_of_a_bad_cell(tmp_path, row):
    lines = ["t,q1", *(f"{number},{number % 7}" for number in range(1, 50_001))]
    lines[row] = "5,abc"
    check_rejected(tmp_path, "\n\n".join(lines).encode(), "csv", f"q1, row {row}", ("abc", "a number"))
    lines[row] = "5"
    check_rejected(tmp_path, "\n".join(lines).encode(), "csv", f"row {row}", "1 values 2 values")


WIDE = "4 names", "3 names because each of the first 50 rows has 3 values"


@pytest.mark.parametrize(
    ("body", "field", "message"),
    [
        (b"\n\n\n", "header", "empty"),
        (b"0,1,2\n3,4,5\n", "header", "column names"),
        (b"t,q1,q1\n0,1,2\n", "column 3", "each column only once"),
        (b"t,q1\x07\n0,1\n", "column 2", "printable"),
        (b"t,q1\0\n0,1\n", "column 2", "printable"),
        (b"q1\n1\n", "header", "separated by"),
        (b"t,q1\n0,1\n1,1\x002\n", "q1, row 2", "a number"),
        (b"t,q1\n0,1e400\n1,-inf\n1,x\n", "q1, row 3", "a number"),
        (b"t,q1\n0,1\n1,0x10\n", "q1, row 2", "a number"),
        (b"t;q1\n0;1,5\n1;1.234,5\n", "q1, row 2", "a number"),
        (b"t,q1\n0,1\n\xff,2\n", "t, row 2", "a number"),
        (b"t,q1\n" + b"0,1\n" * 150_000 + b"\xff,2\n", "file", "0xff text in utf-8"),
        (b"t,q1\n0,1\n\x81\x01,2\n", "file", "UTF-8"),
        (b't,q1\n0,1\n1,2\n"', "row 3", "2 values"),
        (b"t," + b"q" * 700_000 + b"\n0,1\n", "header", "at most"),
        (b"t,q1\n0,1\n1," + b"1" * 3_000_000 + b"\n", "file", "line"),
        *((text(ROWS * 20, [*NAMES, "odd"], sep).encode(), "header", WIDE) for sep in ",;\t"),
        (text([*ROWS, ROWS[0][:-1], *ROWS]).encode(), "row 4", ("2 values", "3 values, one per column of the header")),
        (",".join(f"c{i}" for i in range(30)).encode() + b"\n", "columns", "at most 20"),
    ],
)
def test_damaged_csv_is_rejected_with_its_place(tmp_path, monkeypatch, body, field, message):
    monkeypatch.setattr("service.datasets.formats.table.MAX_COLUMNS", 20)
    check_rejected(tmp_path, body, "csv", field, message)


@given(
    rows=st.lists(st.lists(st.floats(allow_nan=False), min_size=3, max_size=3), min_size=1, max_size=20),
    sep=st.sampled_from([",", ";", "\t", "|", " "]),
    quoting=st.sampled_from([writer.QUOTE_MINIMAL, writer.QUOTE_NONNUMERIC]),
)
def test_output_of_the_csv_module_is_read_back(tmp_path_factory, rows, sep, quoting):
    out = io.StringIO()
    writer.writer(out, delimiter=sep, quoting=quoting).writerows([NAMES, *rows])
    result = read(tmp_path_factory.mktemp("csv"), out.getvalue().encode(), "csv")
    np.testing.assert_array_equal(result.rows, rows)


@pytest.mark.parametrize("body", [b"t,q1", b"t,q1\n\n\n"])
def test_header_alone_is_an_empty_table(tmp_path, body):
    assert len(read(tmp_path, body, "csv")["t"]) == 0
