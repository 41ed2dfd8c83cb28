"""Uploads: a file as the body of a request, or in a form, received within the limits of body and disk.

A form's file is taken out piece by piece as it comes. Not Starlette's form: that keeps whole files in memory or in the
system's temporary folder, whose size nobody limits.
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
    """Reads a form with one file, in the field `file`; other fields are passed over.

    file_name: as the client gave it, None until the file begins.
    """

    def __init__(self, content_type: str) -> None:
        """Raise InvalidRequestError where the content-type names no boundary between parts."""
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
        """Take a piece of the body; return what of it belongs to the file. Raise InvalidRequestError."""
        try:
            self._parser.write(data)
        except FormParserError as error:
            raise _broken(error) from None
        content = b"".join(self._pieces)
        self._pieces.clear()
        return content

    def end(self) -> str:
        """Finish and return the file's name; raise InvalidRequestError where the form ends early or had no file."""
        if not self._ended:  # the parser itself does not mind, and half a file would be taken for the whole
            raise _broken("its last boundary is missing")
        if self.file_name is None:
            raise invalid_request(FIELD, "missing", f"a file in the form field `{FIELD}`")
        return self.file_name

    def _begin(self) -> None:
        self._parts += 1
        if self._parts > MAX_PARTS:
            raise invalid_request("form", f"more than {MAX_PARTS} parts", f"one file, in the field `{FIELD}`")
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
            raise invalid_request(FIELD, "more than one file", "one file: upload them one by one")
        self.file_name = given.decode("utf-8", "replace")

    def _end(self) -> None:
        self._ended = True

    def _data(self, data: bytes, start: int, end: int) -> None:
        if self._taking:
            self._pieces.append(data[start:end])


def _broken(error: FormParserError | str) -> InvalidRequestError:
    """Error for a form that cannot be read."""
    item = problem("body", f"no form: {error}", "multipart/form-data")
    return InvalidRequestError(f"the form cannot be read: {error}", [item])


FORM = "multipart/form-data"
WRITE_BYTES = 1 << 20
"""Bytes that are written together: going to a thread for each piece that the network brings costs more."""


@dataclass(frozen=True)
class Kinds:
    """What a route takes. media_types: kind of a body by its content-type; suffixes: of a form's file by its ending."""

    media_types: Mapping[str, str]
    suffixes: Mapping[str, str]

    def of_body(self, media_type: str) -> str:
        """Kind of a body; raise UnsupportedMediaTypeError."""
        kind = self.media_types.get(media_type)
        if kind is None:
            raise _unsupported("content-type", media_type, f"{', '.join(self.media_types)} or {FORM}")
        return kind

    def of_file(self, name: str) -> str:
        """Kind of a file by the ending of its name; raise UnsupportedMediaTypeError."""
        kind = self.suffixes.get(Path(name).suffix.lower())
        if kind is None:
            raise _unsupported("file name", name, f"the ending {' or '.join(self.suffixes)}")
        return kind


class Received(NamedTuple):
    """What an upload is. file_name: without folders, None where the body was the file."""

    kind: str
    file_name: str | None


async def receive_to(request: Request, path: Path, kinds: Kinds, disk: Disk) -> Received:
    """Write an upload to `path`, which the caller deletes; raise before the body is read where that is wrong already.

    Raise UnsupportedMediaTypeError, InvalidRequestError (a form), StorageFullError; middleware raises HTTPException 413
    beyond the limit of the path and 408 where the body comes too slowly.
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
    """Read a small upload into memory; raise as `receive_to`, but for the disk."""
    upload = _Upload(request, kinds)
    content = b"".join([piece async for piece in upload.pieces()])
    return upload.received, content


class _Upload:
    """The file of a request. received: what it is, known at the latest when all pieces are read."""

    def __init__(self, request: Request, kinds: Kinds) -> None:
        self.request, self.kinds = request, kinds
        media_type = request.headers.get("content-type", "")
        self.form = FormFile(media_type) if _bare(media_type) == FORM else None
        self.received = Received("", None) if self.form else Received(kinds.of_body(_bare(media_type)), None)

    async def pieces(self) -> AsyncIterator[bytes]:
        """The file, piece by piece."""
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
