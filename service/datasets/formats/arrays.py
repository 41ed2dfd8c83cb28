"""Tables of named arrays: HDF5 and MATLAB files. Each array has a number, or a row of numbers, per sample.

Numbers in names of groups count the episodes: `demo_0/obs/q` and `demo_1/obs/q` are two parts of one array.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import scipy.io

from lipcore.data.samples import Array
from service.datasets.formats.table import Table, block_rows, clean_names, first_line, name_columns, unreadable
from service.datasets.mapping.recognition import find_times, interpret_name
from service.datasets.options import ReadOptions
from service.foundation.errors import TooLargeError, invalid_data
from service.foundation.settings import Settings
from service.foundation.text import counted

MAX_ARRAYS = 20_000
KNOWN = ("q", "dq", "ddq", "tau")
COMPLETE = "a complete HDF5 file"
STEPS = ("dt", "sample_time", "Ts")
"""Names of a number that is the time between samples, s."""
_NUMBER = re.compile(r"\d+")


@dataclass(frozen=True)
class Part:
    """The arrays of one episode: by name, all with the same samples along the first or the second axis."""

    arrays: Mapping[str, Any]
    rows: int

    def read(self, name: str, begin: int, end: int) -> Array:
        """Return some samples of an array, (M, width)."""
        array = self.arrays[name]
        if len(array.shape) == 1:
            values = np.asarray(array[begin:end])[:, None]
        elif array.shape[0] == self.rows:
            values = np.asarray(array[begin:end])
        else:
            values = np.asarray(array[:, begin:end]).T
        return values.astype(np.float64)

    def width(self, name: str) -> int:
        """Return the numbers of a sample."""
        shape = self.arrays[name].shape
        return 1 if len(shape) == 1 else int(shape[1] if shape[0] == self.rows else shape[0])


@contextmanager
def open_hdf5(path: Path, options: ReadOptions, settings: Settings) -> Iterator[Table]:
    """Open an HDF5 file as a table; `options.topic` is a group. Links are not followed, and no other file is read.

    Raise InvalidDataError or TooLargeError.
    """
    try:
        file = h5py.File(path, "r", locking=False)
    except (OSError, RuntimeError, ValueError, TypeError) as error:
        raise unreadable("file", first_line(error), COMPLETE) from None
    with file:
        arrays = _datasets(file)
        size = sum(each.size * each.dtype.itemsize for each in arrays.values()) if options.topic is None else 0
        yield _table(arrays, options, settings, size)


def _datasets(file: Any) -> dict[str, Any]:
    """Return the data sets of numbers and texts in an HDF5 file; raise InvalidDataError or TooLargeError."""
    arrays: dict[str, Any] = {}

    def add(name: str, found: Any) -> None:
        if not isinstance(found, h5py.Dataset) or name.startswith("#"):  # MATLAB's own
            return
        if len(arrays) >= MAX_ARRAYS:
            raise TooLargeError(f"The file has more than {MAX_ARRAYS} arrays")
        if found.is_virtual or found.external:
            raise invalid_data(name, "stored in another file", "an array that this file contains")
        if found.dtype.kind in "fiub":
            arrays[name] = found

    try:
        file.visititems(add)
    except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:  # h5py's, for damaged files
        raise unreadable("file", first_line(error), COMPLETE) from None
    return arrays


@contextmanager
def open_mat(path: Path, options: ReadOptions, settings: Settings) -> Iterator[Table]:
    """Open a MATLAB file (versions 4 to 7) as a table; fields of structures have names such as `data.q`.

    Raise InvalidDataError or TooLargeError.
    """
    try:
        content = scipy.io.loadmat(path, squeeze_me=True, struct_as_record=True, verify_compressed_data_integrity=True)
    except Exception as error:  # damaged files raise many kinds
        raise unreadable("file", first_line(error), "a complete MATLAB file") from None
    arrays: dict[str, Any] = {}
    for name, value in content.items():
        if not name.startswith("__"):
            _flatten(name, value, arrays)
    yield _table(arrays, options, settings, 0)


@contextmanager
def open_npy(path: Path, options: ReadOptions, settings: Settings) -> Iterator[Table]:
    """Open a NumPy array as a table: (N, columns), named by `options.column_names`, or with named fields."""
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except Exception as error:  # NumPy parses the header as Python text, which can raise any error
        raise unreadable("file", first_line(error), "a NumPy array of numbers") from None
    if array.dtype.names is not None:
        yield _table({name: array[name] for name in array.dtype.names}, options, settings, array.nbytes)
        return
    if array.ndim != 2 or array.dtype.kind not in "fiu" or 0 in array.shape:
        raise invalid_data("file", f"an array of {array.dtype}, shape {array.shape}", "numbers, (N, columns)")
    rows, width = array.shape
    if options.column_names is None:
        expected = f"names of its {width} columns. Set column_names=t,q1..q7,tau1..tau7"
        raise invalid_data("column_names", "missing", expected)
    names = clean_names(name_columns(options.column_names, width))
    whole = Part({"": array}, rows)
    steps = range(0, rows, block_rows(width))
    blocks = (whole.read("", begin, min(begin + block_rows(width), rows)) for begin in steps)
    yield Table(names, blocks)


def _flatten(name: str, value: Any, out: dict[str, Any]) -> None:
    """Add an array, or those of a structure, by name."""
    array = np.asarray(value)
    if array.dtype.names is not None and array.shape == ():
        for field in array.dtype.names:
            _flatten(f"{name}.{field}", array[field].item() if array[field].dtype == object else array[field], out)
    elif len(out) < MAX_ARRAYS:
        out[name] = array


def _table(arrays: Mapping[str, Any], options: ReadOptions, settings: Settings, size: int) -> Table:
    if size > settings.max_unpacked_bytes:
        raise TooLargeError(f"The file unpacks to {size} bytes, expected at most {settings.max_unpacked_bytes}")
    if options.topic is not None:
        group = options.topic.strip("/") + "/"
        found = {name.removeprefix(group): each for name, each in arrays.items() if name.startswith(group)}
        if not found:
            groups = sorted({name.rpartition("/")[0] for name in arrays if "/" in name})
            raise invalid_data("topic", options.topic, f"a group of the file: {', '.join(groups[:20]) or 'none'}")
        arrays = found
    numbers = {name: each for name, each in arrays.items() if each.dtype.kind in "fiub" and 1 <= len(each.shape) <= 2}
    parts = list(_episodes(numbers))
    if not parts:
        listed = ", ".join(list(arrays)[:20]) or "none"
        raise invalid_data("array", listed, "arrays of numbers, such as q (N, n) and tau (N, n)")
    first = parts[0]
    used = [name for name in first.arrays if all(name in each.arrays for each in parts)]
    used = [name for name in used if len({each.width(name) for each in parts}) == 1]
    names = [column for name in used for column in _columns(name, first.width(name))]
    facts = [f"{len(parts)} groups are episodes"] if len(parts) > 1 else []
    left = len(arrays) - sum(len(each.arrays) for each in parts)
    facts += (
        [f"{counted(left, 'array')} without a row per sample {'is' if left == 1 else 'are'} not read"] if left else []
    )
    step = next(
        (float(np.ravel(arrays[name])[0]) for name in STEPS if name in arrays and np.size(arrays[name]) == 1), None
    )
    step = None if find_times(names) or options.dt is not None else step
    extra = ["episode"] * (len(parts) > 1 and "episode" not in names) + ["t"] * (step is not None)
    return Table(clean_names([*extra, *names]), _blocks(parts, used, len(names), extra, step), facts=facts)


def _episodes(numbers: Mapping[str, Any]) -> Iterator[Part]:
    """Yield the arrays of each episode that have a row per sample."""
    groups: dict[tuple[int, ...], dict[str, Any]] = defaultdict(dict)
    templates = Counter(_NUMBER.sub("#", name.rpartition("/")[0]) + "/" + name.rpartition("/")[2] for name in numbers)
    several = max(templates.values(), default=1) > 1
    for name, array in numbers.items():
        group, _, last = name.rpartition("/")
        key = tuple(map(int, _NUMBER.findall(group))) if several else ()
        groups[key][_NUMBER.sub("", group).strip("_/") + "/" * bool(group) + last if several else name] = array
    for key in sorted(groups):
        lengths = Counter(max(each.shape) for name, each in groups[key].items() if _means(name) and max(each.shape) > 1)
        lengths = lengths or Counter(max(each.shape) for each in groups[key].values() if max(each.shape) > 1)
        if lengths:
            rows = max(lengths, key=lambda length: (lengths[length], length))
            yield Part({name: each for name, each in groups[key].items() if rows in each.shape}, rows)


def _means(name: str) -> bool:
    return bool(interpret_name(name)) or bool(find_times([name]))


def _columns(name: str, width: int) -> list[str]:
    if width == 1:
        return [name]
    return [f"{name}{j + 1}" if name in KNOWN else f"{name}[{j}]" for j in range(width)]


def _blocks(
    parts: Sequence[Part], used: Sequence[str], width: int, extra: list[str], step: float | None
) -> Iterator[Array]:
    for number, part in enumerate(parts):
        for begin in range(0, part.rows, block_rows(width)):
            end = min(begin + block_rows(width), part.rows)
            own = {"episode": np.full(end - begin, float(number)), "t": np.arange(begin, end) * (step or 0.0)}
            try:
                read = [part.read(name, begin, end) for name in used]
            except (OSError, RuntimeError, ValueError, TypeError) as error:
                raise unreadable("file", first_line(error), "arrays that can be read") from None
            yield np.column_stack([*(own[name] for name in extra), *read])
