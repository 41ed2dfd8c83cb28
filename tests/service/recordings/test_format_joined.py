"""Tables of text in a zip, joined side by side: which columns they become, and what must agree."""

import io
import zipfile

import numpy as np

from service.datasets.options import ReadOptions
from service.foundation.errors import InvalidDataError, InvalidRequestError
from service.foundation.settings import Settings
from tests.service.recordings.reading import read, refused

RNG = np.random.default_rng(4)
Q, DQ, TAU = RNG.normal(size=(3, 40, 3))
T = np.arange(40) / 100


def text(values, header="", delimiter=" "):
    file = io.StringIO()
    np.savetxt(file, values, header=header, comments="", delimiter=delimiter)
    return file.getvalue()


def zipped(**members):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, body in members.items():
            archive.writestr(name.replace("__", "."), body)
    return file.getvalue()


def test_files_without_names_are_named_by_what_they_are_called(tmp_path):
    body = zipped(time__txt=text(T), positions__txt=text(Q), joint_velocities__csv=text(DQ), tau__txt=text(TAU))
    result = read(tmp_path, body, "zip")
    assert result.names == ("t", *(f"{name}{joint}" for name in ("q", "dq", "tau") for joint in (1, 2, 3)))
    np.testing.assert_array_equal(result.rows, np.column_stack([T, Q, DQ, TAU]))
    assert result.facts[0].startswith("4 files are joined side by side: time.txt, positions.txt")


def test_what_was_desired_is_not_taken_for_measured(tmp_path):
    body = zipped(positions__txt=text(Q), torques_desired__txt=text(TAU), torques_measured__txt=text(DQ))
    names = read(tmp_path, body, "zip").names
    assert names[3:] == (*(f"torques_desired_{j}" for j in (1, 2, 3)), *(f"torques_measured_{j}" for j in (1, 2, 3)))


def test_a_clock_that_every_file_has_is_kept_once_and_must_agree(tmp_path):
    first, second = np.column_stack([T, Q]), np.column_stack([T, TAU])
    parts = {"a__csv": text(first, "t,q1,q2,q3", ","), "b__csv": text(second, "t;tau1;tau2;tau3", ";")}
    result = read(tmp_path, zipped(**parts), "zip")
    assert result.names == ("t", "q1", "q2", "q3", "tau1", "tau2", "tau3")
    np.testing.assert_array_equal(result.rows, np.column_stack([T, Q, TAU]))
    second[7, 0] += 0.5
    parts["b__csv"] = text(second, "t;tau1;tau2;tau3", ";")
    said = refused(tmp_path, zipped(**parts), "zip", error=InvalidDataError)
    assert said == ("b.csv: t, row 8", "0.57", "0.07, as a.csv has")


def test_blocks_of_any_length_are_joined_row_by_row(tmp_path):
    rows = 30_000
    long, wide = np.arange(rows) * 0.5, RNG.integers(0, 1000, size=(rows, 12)).astype(float)
    body = zipped(time__txt=text(long), positions__txt=text(wide), torques__txt=text(-wide[:, :12]))
    result = read(tmp_path, body, "zip", max_samples=rows)
    np.testing.assert_array_equal(result.rows, np.column_stack([long, wide, -wide]))


def test_as_many_rows_are_expected_in_each(tmp_path):
    body = zipped(positions__txt=text(Q), torques__txt=text(TAU[:25]))
    assert refused(tmp_path, body, "zip") == ("torques.txt", "25 rows", "40, as positions.txt has")


def test_names_can_be_given_for_all_files_without_any(tmp_path):
    body = zipped(a__txt=text(Q), b__csv=text(T, "t"), c__txt=text(TAU))
    named = ReadOptions(column_names=("q1", "q2", "q3", "tau1", "tau2", "tau3"))
    assert read(tmp_path, zipped(a__txt=text(Q), c__txt=text(TAU)), "zip", named).names == named.column_names
    few = refused(
        tmp_path, zipped(a__txt=text(Q), c__txt=text(TAU)), "zip", ReadOptions(column_names=("q1", "q2", "q3"))
    )
    assert few == ("c.txt: column_names", "0 names that are left", "3, one a column")
    many = ReadOptions(column_names=(*named.column_names, "x"))
    said = refused(tmp_path, zipped(a__txt=text(Q), c__txt=text(TAU)), "zip", many)
    assert said[:2] == ("column_names", "1 names too many")
    field, value, expected = refused(tmp_path, body, "zip")
    assert (field, value) == ("a.txt: header", "missing")
    assert "such as positions.txt; or column_names=t,q1..q7,tau1..tau7" in expected


def test_errors_name_the_file(tmp_path):
    rows = text(TAU).splitlines()
    rows[3] = "1 2"
    body = zipped(positions__txt=text(Q), torques__txt="\n".join(rows))
    assert refused(tmp_path, body, "zip")[:2] == ("torques.txt: row 4", "2 values")


def test_archives_of_other_files_are_not_joined(tmp_path):
    body = zipped(positions__txt=text(Q), picture__png="x")
    assert "of no known kind" in refused(tmp_path, body, "zip")[1] or "zip archive" in refused(tmp_path, body, "zip")[1]


def test_times_are_counted_where_there_are_none(tmp_path):
    body = zipped(positions__txt=text(Q), torques__txt=text(TAU))
    result = read(tmp_path, body, "zip", ReadOptions(dt=0.01))
    np.testing.assert_allclose(result["t"], T, atol=1e-15)
    said = refused(tmp_path, text(np.column_stack([T, Q]), "t,q1,q2,q3", ",").encode(), "csv", ReadOptions(dt=0.01))
    assert said == ("dt", "0.01", "none, as column t holds times")


def test_a_table_without_names_takes_those_that_are_given(tmp_path):
    body = text(np.column_stack([T, Q]), delimiter=",").encode()
    named = ReadOptions(column_names=("t", "q1", "q2", "q3"))
    np.testing.assert_array_equal(read(tmp_path, body, "csv", named).rows, np.column_stack([T, Q]))
    assert read(tmp_path, b"# recorded on Monday\n" + body, "csv", named).names == named.column_names
    assert refused(tmp_path, body, "csv", ReadOptions(column_names=("t", "q1")))[:2] == ("column_names", "2 names")
    assert "column_names=t,q1..q7,tau1..tau7 names them" in refused(tmp_path, body, "csv")[2]
    headed = b"t,q1,q2,q3\n" + body
    said = refused(tmp_path, headed, "csv", named, InvalidRequestError)
    assert said == ("column_names", "t, q1, q2, q3", "none, as the first line of the file holds names")


def test_no_more_is_unpacked_than_the_limit(tmp_path):
    body = zipped(positions__txt=text(Q), torques__txt=text(TAU))
    assert Settings().max_unpacked_bytes > 2000
    assert "unpacks to" in refused(tmp_path, body, "zip", max_unpacked_bytes=2000)
