"""Sizes of a Parquet file's pages before Arrow reads them: what they unpack to is said in each, and believed by it."""

from __future__ import annotations

import struct
from typing import IO

import pyarrow.parquet as pq

from service.foundation.errors import TooLargeError, invalid_data
from service.foundation.settings import Settings

MAGIC = b"PAR1"
MAX_FOOTER = 16 * 1024 * 1024
MAX_PAGE = 64 * 1024 * 1024
"""Largest page once unpacked; writers make them of about 1 MiB."""
MAX_PAGES = 200_000
HEADER_BYTES = 64
"""Enough for the sizes: they are the first fields of a page's header."""
_EXPECTED = "a complete Parquet file"


def check_pages(file: IO[bytes], settings: Settings) -> None:
    """Raise InvalidDataError or TooLargeError where the footer or a page is larger than any writer makes them."""
    size = file.seek(0, 2)
    if size < 12:
        raise invalid_data("file", f"{size} bytes", _EXPECTED)
    file.seek(-8, 2)
    footer, magic = struct.unpack("<I4s", file.read(8))
    if magic != MAGIC:
        raise invalid_data("file", "cut off", _EXPECTED)
    if footer > min(MAX_FOOTER, size - 8):
        raise invalid_data("file", f"a footer of {footer} bytes", f"{_EXPECTED}, with at most {MAX_FOOTER}")
    file.seek(0)
    meta = pq.read_metadata(file)
    budget, pages = settings.max_unpacked_bytes, 0
    for group in range(meta.num_row_groups):
        for index in range(meta.num_columns):
            column = meta.row_group(group).column(index)
            if column.num_values == meta.row_group(group).num_rows == 0:
                continue  # nothing is read, wherever it is said to be
            start = column.data_page_offset
            if column.dictionary_page_offset is not None and 0 < column.dictionary_page_offset < start:
                start = column.dictionary_page_offset
            end = start + column.total_compressed_size
            if not 4 <= start <= end <= size:
                raise invalid_data(
                    column.path_in_schema, f"at bytes {start} to {end}", f"within the {size} of the file"
                )
            while start < end:
                file.seek(start)
                length, unpacked, packed = _page(file.read(HEADER_BYTES), file, start)
                pages += 1
                budget -= max(unpacked, 0)
                if not 0 <= unpacked <= MAX_PAGE or packed < 0 or pages > MAX_PAGES:
                    raise invalid_data(
                        column.path_in_schema,
                        f"page {pages} of {unpacked} bytes",
                        f"at most {MAX_PAGES} pages of {MAX_PAGE}",
                    )
                if budget < 0:
                    limit = settings.max_unpacked_bytes
                    raise TooLargeError(f"the file unpacks to more than {limit} bytes, expected at most {limit}")
                start += length + packed


def _page(data: bytes, file: IO[bytes], start: int) -> tuple[int, int, int]:
    """Length of a page's header, and the sizes of the page unpacked and packed, bytes."""
    for size in (len(data), 4096, 1024 * 1024):
        if size > len(data):
            file.seek(start)
            data = file.read(size)
        try:
            fields, length = _Compact(data).structure()
        except IndexError:
            continue  # statistics may make a header long
        if 2 in fields and 3 in fields:
            return length, fields[2], fields[3]
        break
    raise invalid_data("file", f"no page at byte {start}", _EXPECTED)


class _Compact:
    """Just enough of Thrift's compact protocol to pass over a structure and keep its whole numbers."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def structure(self, depth: int = 0) -> tuple[dict[int, int], int]:
        """Whole numbers by field, and where the structure ends."""
        if depth > 8:
            raise ValueError("a page's header nested deep")
        fields: dict[int, int] = {}
        field = 0
        while (head := self._byte()) != 0:
            kind = head & 15
            field = field + (head >> 4) if head >> 4 else self._signed()
            value = self._value(kind, depth)
            if value is not None:
                fields[field] = value
        return fields, self.at

    def _value(self, kind: int, depth: int) -> int | None:
        if kind in (1, 2):  # a truth, told by the kind
            return None
        if kind == 3:
            return self._byte()
        if kind in (4, 5, 6):
            return self._signed()
        if kind == 7:
            self._skip(8)
        elif kind == 8:
            self._skip(self._unsigned())
        elif kind in (9, 10):
            head = self._byte()
            count = head >> 4 if head >> 4 != 15 else self._unsigned()
            if count > len(self.data):
                raise IndexError
            for _ in range(count):
                self._skip(1) if head & 15 in (1, 2) else self._value(head & 15, depth + 1)
        elif kind == 12:
            self.structure(depth + 1)
        else:
            raise ValueError("a page's header of an unknown kind")
        return None

    def _byte(self) -> int:
        value = self.data[self.at]
        self.at += 1
        return value

    def _skip(self, count: int) -> None:
        self.at += count
        if self.at > len(self.data):
            raise IndexError

    def _unsigned(self) -> int:
        value = shift = 0
        while True:
            byte = self._byte()
            value |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                return value
            if shift > 63:
                raise ValueError("a number of too many bytes")

    def _signed(self) -> int:
        value = self._unsigned()
        return (value >> 1) ^ -(value & 1)
