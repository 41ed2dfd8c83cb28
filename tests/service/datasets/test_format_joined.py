"""Text tables in a zip, joined side by side."""

import io
import zipfile

import numpy as np
import pytest

from service.datasets.options import ReadOptions
from service.foundation.errors import InvalidDataError, InvalidRequestError
from service.foundation.settings import Settings
from tests.service.datasets.reading import read, read_rejected

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


def test_columns_without_names_get_them_from_the_file_name(tmp_path):
    body = zipped(time__txt=text(T), positions__txt=text(Q), joint_velocities__csv=text(DQ), tau__txt=text(TAU))
    result = read(tmp_path, body, "zip")
    assert result.names == ("t", *(f"{name}{joint}" for name in ("q", "dq", "tau") for joint in (1, 2, 3)))
    np.testing.assert_array_equal(result.rows, np.column_stack([T, Q, DQ, TAU]))
    assert result.facts[0].startswith("4 files were joined side by side: time.txt, positions.txt")


def test_desired_and_measured_torques_are_not_mixed(tmp_path):
    body = zipped(positions__txt=text(Q), torques_desired__txt=text(TAU), torques_measured__txt=text(DQ))
    names = read(tmp_path, body, "zip").names
    assert names[3:] == (*(f"torques_desired_{j}" for j in (1, 2, 3)), *(f"torques_measured_{j}" for j in (1, 2, 3)))


def test_time_column_of_every_file_is_kept_once_and_must_agree(tmp_path):
    first, second = np.column_stack([T, Q]), np.column_stack([T, TAU])
    parts = {"a__csv": text(first, "t,q1,q2,q3", ","), "b__csv": text(second, "t;tau1;tau2;tau3", ";")}
    result = read(tmp_path, zipped(**parts), "zip")
    assert result.names == ("t", "q1", "q2", "q3", "tau1", "tau2", "tau3")
    np.testing.assert_array_equal(result.rows, np.column_stack([T, Q, TAU]))
    second[7, 0] += 0.5
    parts["b__csv"] = text(second, "t;tau1;tau2;tau3", ";")
    said = read_rejected(tmp_path, zipped(**parts), "zip", error=InvalidDataError)
    assert said == ("b.csv: t, row 8", "0.57", "0.07, as in a.csv")


@pytest.mark.slow
def test_blocks_of_any_length_are_joined_row_by_row(tmp_path):
    rows = 30_000
    long, wide = np.arange(rows) * 0.5, RNG.integers(0, 1000, size=(rows, 12)).astype(float)
    body = zipped(time__txt=text(long), positions__txt=text(wide), torques__txt=text(-wide[:, :12]))
    result = read(tmp_path, body, "zip", max_samples=rows)
    np.testing.assert_array_equal(result.rows, np.column_stack([long, wide, -wide]))


def test_all_files_must_have_the_same_number_of_rows(tmp_path):
    body = zipped(positions__txt=text(Q), torques__txt=text(TAU[:25]))
    assert read_rejected(tmp_path, body, "zip") == ("torques.txt", "a table of 25 rows", "40 rows, like positions.txt")


def test_column_names_name_all_files_without_names(tmp_path):
    body = zipped(a__txt=text(Q), b__csv=text(T, "t"), c__txt=text(TAU))
    named = ReadOptions(column_names=("q1", "q2", "q3", "tau1", "tau2", "tau3"))
    assert read(tmp_path, zipped(a__txt=text(Q), c__txt=text(TAU)), "zip", named).names == named.column_names
    few = read_rejected(
        tmp_path, zipped(a__txt=text(Q), c__txt=text(TAU)), "zip", ReadOptions(column_names=("q1", "q2", "q3"))
    )
    assert few == ("c.txt: column_names", "0 names left", "3, one per column")
    many = ReadOptions(column_names=(*named.column_names, "x"))
    said = read_rejected(tmp_path, zipped(a__txt=text(Q), c__txt=text(TAU)), "zip", many)
    assert said[:2] == ("column_names", "1 names too many")
    field, value, expected = read_rejected(tmp_path, body, "zip")
    assert (field, value) == ("a.txt: header", "missing")
    assert "such as positions.txt. Or set column_names=t,q1..q7,tau1..tau7" in expected


def test_errors_name_the_file(tmp_path):
    rows = text(TAU).splitlines()
    rows[3] = "1 2"
    body = zipped(positions__txt=text(Q), torques__txt="\n".join(rows))
    assert read_rejected(tmp_path, body, "zip")[:2] == ("torques.txt: row 4", "2 values")


def test_archives_of_other_files_are_not_joined(tmp_path):
    body = zipped(positions__txt=text(Q), picture__png="x")
    assert "a zip archive that is damaged or holds other files" in read_rejected(tmp_path, body, "zip")[1]


def test_dt_adds_times_to_a_file_without_times(tmp_path):
    body = zipped(positions__txt=text(Q), torques__txt=text(TAU))
    result = read(tmp_path, body, "zip", ReadOptions(dt=0.01))
    np.testing.assert_allclose(result["t"], T, atol=1e-15)
    said = read_rejected(
        tmp_path, text(np.column_stack([T, Q]), "t,q1,q2,q3", ",").encode(), "csv", ReadOptions(dt=0.01)
    )
    assert said == ("dt", "0.01", "no `dt` because column t holds times")


def test_column_names_name_a_csv_without_header(tmp_path):
    body = text(np.column_stack([T, Q]), delimiter=",").encode()
    named = ReadOptions(column_names=("t", "q1", "q2", "q3"))
    np.testing.assert_array_equal(read(tmp_path, body, "csv", named).rows, np.column_stack([T, Q]))
    assert read(tmp_path, b"# recorded on Monday\n" + body, "csv", named).names == named.column_names
    assert read_rejected(tmp_path, body, "csv", ReadOptions(column_names=("t", "q1")))[:2] == (
        "column_names",
        "2 names",
    )
    assert "Or set column_names=t,q1..q7,tau1..tau7" in read_rejected(tmp_path, body, "csv")[2]
    headed = b"t,q1,q2,q3\n" + body
    said = read_rejected(tmp_path, headed, "csv", named, InvalidRequestError)
    assert said == ("column_names", "t, q1, q2, q3", "no `column_names` because the first line of the file holds names")


def test_unpacked_size_is_limited(tmp_path):
    body = zipped(positions__txt=text(Q), torques__txt=text(TAU))
    assert Settings().max_unpacked_bytes > 2000
    assert "unpacks to" in read_rejected(tmp_path, body, "zip", max_unpacked_bytes=2000)
