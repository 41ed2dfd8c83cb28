"""Uploads: a file as the body of a request, or in a form, received within the limits of body and disk."""

from __future__ import annotations

from collections.abc import AsyncIterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from anyio import to_thread
from fastapi import Request

from service.foundation.errors import UnsupportedMediaTypeError, problem
from service.foundation.names import LONGEST, for_people
from service.storage.disk import Disk
from service.web.limits.form import FormFile

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
            disk.take(len(data))
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
        self.received = Received(kind, for_people("file name", name[:LONGEST]))


def _bare(media_type: str) -> str:
    return media_type.partition(";")[0].strip().lower()


def _unsupported(field: str, value: str, expected: str) -> UnsupportedMediaTypeError:
    item = problem(field, value, expected)
    return UnsupportedMediaTypeError(f"{field} is {item.value!r}, expected {expected}", [item])
