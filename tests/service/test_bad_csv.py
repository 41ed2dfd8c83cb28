"""CSV uploads that cannot be used are refused with the place of the first thing that is wrong."""

from __future__ import annotations

import pytest

from tests.service.data import columns, csv, post, stream
from tests.service.refusal import refused

SHORTEST = 30


def changed(column, row, text):
    """The table with another text in one cell, rows counted from 1."""
    table = columns(stream())
    table[column][row - 1] = text
    return csv(table)


def renamed(**names):
    return csv({names.get(name, name): values for name, values in columns(stream()).items()})


def without(*names):
    return csv({name: values for name, values in columns(stream()).items() if name not in names})


def rows(count):
    return csv({name: values[:count] for name, values in columns(stream(samples=600)).items()})


def lines(change):
    """The file after a change of its lines; the header is line 0."""
    text = csv(columns(stream())).split(b"\n")
    change(text)
    return b"\n".join(text)


def shorten(text):
    text[7] = text[7].rpartition(b",")[0]


def lengthen(text):
    text[7] += b",1"


@pytest.mark.parametrize(
    ("body", "field", "message"),
    [
        pytest.param(renamed(dq2="speed2"), "column dq2", "missing", id="unknown column"),
        pytest.param(renamed(q1="q0"), "column q1", "missing", id="joint zero"),
        pytest.param(csv(columns(stream())).replace(b"q2", b"q1", 1), "column 3", "every column once", id="doubled"),
        pytest.param(without("q2"), "column dq2", "present, expected at most dq1", id="q2 missing"),
        pytest.param(without("q1"), "column q1", "missing", id="q1 missing"),
        pytest.param(without("q1", "q2"), "columns", "positions q1..qn", id="no positions"),
        pytest.param(without("tau1", "tau2"), "column tau1", "missing", id="no torques"),
        pytest.param(without("tau2"), "column tau2", "missing", id="tau2 missing"),
        pytest.param(without("dq2"), "column dq2", "missing", id="dq incomplete"),
        pytest.param(without("ddq1"), "column ddq1", "missing", id="ddq incomplete"),
        pytest.param(without("t", "dq1", "dq2"), "t", "dq must be derived", id="no times for dq"),
        pytest.param(changed("tau2", 4, "1e300"), "tau2, row 4", "SI units", id="absurdly large"),
        pytest.param(changed("q2", 6, "abc"), "q2, row 6", "abc", id="text in a cell"),
        pytest.param(changed("q2", 6, "1,5"), "row 6", "10 values", id="decimal comma"),
        pytest.param(changed("t", 40, "0.5"), "t, row 40", "the time before it", id="time going backwards"),
        pytest.param(lines(shorten), "row 7", "8 values", id="short row"),
        pytest.param(lines(lengthen), "row 7", "10 values", id="long row"),
        pytest.param(b"", "file", "empty", id="empty file"),
        pytest.param(b"\n\n\n", "header", "empty", id="empty lines"),
        pytest.param(rows(0), "rows", "at least 30", id="header only"),
        pytest.param(rows(0).rstrip(), "rows", "at least 30", id="header without a line end"),
        pytest.param(lines(lambda text: text.pop(0)), "header", "column names", id="no header"),
        pytest.param(rows(SHORTEST - 1), "rows", "at least 30", id="too few samples"),
        pytest.param(rows(501), "rows", "at most 500", id="too many samples"),
        pytest.param(csv(columns(stream())).replace(b"\n", b"\n\xff", 1), "file", "UTF-8", id="not UTF-8"),
        pytest.param(csv(columns(stream())).decode().encode("utf-16"), "file", "text in UTF-16", id="UTF-16"),
        pytest.param(b"t,q1\0,tau1\n0,0,0\n", "file", "binary", id="NUL in the header"),
        pytest.param(changed("q1", 3, "1\x002"), "q1, row 3", "a number", id="NUL in a cell"),
        pytest.param(b"\x89PNG\r\n\x1a\n" + bytes(1000), "file", "a picture", id="a picture"),
        pytest.param(b'"' + csv(columns(stream())), "header", "column names", id="open quote"),
        pytest.param(csv(columns(stream())) + b'"', "row 81", "1 values", id="open quote at the end"),
    ],
)
def test_refused_with_the_place_and_what_was_expected(strict, body, field, message):
    said = refused(strict, body, "text/csv")
    assert said["detail"][0]["field"] == field
    assert message in said["message"]


@pytest.mark.parametrize(
    ("column", "row", "text"),
    [
        ("dq2", 5, "nan"),
        ("tau1", 80, "inf"),
        ("ddq1", 1, "-Infinity"),
        ("q1", 9, "1e400"),
        ("t", 3, "nan"),
        ("tau2", 6, ""),
        ("t", 40, "3.8"),
    ],
)
def test_rows_that_lack_a_value_or_repeat_a_time_are_left_out_and_said_to_be(strict, column, row, text):
    answer = post(strict, changed(column, row, text), "text/csv")
    assert answer.status_code == 201, answer.text
    report = answer.json()["report"]
    assert (report["rows_uploaded"], report["rows"]) == (80, 79)
    said = f"1 row {'whose time stamp was there before' if text == '3.8' else 'with missing values'} left out"
    assert report["preparation"][0].startswith(said)
    assert str(row) in report["preparation"][0]


@pytest.mark.parametrize(
    "body",
    [
        pytest.param(renamed(q1="Q1", q2="Q2"), id="capitals"),
        pytest.param(renamed(q1="q01", q2="q02"), id="leading zeros"),
        pytest.param(csv(columns(stream())).replace(b",", b";"), id="semicolons"),
        pytest.param(csv({**columns(stream()), "phase": ["1"] * 80}), id="a column that nobody knows"),
    ],
)
def test_what_can_be_understood_is_taken(strict, body):
    answer = post(strict, body, "text/csv")
    assert answer.status_code == 201, answer.text
    assert answer.json()["report"]["rows"] == 80


def test_degrees_are_recognised(strict):
    table = columns(stream())
    table["q2"][11] = "90"
    said = refused(strict, csv(table), "text/csv")
    assert said["detail"][0] == {
        "field": "q2, row 12",
        "value": "90",
        "expected": 'radians (or metres) within ±12.6: are these degrees? Then say units={"q": "deg"}',
    }


def test_a_joint_that_never_moves_is_named(strict):
    table = columns(stream())
    table["q1"] = ["0.25"] * len(table["q1"])
    said = refused(strict, csv(table), "text/csv")
    assert said["message"] == (
        "q1 is constant at 0.25, expected a joint that moves: leave out locked joints, drop_joints=joint1"
    )


def test_too_many_joints(strict):
    table = {name: ["0"] * 40 for kind in ("q", "tau") for name in (f"{kind}{joint}" for joint in range(1, 10))}
    said = refused(strict, csv(table), "text/csv")
    assert said["detail"][0] == {"field": "joints", "value": "9", "expected": "1 to 8"}


def test_a_huge_joint_number_needs_no_huge_answer(strict):
    said = refused(strict, b"q9999,tau1\n1,2\n", "text/csv")
    assert said["detail"][0]["field"] == "column q1"
    assert len(said["message"]) < 200


def test_a_long_value_is_cut(strict):
    said = refused(strict, changed("q1", 1, "x" * 50_000), "text/csv")
    assert said["detail"][0]["field"] == "q1, row 1"
    assert len(said["detail"][0]["value"]) <= 201
