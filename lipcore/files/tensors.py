"""The tensors of a model, in the safetensors format: their header is checked before their numbers are read."""

import math
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta, Struct

from lipcore.data.motion import Array
from lipcore.files import strict_json
from lipcore.files.arm import is_arm_tensor
from lipcore.files.manifest import TENSORS, Limits, ModelFormatError
from lipcore.files.residual import COUNTS, NAMES, WEIGHTS, check_shapes
from lipcore.files.strict_json import quote
from lipcore.kernels.drive.play import ELEMENTS
from lipcore.kernels.fast.answer import MISFIT_ROWS
from lipcore.model.selection import Count
from lipcore.posterior.misfit import EARLIER_ROWS, Misfit

MAX_HEADER_BYTES = 256 * 1024
HEADER_LENGTH_BYTES = 8
"""Size of the header's length field."""
OUTPUTS = "inducing/outputs"
INDUCING = ("inducing/q", "inducing/dq", "inducing/ddq")
_MISFIT_ROWS = EARLIER_ROWS, MISFIT_ROWS, MISFIT_ROWS + 2 * len(ELEMENTS)
"""Rows of a misfit: of earlier releases, without and with play elements."""
A, B, FLOOR, MISFIT = "statistics/a", "statistics/b", "floor", "misfit"
PARAMS = "params/"
WHOLE = OUTPUTS, COUNTS
"""Tensors of whole numbers."""
TYPES: dict[str, np.dtype[Any]] = {"F64": np.dtype("<f8"), "I64": np.dtype("<i8")}


class Tensor(Struct, frozen=True, forbid_unknown_fields=True):
    """A tensor in the header. data_offsets: its first and last byte after the header, the last exclusive."""

    dtype: str
    shape: Annotated[tuple[Count, ...], Meta(max_length=4)]
    data_offsets: tuple[Count, Count]


_HEADER = msgspec.json.Decoder(Annotated[dict[str, msgspec.Raw], Meta(max_length=1000)])
_TENSOR = msgspec.json.Decoder(Tensor)


def read_tensors(payload: bytes, n: int, limits: Limits) -> dict[str, Array]:
    """Return the tensors of a model of n joints by name, of the right type and dimensions; raise ModelFormatError.

    They are finite. Sizes are checked against the limits before a number is read, because the cost of computing with
    them grows with their square.
    """
    entries, start = _read_header(payload)
    _check_sizes(entries, n, limits)
    tensors: dict[str, Array] = {}
    for name, each in entries.items():
        values = np.frombuffer(payload, TYPES[each.dtype], math.prod(each.shape), start + each.data_offsets[0])
        try:
            # copied, because a read-only array is another type to compiled code
            value = tensors[name] = values.reshape(each.shape).copy()
        except ValueError as error:  # no elements, but lengths too large for an array
            raise _bad(f"tensor {quote(name)} cannot be read: {error}") from None
        if name not in WHOLE and not np.isfinite(value).all():
            raise _bad(f"tensor {name!r} is not made of finite float64 numbers")
    if FLOOR in tensors and bool((tensors[FLOOR] < 0).any()):
        raise _bad(f"tensor {FLOOR!r} has a number below zero, expected variances")
    if MISFIT in tensors:
        misfit = Misfit.unpacked(tensors[MISFIT])
        torques, widths = misfit.elements
        variances = np.concatenate([np.stack([misfit.rest, misfit.lasting, misfit.still]), torques])
        motion = np.concatenate([np.stack([misfit.slow, misfit.speed, misfit.acceleration]), widths])
        if bool((variances < 0).any() or (motion <= 0).any()):
            raise _bad(f"tensor {MISFIT!r} has a number below zero, expected variances, speeds and accelerations")
    return tensors


def _bad(message: str) -> ModelFormatError:
    return ModelFormatError(message, TENSORS)


def _read_header(payload: bytes) -> tuple[dict[str, Tensor], int]:
    """Return the tensors of the header, and the byte at which their data begin.

    Their data fill the rest of the file without gaps and overlaps.
    """
    if len(payload) < HEADER_LENGTH_BYTES:
        raise _bad(f"{TENSORS} has {len(payload)} bytes, expected a header")
    length = int.from_bytes(payload[:HEADER_LENGTH_BYTES], "little")
    if length > min(MAX_HEADER_BYTES, len(payload) - HEADER_LENGTH_BYTES):
        raise _bad(
            f"{TENSORS} says that its header has {length} bytes, expected at most {MAX_HEADER_BYTES} and the file's"
        )
    try:
        header = strict_json.decode(
            _HEADER, payload[HEADER_LENGTH_BYTES : HEADER_LENGTH_BYTES + length], MAX_HEADER_BYTES
        )
    except strict_json.StrictJsonError as error:
        raise _bad(f"the header of {TENSORS} cannot be read: {error}") from None
    entries = {name: _entry(name, value) for name, value in header.items()}
    reached = 0
    for name, entry in sorted(entries.items(), key=lambda item: item[1].data_offsets):
        begin, end = entry.data_offsets
        if begin != reached:
            raise _bad(f"tensor {quote(name)} begins at byte {begin}, expected {reached}, where the last one ends")
        reached = end
    start = HEADER_LENGTH_BYTES + length
    if reached != len(payload) - start:
        raise _bad(f"the tensors end at byte {reached}, expected {len(payload) - start}, the end of the file")
    return entries, start


def _entry(name: str, value: msgspec.Raw) -> Tensor:
    try:
        entry = strict_json.decode(_TENSOR, bytes(value), MAX_HEADER_BYTES)
    except strict_json.StrictJsonError as error:
        raise _bad(f"tensor {quote(name)}: {error}") from None
    expected = "I64" if name in WHOLE else "F64"
    if entry.dtype != expected:
        raise _bad(f"tensor {quote(name)} is of type {quote(entry.dtype)}, expected {expected}")
    begin, end = entry.data_offsets
    if end - begin != 8 * math.prod(entry.shape):
        raise _bad(f"tensor {quote(name)} has {end - begin} bytes, expected those of its shape {entry.shape}")
    return entry


def _check_sizes(entries: dict[str, Tensor], n: int, limits: Limits) -> None:
    for name in entries:
        if not (name.startswith(PARAMS) or is_arm_tensor(name)) and name not in (
            OUTPUTS,
            *INDUCING,
            A,
            B,
            FLOOR,
            MISFIT,
            *NAMES,
        ):
            raise _bad(f"{TENSORS} has the tensor {quote(name)}, which this release does not know")
    for name in (OUTPUTS, *INDUCING, A, B):
        if name not in entries:
            raise _bad(f"{TENSORS} lacks the tensor {name!r}")
    of_residual = {name: entries[name].shape for name in NAMES if name in entries}
    if of_residual and (wrong := check_shapes(of_residual, n)) is not None:
        raise _bad(f"{TENSORS} {wrong}")
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
        # each linear term has a few weights a joint
        "inducing_outputs": max(outputs[0], b[0] - 64 * n) + of_residual.get(WEIGHTS, (0,))[0],
    }
    for what, count in counts.items():
        if count > getattr(limits, what):
            raise _bad(f"{TENSORS} has {count} {what.replace('_', ' ')}, expected at most {getattr(limits, what)}")
    if entries[A].shape != (b[0] * (b[0] + 1) // 2,):
        length = b[0] * (b[0] + 1) // 2
        raise _bad(f"{A} has shape {entries[A].shape}, expected M (M + 1) / 2 numbers, {length}, as {B} has {b[0]}")
    for name, shapes in ((FLOOR, [(n,)]), (MISFIT, [(rows, n) for rows in _MISFIT_ROWS])):
        if name in entries and entries[name].shape not in shapes:
            raise _bad(f"tensor {name!r} has shape {entries[name].shape}, expected {shapes[-1]}")
