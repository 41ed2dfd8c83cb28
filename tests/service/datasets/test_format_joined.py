"""Text tables in a zip, joined side by side."""

import io

import numpy as np
import pytest

from service.datasets.options import ReadOptions
from service.foundation.errors import ServiceError
from tests.service.datasets import reading
from tests.service.datasets.reading import check_rejected, read

RNG = np.random.default_rng(4)
Q, DQ, TAU = RNG.normal(size=(3, 40, 3))
T = np.arange(40) / 100


def text(values, header="", delimiter=" "):
    file = io.StringIO()
    np.savetxt(file, values, header=header, comments="", delimiter=delimiter)
    return file.getvalue()


def zipped(**members):
    return reading.zipped({name.replace("__", "."): body for name, body in members.items()})


NAMELESS = zipped(a__txt=text(Q), c__txt=text(TAU))
PARTLY_NAMED = zipped(a__txt=text(Q), b__csv=text(T, "t"), c__txt=text(TAU))
OTHER_ROWS = zipped(positions__txt=text(Q), torques__txt=text(TAU[:25]))
OTHER_WIDTH = zipped(positions__txt=text(Q), torques__txt=f"{text(TAU[:3])}1 2\n{text(TAU[4:])}")
OTHER_FILES = zipped(positions__txt=text(Q), picture__png="x")
TABLES = zipped(positions__txt=text(Q), torques__txt=text(TAU))
HEADLESS = text(np.column_stack([T, Q]), delimiter=",").encode()
HEADED = b"t,q1,q2,q3\n" + HEADLESS


def test_columns_without_names_get_them_from_the_file_name(tmp_path):
    body = zipped(time__txt=text(T), positions__txt=text(Q), joint_velocities__csv=text(DQ), tau__txt=text(TAU))
    result = read(tmp_path, body, "zip")
    assert result.names == ("t", *(f"{name}{joint}" for name in ("q", "dq", "tau") for joint in (1, 2, 3)))
    np.testing.assert_array_equal(result.rows, np.column_stack([T, Q, DQ, TAU]))
    assert result.facts[0].startswith("4 files were joined side by side: time.txt, positions.txt")


def test_desired_and_measured_torques_are_not_mixed(tmp_path):
    body = zipped(positions__txt=text(Q), torques_desired__txt=text(TAU), torques_measured__txt=text(DQ))
    names = read(tmp_path, body, "zip").names
    assert names[3:] == tuple(f"torques_{which}_{joint}" for which in ("desired", "measured") for joint in (1, 2, 3))


def test_time_column_of_every_file_is_kept_once_and_must_agree(tmp_path):
    first, second = np.column_stack([T, Q]), np.column_stack([T, TAU])
    parts = {"a__csv": text(first, "t,q1,q2,q3", ","), "b__csv": text(second, "t;tau1;tau2;tau3", ";")}
    result = read(tmp_path, zipped(**parts), "zip")
    assert result.names == ("t", "q1", "q2", "q3", "tau1", "tau2", "tau3")
    np.testing.assert_array_equal(result.rows, np.column_stack([T, Q, TAU]))
    second[7, 0] += 0.5
    parts["b__csv"] = text(second, "t;tau1;tau2;tau3", ";")
    check_rejected(tmp_path, zipped(**parts), "zip", "b.csv: t, row 8", ("0.57", "0.07, as in a.csv"))


@pytest.mark.slow
def test_blocks_of_any_length_are_joined_row_by_row(tmp_path):
    rows = 30_000
    long, wide = np.arange(rows) * 0.5, RNG.integers(0, 1000, size=(rows, 12)).astype(float)
    body = zipped(time__txt=text(long), positions__txt=text(wide), torques__txt=text(-wide))
    result = read(tmp_path, body, "zip", max_samples=rows)
    np.testing.assert_array_equal(result.rows, np.column_stack([long, wide, -wide]))


SIX = ("q1", "q2", "q3", "tau1", "tau2", "tau3")
FOUR = ("t", "q1", "q2", "q3")
HAS_NAMES = "no `column_names` because the first line of the file holds names"


@pytest.mark.parametrize(
    ("body", "kind", "names"),
    [
        (NAMELESS, "zip", SIX),
        (HEADLESS, "csv", FOUR),
        (b"# recorded on Monday\n" + HEADLESS, "csv", FOUR),
    ],
)
def test_column_names_name_files_without_names(tmp_path, body, kind, names):
    result = read(tmp_path, body, kind, ReadOptions(column_names=names))
    assert result.names == names
    np.testing.assert_array_equal(result.rows, np.column_stack([T, Q] if kind == "csv" else [Q, TAU]))


@pytest.mark.parametrize(
    ("body", "kind", "options", "field", "words"),
    [
        (OTHER_ROWS, "zip", {}, "torques.txt", ("a table of 25 rows", "40 rows, like positions.txt")),
        (PARTLY_NAMED, "zip", {}, "a.txt: header", ("missing",)),
        (PARTLY_NAMED, "zip", {}, "a.txt: header", "such as positions.txt. Or set column_names=t,q1..q7,tau1..tau7"),
        (NAMELESS, "zip", {"column_names": SIX[:3]}, "c.txt: column_names", ("0 names left", "3, one per column")),
        (NAMELESS, "zip", {"column_names": (*SIX, "x")}, "column_names", ("1 names too many",)),
        (OTHER_WIDTH, "zip", {}, "torques.txt: row 4", ("2 values",)),
        (OTHER_FILES, "zip", {}, "file", "a zip archive that is damaged or holds other files"),
        (HEADED, "csv", {"dt": 0.01}, "dt", ("0.01", "no `dt` because column t holds times")),
        (HEADLESS, "csv", {"column_names": FOUR[:2]}, "column_names", ("2 names",)),
        (HEADLESS, "csv", {}, "header", "Or set column_names=t,q1..q7,tau1..tau7"),
        (HEADED, "csv", {"column_names": FOUR}, "column_names", ("t, q1, q2, q3", HAS_NAMES)),
    ],
)
def test_contradictory_tables_and_options_are_rejected(tmp_path, body, kind, options, field, words):
    check_rejected(tmp_path, body, kind, field, words, ReadOptions(**options), ServiceError)


def test_dt_adds_times_to_a_file_without_times(tmp_path):
    np.testing.assert_allclose(read(tmp_path, TABLES, "zip", ReadOptions(dt=0.01))["t"], T, atol=1e-15)


def test_dot_q_is_a_velocity_and_currents_are_not_torques(tmp_path):
    body = zipped(**{f"data{name}__txt": text(values) for name, values in (("Q", Q), ("DotQ", DQ), ("Cur", TAU))})
    names = read(tmp_path, body, "zip").names
    assert names == (
        *(f"{name}{joint}" for name in ("q", "dq") for joint in (1, 2, 3)),
        *(f"dataCur_{j}" for j in (1, 2, 3)),
    )


def test_files_of_one_joint_each_are_joined_by_their_names(tmp_path):
    parts = {
        f"joint{j + 1}__csv": text(np.column_stack([T, Q[:, j], TAU[:, j]]), "time,position,torque [Nmm]", ",")
        for j in (1, 0)
    }
    result = read(tmp_path, zipped(**parts), "zip")
    assert result.names[0] == "time"
    assert set(result.names[1:]) == {f"joint{j}/{name}" for j in (1, 2) for name in ("position", "torque [Nmm]")}
    np.testing.assert_array_equal(result["joint2/position"], Q[:, 1])


@pytest.mark.parametrize("again", [False, True], ids=["times go on", "times begin again"])
def test_parts_in_time_are_joined_one_after_the_other(tmp_path, again):
    """Ten parts, whose names sort as text in another order."""
    whole = np.column_stack([T, Q, TAU])
    parts = {}
    for number in range(10):
        rows = whole[4 * number : 4 * number + 4].copy()
        rows[:, 0] -= rows[0, 0] * again
        parts[f"part{number + 1}__csv"] = text(rows, "t,q1,q2,q3,tau1,tau2,tau3", ",")
    result = read(tmp_path, zipped(**dict(sorted(parts.items()))), "zip")
    np.testing.assert_array_equal(result.rows[:, -6:], whole[:, 1:])
    if again:
        np.testing.assert_array_equal(result["episode"], np.repeat(np.arange(10), 4))
    else:
        np.testing.assert_array_equal(result["t"], T)
    assert result.facts[0].startswith("10 files were joined one after the other: part1.csv, part2.csv, part3")
