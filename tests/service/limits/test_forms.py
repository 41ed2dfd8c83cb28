"""The file of a form: taken out in any pieces, and what is refused."""

import random

import httpx
import pytest

from service.api.limits.upload import MAX_PARTS, FormFile
from service.foundation.errors import InvalidRequestError

CONTENT = b"--x\r\n\r\n" + bytes(range(256)) * 20 + b"\r\n--x"
"""What looks like the ends of parts, and is none."""


def encoded(**form):
    """Content-type and body of a form as a client sends it."""
    request = httpx.Request("POST", "http://localhost", **form)
    return request.headers["content-type"], request.read()


def read(content_type, pieces):
    form = FormFile(content_type)
    content = b"".join(form.feed(piece) for piece in pieces)
    return form.end(), content


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


FILE = {"files": {"file": ("a.csv", b"1")}}
HEAD = b"--x\r\nContent-Disposition: form-data; name=file; filename=a.csv\r\n\r\n"


@pytest.mark.parametrize(
    ("form", "field", "value"),
    [
        ({"files": {"data": ("a.csv", b"x")}}, "file", "missing"),
        ({"files": {"other": ("a.csv", b"x")}, "data": {"file": "text"}}, "file", "missing"),
        ({"files": [("file", ("a.csv", b"1")), ("file", ("b.csv", b"2"))]}, "file", None),
        (FILE | {"data": {f"f{i}": "x" for i in range(MAX_PARTS)}}, "form", None),
    ],
    ids=["another field", "text in the field", "two files", "many parts"],
)
def test_a_form_holds_one_file_and_little_else(form, field, value):
    (problem,) = refused(*encoded(**form)).detail
    assert problem.field == field
    assert value in (None, problem.value)


@pytest.mark.parametrize("boundary", ["", "; boundary=", f"; boundary={'x' * 300}"], ids=["none", "empty", "long"])
def test_a_boundary_is_needed(boundary):
    refused(f"multipart/form-data{boundary}", b"")


@pytest.mark.parametrize(
    "body",
    [b"garbage", b"", HEAD + b"half", b"--x\r\nContent-Disposition: " + b"a" * 100_000],
    ids=["garbage", "nothing", "half", "endless header"],
)
def test_a_form_that_is_broken_or_ends_early_is_refused(body):
    refused("multipart/form-data; boundary=x", body)
