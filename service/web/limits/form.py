"""The file of a form (`multipart/form-data`), taken out piece by piece as it comes.

Not Starlette's form: that keeps whole files in memory or in the system's temporary folder, whose size nobody limits.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header

from service.foundation.errors import InvalidRequestError, invalid_request, problem

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
        found = b"".join(self._pieces)
        self._pieces.clear()
        return found

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
