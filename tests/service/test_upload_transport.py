"""How an upload arrives: media types, forms, sizes."""

from __future__ import annotations

import pytest

from service.datasets.asking import MEDIA_TYPES, SUFFIXES
from tests.service.data import columns, csv, error, post, stream
from tests.service.refusal import nothing_stays, refused

GOOD = csv(columns(stream()))
LIMIT = 200_000


def in_chunks(size, chunk=10_000):
    """A body whose length is not announced."""
    return (b"x" * chunk for _ in range(size // chunk))


@pytest.mark.parametrize("media_type", ["application/pdf", "text/plain", "application/octet-stream", "", "text/csvx"])
def test_other_media_types_are_refused_with_those_that_are_accepted(strict, media_type):
    said = refused(strict, GOOD, media_type, 415, "unsupported_media_type")
    assert said["detail"][0]["field"] == "content-type"
    assert all(each in said["message"] for each in (*MEDIA_TYPES, "multipart/form-data"))


@pytest.mark.parametrize("file_name", ["stream.xlsx", "stream", "stream.csv.exe", ".csv"])
def test_unknown_endings_are_refused_with_those_that_are_known(strict, file_name):
    answer = strict.post("/v1/datasets", files={"file": (file_name, GOOD)})
    said = error(answer, 415, "unsupported_media_type")
    assert said["detail"][0]["value"] == file_name
    assert all(each in said["message"] for each in SUFFIXES)
    nothing_stays(strict)


@pytest.mark.parametrize(
    "form",
    [
        pytest.param({"files": {"data": ("stream.csv", GOOD)}}, id="another field"),
        pytest.param({"files": {"other": ("stream.csv", GOOD)}, "data": {"file": "text"}}, id="text in the field"),
        pytest.param({"files": {"file": ("", GOOD)}}, id="no file name"),
    ],
)
def test_a_form_without_a_file_is_refused(strict, form):
    said = error(strict.post("/v1/datasets", **form), 422, "invalid_request")
    assert said["detail"] == [
        {"field": "file", "value": "missing", "expected": "a file in the form field `file`"},
    ]
    nothing_stays(strict)


@pytest.mark.parametrize("media_type", ["multipart/form-data", "multipart/form-data; boundary=x"])
def test_a_broken_form_is_refused(strict, media_type):
    refused(strict, b"garbage", media_type, 422, "invalid_request")


def test_two_files_are_refused(strict):
    files = [("file", ("a.csv", GOOD)), ("file", ("b.csv", GOOD))]
    error(strict.post("/v1/datasets", files=files), 422, "invalid_request")
    nothing_stays(strict)


@pytest.mark.parametrize("media_type", ["text/csv", "application/x-npz"])
@pytest.mark.parametrize("body", [lambda: b"x" * (LIMIT + 1), lambda: in_chunks(LIMIT + 10_000)])
def test_a_body_beyond_the_limit_is_refused(strict, media_type, body):
    said = refused(strict, body(), media_type, 413, "too_large")
    assert str(LIMIT) in said["message"]


def test_a_form_beyond_the_limit_is_refused(strict):
    error(strict.post("/v1/datasets", files={"file": ("a.csv", b"x" * LIMIT)}), 413, "too_large")
    nothing_stays(strict)


def test_a_body_at_the_limit_is_read(strict):
    said = refused(strict, b"x" * LIMIT, "text/csv")
    assert said["detail"][0]["field"] == "header"


@pytest.mark.parametrize(
    ("params", "field"),
    [
        ({"cutoff": "0"}, "cutoff"),
        ({"cutoff": "nan"}, "cutoff"),
        ({"cutoff": "inf"}, "cutoff"),
        ({"cutoff": "slow"}, "cutoff"),
        ({"torque_convention": "total"}, "torque_convention"),
        ({"name": "x" * 201}, "name"),
    ],
)
def test_bad_parameters_are_named(strict, params, field):
    said = error(post(strict, GOOD, "text/csv", **params), 422, "invalid_request")
    assert said["detail"][0]["field"] == field
    nothing_stays(strict)


@pytest.mark.parametrize("names", ["a", "a,b,c", "a,a", "a,", "", "a,b\x7f"])
def test_bad_joint_names_are_refused(strict, names):
    said = error(post(strict, GOOD, "text/csv", joint_names=names), 422, "invalid_data")
    assert said["detail"][0]["field"].startswith("joint_names")
    nothing_stays(strict)
