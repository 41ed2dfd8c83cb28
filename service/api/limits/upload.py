"""Uploads: receives a file, as the body of a request or in a form, within the limits of body and disk.

A form is parsed piece by piece. Starlette's form is not used: it keeps whole files in memory or in the system's
temporary folder, which has no limit.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from anyio import to_thread
from fastapi import Request
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header

from service.foundation.errors import InvalidRequestError, UnsupportedMediaTypeError, invalid_request, problem
from service.foundation.fields import MAX_NAME_CHARS, check_name
from service.storage.disk import Disk

if TYPE_CHECKING:
    from python_multipart.multipart import MultipartCallbacks

FIELD = "file"
MAX_PARTS = 9


class FormFile:
    """Parser of a form with one file in the field `file`. Other fields are ignored.

    `file_name` is the name given by the client, None until the file begins.
    """

    def __init__(self, content_type: str) -> None:
        """Raise InvalidRequestError if the content-type has no boundary."""
        boundary = parse_options_header(content_type)[1].get(b"boundary")
        if not boundary:
            raise invalid_request("content-type", content_type, "multipart/form-data; boundary=…")
        self.file_name: str | None = None
        self._parts, self._taking, self._ended = 0, False, False
        self._name, self._value, self._disposition = b"", b"", b""
        self._pieces: list[bytes] = []
        callbacks: MultipartCallbacks = {
            "on_part_begin": self._begin,
            "on_header_field": self._header_name,
            "on_header_value": self._header_value,
            "on_header_end": self._header_end,
            "on_headers_finished": self._headers,
            "on_part_data": self._data,
            "on_end": self._end,
        }
        try:
            self._parser = MultipartParser(boundary, callbacks)
        except FormParserError as error:
            raise _broken(error) from None

    def feed(self, data: bytes) -> bytes:
        """Parse a piece of the body and return its part of the file; raise InvalidRequestError."""
        try:
            self._parser.write(data)
        except FormParserError as error:
            raise _broken(error) from None
        content = b"".join(self._pieces)
        self._pieces.clear()
        return content

    def end(self) -> str:
        """Finish and return the file's name; raise InvalidRequestError if the form is incomplete or has no file."""
        if not self._ended:  # the parser does not check it: half a file would be accepted
            raise _broken("its last boundary is missing")
        if self.file_name is None:
            expected = f"a file in the form field `{FIELD}`"
            raise invalid_request(FIELD, "missing", expected, f"The form has no file. Send {expected}.")
        return self.file_name

    def _begin(self) -> None:
        self._parts += 1
        if self._parts > MAX_PARTS:
            given, expected = f"more than {MAX_PARTS} parts", f"one file in the field `{FIELD}`"
            raise invalid_request("form", given, expected, f"The form has {given}, expected {expected}.")
        self._disposition = b""

    def _header_name(self, data: bytes, start: int, end: int) -> None:
        self._name += data[start:end]

    def _header_value(self, data: bytes, start: int, end: int) -> None:
        self._value += data[start:end]

    def _header_end(self) -> None:
        if self._name.lower() == b"content-disposition":
            self._disposition = self._value
        self._name = self._value = b""

    def _headers(self) -> None:
        options = parse_options_header(self._disposition)[1]
        given = options.get(b"filename")
        self._taking = given is not None and options.get(b"name") == FIELD.encode()
        if given is None or not self._taking:
            return
        if self.file_name is not None:
            message = "The form has more than one file. Upload the files one by one."
            raise invalid_request(FIELD, "more than one file", "one file", message)
        self.file_name = given.decode("utf-8", "replace")

    def _end(self) -> None:
        self._ended = True

    def _data(self, data: bytes, start: int, end: int) -> None:
        if self._taking:
            self._pieces.append(data[start:end])


def _broken(error: FormParserError | str) -> InvalidRequestError:
    """Return the error for a form that cannot be read."""
    return invalid_request("body", str(error), "multipart/form-data", f"The form could not be read: {error}")


FORM = "multipart/form-data"
WRITE_BYTES = 1 << 20
"""Bytes that are written together. Writing every received piece in a thread would take longer."""


@dataclass(frozen=True)
class Kinds:
    """The kinds of files that a route accepts: of a body by media type, of a form's file by suffix."""

    media_types: Mapping[str, str]
    suffixes: Mapping[str, str]

    def of_body(self, media_type: str) -> str:
        """Return the kind of a body; raise UnsupportedMediaTypeError."""
        kind = self.media_types.get(media_type)
        if kind is None:
            raise _unsupported("content-type", media_type, f"{', '.join(self.media_types)} or {FORM}")
        return kind

    def of_file(self, name: str) -> str:
        """Return the kind of a file by the suffix of its name; raise UnsupportedMediaTypeError."""
        kind = self.suffixes.get(Path(name).suffix.lower())
        if kind is None:
            raise _unsupported("file name", name, f"the ending {' or '.join(self.suffixes)}")
        return kind


class Received(NamedTuple):
    """Kind and name of an upload. The name has no folders; it is None if the body was the file."""

    kind: str
    file_name: str | None


async def receive_to(request: Request, path: Path, kinds: Kinds, disk: Disk) -> Received:
    """Write an upload to `path`, which the caller deletes. Check what is possible before reading the body.

    Raise UnsupportedMediaTypeError, StorageFullError, or InvalidRequestError for a wrong form. Middleware raises
    HTTPException 413 for a too large body and 408 for a too slow one.
    """
    upload = _Upload(request, kinds)
    announced = request.headers.get("content-length", "")
    await to_thread.run_sync(disk.require, int(announced) if announced.isdecimal() else 0)
    with path.open("wb") as file:

        def write(pieces: list[bytes]) -> None:
            data = b"".join(pieces)
            disk.reserve(len(data))
            file.write(data)

        waiting: list[bytes] = []
        held = 0
        async for piece in upload.pieces():
            waiting.append(piece)
            held += len(piece)
            if held >= WRITE_BYTES:
                await to_thread.run_sync(write, waiting)
                waiting, held = [], 0
        await to_thread.run_sync(write, waiting)
    return upload.received


async def receive(request: Request, kinds: Kinds) -> tuple[Received, bytes]:
    """Read a small upload into memory; raise as `receive_to`, except StorageFullError."""
    upload = _Upload(request, kinds)
    content = b"".join([piece async for piece in upload.pieces()])
    return upload.received, content


class _Upload:
    """The file of a request. `received` is complete when all pieces have been read."""

    def __init__(self, request: Request, kinds: Kinds) -> None:
        self.request, self.kinds = request, kinds
        media_type = request.headers.get("content-type", "")
        self.form = FormFile(media_type) if _bare(media_type) == FORM else None
        self.received = Received("", None) if self.form else Received(kinds.of_body(_bare(media_type)), None)

    async def pieces(self) -> AsyncIterator[bytes]:
        """Yield the file piece by piece."""
        if self.form is None:
            async for piece in self.request.stream():
                yield piece
            return
        async for piece in self.request.stream():
            content = self.form.feed(piece)
            if self.form.file_name is not None and self.received.file_name is None:
                self._name(self.form.file_name)
            yield content
        self._name(self.form.end())

    def _name(self, given: str) -> None:
        name = Path(given.replace("\\", "/")).name  # some browsers send the whole path
        kind = self.kinds.of_file(name)
        self.received = Received(kind, check_name("file name", name[:MAX_NAME_CHARS]))


def _bare(media_type: str) -> str:
    return media_type.partition(";")[0].strip().lower()


def _unsupported(field: str, value: str, expected: str) -> UnsupportedMediaTypeError:
    item = problem(field, value, expected)
    return UnsupportedMediaTypeError(f"{field} is {item.value!r}, expected {expected}", [item])
