"""The file of a form: taken out in any pieces, and what is refused."""

from __future__ import annotations

import random

import httpx
import pytest

from service.foundation.errors import InvalidRequestError
from service.web.limits.upload import MAX_PARTS, FormFile

CONTENT = b"--x\r\n\r\n" + bytes(range(256)) * 20 + b"\r\n--x"
"""What looks like the ends of parts, and is none."""


def encoded(**form):
    """Content-type and body of a form as a client sends it."""
    request = httpx.Request("POST", "http://localhost", **form)
    return request.headers["content-type"], request.read()


def read(content_type, pieces):
    form = FormFile(content_type)
    found = b"".join(form.feed(piece) for piece in pieces)
    return form.end(), found


def refused(content_type, body):
    with pytest.raises(InvalidRequestError) as caught:
        read(content_type, [body])
    return caught.value


@pytest.mark.parametrize("most", [1, 7, 100, 10_000])
def test_a_file_is_the_same_in_whatever_pieces_it_comes(most):
    sizes = random.Random(most)
    kind, body = encoded(files={"file": ("ö (1).csv", CONTENT)}, data={"note": "passed over", "other": "x" * 2000})
    pieces, at = [], 0
    while at < len(body):
        size = sizes.randint(1, most)
        pieces.append(body[at : at + size])
        at += size
    assert read(kind, pieces) == ("ö (1).csv", CONTENT)


def test_an_empty_file_is_a_file():
    kind, body = encoded(files={"file": ("a.csv", b"")})
    assert read(kind, [body]) == ("a.csv", b"")


@pytest.mark.parametrize(
    "form",
    [
        {"files": {"data": ("a.csv", b"x")}},
        {"files": {"other": ("a.csv", b"x")}, "data": {"file": "text"}},
    ],
    ids=["another field", "text in the field"],
)
def test_a_form_without_the_file_says_so(form):
    error = refused(*encoded(**form))
    assert error.detail[0].field == "file"
    assert error.detail[0].value == "missing"


def test_two_files_are_refused():
    error = refused(*encoded(files=[("file", ("a.csv", b"1")), ("file", ("b.csv", b"2"))]))
    assert error.detail[0].field == "file"


def test_many_parts_are_refused():
    kind, body = encoded(files={"file": ("a.csv", b"1")}, data={f"f{i}": "x" for i in range(MAX_PARTS)})
    assert refused(kind, body).detail[0].field == "form"


@pytest.mark.parametrize(
    "content_type",
    ["multipart/form-data", "multipart/form-data; boundary=", f"multipart/form-data; boundary={'x' * 300}"],
)
def test_a_boundary_is_needed(content_type):
    refused(content_type, b"")


@pytest.mark.parametrize(
    "body",
    [b"garbage", b"", b"--x\r\nContent-Disposition: form-data; name=file; filename=a.csv\r\n\r\nhalf"],
    ids=["garbage", "nothing", "half"],
)
def test_a_form_that_is_broken_or_ends_early_is_refused(body):
    refused("multipart/form-data; boundary=x", body)


def test_headers_of_a_part_without_end_are_refused():
    refused("multipart/form-data; boundary=x", b"--x\r\nContent-Disposition: " + b"a" * 100_000)
