"""Rows of the event log as bytes: one safetensors archive with an array for each field of `Rows`."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load, save

from lipcore.online.batch import Rows

NAMES = tuple(field.name for field in fields(Rows))


def encode(rows: Rows) -> bytes:
    """Write rows, bit for bit."""
    return save({name: np.ascontiguousarray(getattr(rows, name)) for name in NAMES})


def decode(data: bytes) -> Rows:
    """Read what `encode` wrote; raise ValueError where it is damaged."""
    try:
        arrays = load(data)
    except SafetensorError as error:
        raise ValueError(f"logged rows cannot be read: {error}") from None
    if sorted(arrays) != sorted(NAMES):
        raise ValueError(f"logged rows have the arrays {', '.join(sorted(arrays))}, expected {', '.join(NAMES)}")
    return Rows(**arrays)
