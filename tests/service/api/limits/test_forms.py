"""The file of a multipart form: read in pieces of any size, and rejected if the form is wrong."""

import io
import random

import httpx
import pytest

from service.api.limits.upload import MAX_PARTS, FormFile
from service.foundation.errors import InvalidRequestError

CONTENT = b"--x\r\n\r\n" + bytes(range(256)) * 20 + b"\r\n--x"
"""Content that looks like the end of a part, but is none."""


def encoded(**form):
    """Return content type and body of a form as a client sends it."""
    request = httpx.Request("POST", "http://localhost", **form)
    return request.headers["content-type"], request.read()


def read(content_type, pieces):
    form = FormFile(content_type)
    content = b"".join(form.feed(piece) for piece in pieces)
    return form.end(), content


def parse_rejected(content_type, body):
    with pytest.raises(InvalidRequestError) as caught:
        read(content_type, [body])
    return caught.value


@pytest.mark.parametrize("max_size", [1, 7, 100, 10_000])
def test_file_does_not_depend_on_the_size_of_pieces(max_size):
    sizes = random.Random(max_size)
    kind, body = encoded(files={"file": ("ö (1).csv", CONTENT)}, data={"note": "passed over", "other": "x" * 2000})
    stream = io.BytesIO(body)
    pieces = iter(lambda: stream.read(sizes.randint(1, max_size)), b"")
    assert read(kind, pieces) == ("ö (1).csv", CONTENT)


def test_empty_file_is_a_file():
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
def test_form_has_one_file_and_few_other_bytes(form, field, value):
    (problem,) = parse_rejected(*encoded(**form)).detail
    assert problem.field == field
    assert value in (None, problem.value)


BROKEN = {
    "no boundary": ("", b""),
    "empty boundary": ("; boundary=", b""),
    "long boundary": (f"; boundary={'x' * 300}", b""),
    "garbage": ("; boundary=x", b"garbage"),
    "nothing": ("; boundary=x", b""),
    "half": ("; boundary=x", HEAD + b"half"),
    "endless header": ("; boundary=x", b"--x\r\nContent-Disposition: " + b"a" * 100_000),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_broken_or_short_form_is_rejected(kind):
    boundary, body = BROKEN[kind]
    parse_rejected(f"multipart/form-data{boundary}", body)
