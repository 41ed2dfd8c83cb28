"""The file of a data set's samples: safetensors, written array by array, as a long recording is larger than memory is.

The library that reads it here (and everybody else's) writes only what it is given whole.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray
from safetensors import safe_open

ARRAYS = ("t", "episode", "q", "dq", "ddq", "tau")
ROWS = 1 << 14
"""Rows that chosen ones are read out of at a time."""
_HEADER = 8
"""Bytes that say how long the header is; and to whose multiples it is filled up, so that numbers are aligned."""

ArrayOf = Callable[[str], NDArray[Any]]
"""Gives one of ARRAYS by name: t (N,), episode (N,) integers, the others (N, n)."""
PartOf = Callable[[NDArray[np.int64], NDArray[np.float64]], NDArray[np.bool_]]
"""Chooses samples by their episodes and times: each (N,)."""


def size(rows: int, n_joints: int) -> int:
    """Bytes of the numbers of so many samples."""
    return 8 * rows * (2 + 4 * n_joints)


def write(file: IO[bytes], rows: int, n_joints: int, array: ArrayOf) -> str:
    """Write samples, asking for each array when it is its turn; return the sha256 of the file."""
    header, offset = dict[str, Any](), 0
    for name in ARRAYS:
        shape = _shape(name, rows, n_joints)
        end = offset + 8 * int(np.prod(shape))
        header[name] = {"dtype": "I64" if name == "episode" else "F64", "shape": shape, "data_offsets": [offset, end]}
        offset = end
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % _HEADER)
    digest = hashlib.sha256()

    def put(data: bytes | memoryview) -> None:
        file.write(data)
        digest.update(data)

    put(len(text).to_bytes(_HEADER, "little"))
    put(text)
    for name in ARRAYS:
        values = np.ascontiguousarray(array(name), "<i8" if name == "episode" else "<f8")
        if list(values.shape) != _shape(name, rows, n_joints):
            raise ValueError(f"{name} has shape {values.shape}, expected {_shape(name, rows, n_joints)}")
        put(values.data.cast("B"))
    return digest.hexdigest()


def sha256(path: Path) -> str:
    """Hash of a file, read block by block."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read(path: Path, rows: NDArray[np.int64] | None = None) -> dict[str, NDArray[Any]]:
    """Arrays by name; of some rows only, where these are wanted: then no more than one array is in memory at a time."""
    return {name: read_array(path, name) if rows is None else read_array(path, name)[rows] for name in ARRAYS}


def read_array(path: Path, name: str) -> NDArray[Any]:
    """One array by name."""
    with safe_open(path, framework="numpy") as file:
        values: NDArray[Any] = file.get_tensor(name)
    return values


def rows_of(path: Path) -> int:
    """How many samples a file has, by its header."""
    with safe_open(path, framework="numpy") as file:
        count: int = file.get_slice("t").get_shape()[0]
    return count


class Reader:
    """A file that is open for its rows, part by part; it outlives the file's name. Safe from several threads.

    Nothing is mapped into memory: of a file as large as memory is, only what was asked for is there.
    """

    def __init__(self, path: Path) -> None:
        with path.open("rb", buffering=0) as file:
            self._file = os.dup(file.fileno())
        length = int.from_bytes(os.pread(self._file, _HEADER, 0), "little")
        header = json.loads(os.pread(self._file, length, _HEADER))
        self._first = {name: _HEADER + length + int(header[name]["data_offsets"][0]) for name in ARRAYS}
        self._width = {name: int(np.prod(header[name]["shape"][1:], dtype=np.int64)) for name in ARRAYS}
        self._shape = {name: header[name]["shape"][1:] for name in ARRAYS}
        self.rows: int = header["t"]["shape"][0]

    def __del__(self) -> None:
        if hasattr(self, "_file"):
            os.close(self._file)

    def array(self, name: str, first: int = 0, last: int | None = None) -> NDArray[Any]:
        """Rows `first` to `last`, exclusive, of one array; raise ValueError where the file ends before them."""
        count, size = (self.rows if last is None else last) - first, 8 * self._width[name]
        out = np.empty((count, *self._shape[name]), "<i8" if name == "episode" else "<f8")
        view, at = out.data.cast("B") if out.size else memoryview(b""), 0
        while at < len(view):
            got = os.preadv(self._file, [view[at:]], self._first[name] + first * size + at)
            if got == 0:
                raise ValueError(f"{name} ends before row {last}")
            at += got
        return out

    def take(self, index: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
        """Arrays by name of chosen rows, (K,) and rising: never much more than these is in memory."""
        parts: dict[str, list[NDArray[Any]]] = {name: [] for name in ARRAYS}
        at = 0
        while at < len(index):
            first = int(index[at])
            to = int(np.searchsorted(index, first + ROWS))
            last = int(index[to - 1]) + 1
            for name in ARRAYS:
                parts[name].append(self.array(name, first, last)[index[at:to] - first])
            at = to
        return {name: np.concatenate(arrays) if arrays else self.array(name, 0, 0) for name, arrays in parts.items()}


def _shape(name: str, rows: int, n_joints: int) -> list[int]:
    return [rows] if name in ("t", "episode") else [rows, n_joints]
