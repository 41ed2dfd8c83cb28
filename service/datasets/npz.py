"""Reading NPZ: named NumPy arrays, numbers and plain text only. Nothing is unpickled, nothing unpacked unmeasured."""

from __future__ import annotations

import math
import zipfile
import zlib
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy

from lipcore.samples import Array
from service.datasets.columns import Columns, too_many, whole_numbers
from service.errors import TooLargeError, invalid_data
from service.settings import Settings

ARRAYS = {"q": 2, "dq": 2, "ddq": 2, "tau": 2, "t": 1, "episode": 1, "dt": 0, "joint_names": 1}
"""Known arrays and their dimensions: q, dq, ddq, tau (N, n); t, episode (N,); dt (); joint_names (n,)."""


def read_npz(path: Path, settings: Settings) -> Columns:
    """Read an NPZ archive; raise InvalidDataError naming the array, or TooLargeError."""
    arrays: dict[str, np.ndarray[Any, Any]] = {}
    try:
        with zipfile.ZipFile(path) as archive:
            _check_members(archive, settings)
            for member in archive.infolist():
                name = member.filename.removesuffix(".npy")
                with archive.open(member) as file:
                    arrays[name] = _read_array(name, file, member.file_size)
    # zipfile says NotImplementedError of a compression that it does not know, RuntimeError of an encrypted member
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, NotImplementedError, RuntimeError, ValueError) as error:
        raise invalid_data("file", str(error) or type(error).__name__, "a complete NPZ archive") from None
    for name in ("q", "tau"):
        if name not in arrays:
            raise invalid_data(name, "missing", "an array of shape (N, n)")
    shape = arrays["q"].shape
    if shape[0] > settings.max_samples:
        raise too_many(shape[0], settings.max_samples)
    for name, array in arrays.items():
        wanted = {2: shape, 1: shape[:1], 0: ()}[ARRAYS[name]] if name != "joint_names" else shape[1:]
        if array.shape != wanted:
            raise invalid_data(name, f"of shape {array.shape}", f"shape {wanted}, as q has shape {shape}")
    names = arrays.pop("joint_names", None)
    numbers: dict[str, Array] = {name: np.asarray(array, dtype=np.float64) for name, array in arrays.items()}
    episode = whole_numbers(numbers["episode"]) if "episode" in numbers else None
    return Columns(
        q=numbers["q"],
        tau=numbers["tau"],
        dq=numbers.get("dq"),
        ddq=numbers.get("ddq"),
        t=_times(numbers, episode, shape[0]),
        episode=episode,
        joint_names=None if names is None else _text(names),
    )


def _text(names: np.ndarray[Any, Any]) -> tuple[str, ...]:
    try:
        return tuple(str(name) for name in names)
    except (SystemError, ValueError):
        raise invalid_data("joint_names", "not Unicode", "plain text") from None


def _times(numbers: dict[str, Array], episode: np.ndarray[Any, Any] | None, rows: int) -> Array | None:
    if "t" in numbers or "dt" not in numbers:
        return numbers.get("t")
    step = float(numbers["dt"])
    if not 0 < step < np.inf:
        raise invalid_data("dt", step, "a positive number of seconds")
    starts = np.zeros(rows, dtype=np.int64)
    if episode is not None:
        # time starts anew with every episode
        first = np.flatnonzero(np.diff(episode, prepend=episode[0] - 1))
        starts = np.repeat(first, np.diff(np.append(first, rows)))
    return np.asarray((np.arange(rows) - starts) * step)


def _check_members(archive: zipfile.ZipFile, settings: Settings) -> None:
    seen: set[str] = set()
    total = 0
    for member in archive.infolist():
        name = member.filename.removesuffix(".npy")
        if not member.filename.endswith(".npy") or name not in ARRAYS:
            raise invalid_data("array", member.filename, f"one of {', '.join(ARRAYS)}")
        if name in seen:
            raise invalid_data("array", name, "every array once")
        if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise invalid_data("array", f"{name} compressed by method {member.compress_type}", "stored or deflated")
        seen.add(name)
        total += member.file_size  # zipfile never yields more bytes than this
    if total > settings.max_unpacked_bytes:
        raise TooLargeError(f"the archive unpacks to {total} bytes, expected at most {settings.max_unpacked_bytes}")


def _read_array(name: str, file: IO[bytes], size: int) -> np.ndarray[Any, Any]:
    try:
        version = npy.read_magic(file)
        if version not in ((1, 0), (2, 0)):
            raise ValueError(f"format version {version}")
        header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, fortran, dtype = header(file)
    except Exception as error:  # NumPy parses the header as Python text and raises whatever its parser raises
        raise invalid_data(name, str(error) or type(error).__name__, "a NumPy array") from None
    kinds = "U" if name == "joint_names" else "fiu"
    if dtype.kind not in kinds or not 0 < dtype.itemsize <= 1024 or len(shape) != ARRAYS[name]:
        raise invalid_data(
            name,
            f"of type {dtype} and {len(shape)} dimensions",
            f"{ARRAYS[name]} dimensions of plain " + ("text" if kinds == "U" else "numbers"),
        )
    if any(not 0 <= length <= size for length in shape):
        raise invalid_data(name, f"of shape {shape}", "as many values as the file holds")
    count = math.prod(shape)
    if count * dtype.itemsize > size:
        raise invalid_data(name, "truncated", f"{count} values, as its header says")
    data = file.read(count * dtype.itemsize)
    if len(data) != count * dtype.itemsize:
        raise invalid_data(name, "truncated", f"{count} values, as its header says")
    return np.frombuffer(data, dtype=dtype).reshape(shape, order="F" if fortran else "C")
