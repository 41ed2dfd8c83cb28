"""The tensors of a model, in the safetensors format: checked by their header before anything is read of them."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors

from lipcore.data.motion import Array
from lipcore.files import strict_json
from lipcore.files.arm import is_of_arm
from lipcore.files.manifest import TENSORS, Limits, ModelFormatError
from lipcore.files.strict_json import quote

MAX_HEADER = 256 * 1024
MAX_TENSORS = 1000
MAX_DIMENSIONS = 4
LENGTH = 8
"""Bytes that hold the header's length."""
WIDTH = 8
"""Bytes of a number: all are float64 but the places of outputs, which are int64."""
OUTPUTS = "inducing/outputs"
INDUCING = ("inducing/q", "inducing/dq", "inducing/ddq")
A, B, FLOOR, MISFIT = "statistics/a", "statistics/b", "floor", "misfit"
PARAMS = "params/"
TYPES = {"F64": "float64", "I64": "int64"}


class Entry(NamedTuple):
    """One tensor as the header describes it; begin, end: its bytes after the header."""

    dtype: str
    shape: tuple[int, ...]
    begin: int
    end: int


def read_tensors(payload: bytes, n: int, limits: Limits) -> dict[str, Array]:
    """Tensors of a model of n joints by name, of the right type and dimensions, finite; raise ModelFormatError.

    Sizes are checked against the limits before a number is read: what is computed from them grows with their square.
    """
    entries = _read_header(payload)
    _check_sizes(entries, n, limits)
    try:
        # copied: what is loaded may be read-only, which compiled code takes for another type
        tensors = {name: value.copy() for name, value in load_tensors(payload).items()}
    except (SafetensorError, ValueError, RuntimeError) as error:
        raise _bad(f"{TENSORS} cannot be read: {error}") from None
    for name, value in tensors.items():
        if name != OUTPUTS and not np.isfinite(value).all():
            raise _bad(f"tensor {name!r} is not made of finite float64 numbers")
    if FLOOR in tensors and bool((tensors[FLOOR] < 0).any()):
        raise _bad(f"tensor {FLOOR!r} has a number below zero, expected variances")
    if MISFIT in tensors:
        rest, slow, lasting, speed, acceleration = tensors[MISFIT]
        variances, motion = np.stack([rest, lasting]), np.stack([slow, speed, acceleration])
        if bool((variances < 0).any() or (motion <= 0).any()):
            raise _bad(f"tensor {MISFIT!r} has a number below zero, expected variances, speeds and accelerations")
    return tensors


def _bad(message: str) -> ModelFormatError:
    return ModelFormatError(message, TENSORS)


def _read_header(payload: bytes) -> dict[str, Entry]:
    """The tensors as the header has them: together they fill the rest of the file, without holes and overlaps."""
    if len(payload) < LENGTH:
        raise _bad(f"{TENSORS} has {len(payload)} bytes, expected a header")
    length = int.from_bytes(payload[:LENGTH], "little")
    if length > min(MAX_HEADER, len(payload) - LENGTH):
        raise _bad(f"{TENSORS} says that its header has {length} bytes, expected at most {MAX_HEADER} and the file's")
    try:
        header = strict_json.read(payload[LENGTH : LENGTH + length].rstrip(b" "), MAX_HEADER)
    except strict_json.StrictJsonError as error:
        raise _bad(f"the header of {TENSORS} cannot be read: {error}") from None
    if not isinstance(header, dict) or len(header) > MAX_TENSORS:
        raise _bad(f"the header of {TENSORS} is {quote(header)}, expected at most {MAX_TENSORS} tensors")
    entries = {name: _entry(name, value) for name, value in header.items()}
    reached = 0
    for name, entry in sorted(entries.items(), key=lambda item: (item[1].begin, item[1].end)):
        if entry.begin != reached:
            raise _bad(
                f"tensor {quote(name)} begins at byte {entry.begin}, expected {reached}, where the last one ends"
            )
        reached = entry.end
    if reached != len(payload) - LENGTH - length:
        raise _bad(f"the tensors end at byte {reached}, expected {len(payload) - LENGTH - length}, the end of the file")
    return entries


def _entry(name: str, value: Any) -> Entry:
    if not isinstance(value, dict) or set(value) != {"dtype", "shape", "data_offsets"}:
        raise _bad(f"tensor {quote(name)} is described by {quote(value)}, expected dtype, shape and data_offsets")
    dtype, shape, offsets = value["dtype"], value["shape"], value["data_offsets"]
    expected = "I64" if name == OUTPUTS else "F64"
    if dtype != expected:
        kind = TYPES.get(dtype, quote(dtype)) if isinstance(dtype, str) else quote(dtype)
        raise _bad(f"tensor {quote(name)} is of type {kind}, expected {TYPES[expected]}")
    if not _are_counts(shape) or len(shape) > MAX_DIMENSIONS:
        raise _bad(f"tensor {quote(name)} has the shape {quote(shape)}, expected at most {MAX_DIMENSIONS} lengths")
    if not _are_counts(offsets) or len(offsets) != 2 or offsets[1] - offsets[0] != WIDTH * math.prod(shape):
        raise _bad(f"tensor {quote(name)} has the offsets {quote(offsets)}, expected those of its shape {shape}")
    return Entry(dtype, tuple(shape), *offsets)


def _are_counts(value: object) -> bool:
    return isinstance(value, list) and all(type(each) is int and each >= 0 for each in value)


def _check_sizes(entries: dict[str, Entry], n: int, limits: Limits) -> None:
    for name in entries:
        if not (name.startswith(PARAMS) or is_of_arm(name)) and name not in (OUTPUTS, *INDUCING, A, B, FLOOR, MISFIT):
            raise _bad(f"{TENSORS} has the tensor {quote(name)}, which this release does not know")
    for name in (OUTPUTS, *INDUCING, A, B):
        if name not in entries:
            raise _bad(f"{TENSORS} lacks the tensor {name!r}")
    samples = entries["inducing/q"].shape[:1]
    for name in INDUCING:
        if entries[name].shape != (*samples, n) or not samples:
            raise _bad(f"{name} has shape {entries[name].shape}, expected (S, {n})")
    outputs, b = entries[OUTPUTS].shape, entries[B].shape
    if len(outputs) != 1 or len(b) != 1:
        raise _bad(f"{OUTPUTS} and {B} have shapes {outputs} and {b}, expected one dimension each")
    counts = {
        "inducing_samples": samples[0],
        "inducing_torques": samples[0] * n,
        "inducing_outputs": max(outputs[0], b[0] - 64 * n),  # each linear term has a few weights a joint
    }
    for what, count in counts.items():
        if count > getattr(limits, what):
            raise _bad(f"{TENSORS} has {count} {what.replace('_', ' ')}, expected at most {getattr(limits, what)}")
    if entries[A].shape != (b[0] * (b[0] + 1) // 2,):
        length = b[0] * (b[0] + 1) // 2
        raise _bad(f"{A} has shape {entries[A].shape}, expected M (M + 1) / 2 numbers, {length}, as {B} has {b[0]}")
    for name, shape in ((FLOOR, (n,)), (MISFIT, (5, n))):
        if name in entries and entries[name].shape != shape:
            raise _bad(f"tensor {name!r} has shape {entries[name].shape}, expected {shape}")
