"""The file of a data set's samples: safetensors, written array by array, as a recording may be as large as memory.

The safetensors library, used here for reading, can only write arrays that are all in memory.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray
from safetensors import safe_open

from lipcore.kernels.drive.play import PlayState, element_widths

ARRAYS = ("t", "episode", "q", "dq", "ddq", "tau")
CHUNK_ROWS = 1 << 14
"""Max rows that are read at a time to select some of them."""
_HEADER = 8
"""Bytes of the header's length; the header is padded to a multiple of it, so that numbers are aligned."""

ArrayOf = Callable[[str], NDArray[Any]]
"""Returns the array of a name in ARRAYS: t (N,), episode (N,) integers, the others (N, n)."""
PartOf = Callable[[NDArray[np.int64], NDArray[np.float64]], NDArray[np.bool_]]
"""Selects samples (N,) by their episodes (N,) and times (N,)."""


def count_bytes(rows: int, n_joints: int) -> int:
    """Return the bytes of the numbers of `rows` samples."""
    return 8 * rows * (2 + 4 * n_joints)


def write(file: IO[bytes], rows: int, n_joints: int, array: ArrayOf) -> str:
    """Write samples, reading each array from `array` in its turn; return the sha256 of the file."""
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
    """Return the hash of a file, read block by block."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read(path: Path, rows: NDArray[np.int64] | None = None) -> dict[str, NDArray[Any]]:
    """Return the arrays by name, of all rows or some. For some rows at most one whole array is in memory at a time."""
    return {name: read_array(path, name) if rows is None else read_array(path, name)[rows] for name in ARRAYS}


def read_array(path: Path, name: str) -> NDArray[Any]:
    """Return one array by name."""
    with safe_open(path, framework="numpy") as file:
        values: NDArray[Any] = file.get_tensor(name)
    return values


def count_rows(path: Path) -> int:
    """Return the number of samples of a file, from its header."""
    with safe_open(path, framework="numpy") as file:
        count: int = file.get_slice("t").get_shape()[0]
    return count


class Reader:
    """An open file of rows that are read in parts, even after the file is deleted. Safe from several threads.

    The file is not mapped into memory; only the requested rows are in memory.
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
        """Return rows `first` to `last`, exclusive, of one array; raise ValueError if the file ends before them."""
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
        """Return the arrays by name at chosen rows (K,) in rising order, with little more than these in memory."""
        parts: dict[str, list[NDArray[Any]]] = {name: [] for name in ARRAYS}
        at = 0
        while at < len(index):
            first = int(index[at])
            to = int(np.searchsorted(index, first + CHUNK_ROWS))
            last = int(index[to - 1]) + 1
            for name in ARRAYS:
                parts[name].append(self.array(name, first, last)[index[at:to] - first])
            at = to
        return {name: np.concatenate(arrays) if arrays else self.array(name, 0, 0) for name, arrays in parts.items()}


def follow(reader: Reader, index: NDArray[np.int64], joint_types: Sequence[str]) -> NDArray[np.float64]:
    """Return the deflections at chosen rows (K,) in rising order, as in `Motion`, from the rows before them.

    They are followed from CHUNK_ROWS before the first chosen row.
    """
    widths = element_widths(joint_types)
    state, before, parts = PlayState.unknown(widths.shape[1]), -1, [np.empty((0, 2 * len(widths), widths.shape[1]))]
    start, stop = (max(0, int(index[0]) - CHUNK_ROWS), int(index[-1]) + 1) if len(index) else (0, 0)
    for first in range(start, stop, CHUNK_ROWS):
        last = min(first + CHUNK_ROWS, stop)
        t, episode, q, dq = (reader.array(name, first, last) for name in ("t", "episode", "q", "dq"))
        begins = np.diff(episode, prepend=before) != 0
        deflections, state = state.follow(t, q, dq, widths, begins)
        before = int(episode[-1])
        parts.append(deflections[index[(index >= first) & (index < last)] - first])
    return np.concatenate(parts)


def _shape(name: str, rows: int, n_joints: int) -> list[int]:
    return [rows] if name in ("t", "episode") else [rows, n_joints]
