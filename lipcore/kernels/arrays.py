"""Helpers for arrays of any library of the array API: NumPy, PyTorch or JAX."""

from __future__ import annotations

import numpy as np
from array_api_compat import array_namespace, is_torch_namespace

from lipcore.data.motion import Array, Indices


def constant(values: Array, like: Array) -> Array:
    """Return numbers as an array of the same library, type and device as `like`."""
    xp = array_namespace(like)
    made = xp.asarray(values, dtype=like.dtype)
    return made.to(like.device) if is_torch_namespace(xp) else made


def of_all_joints(blocks: Array, n: int) -> Array:
    """Return blocks of the first joints with zeros for the others: (link, link, *batch) to (n, n, *batch)."""
    xp, more = array_namespace(blocks), n - blocks.shape[0]
    blocks = xp.concat([blocks, *([xp.zeros_like(blocks[:1])] * more)])
    return xp.concat([blocks, *([xp.zeros_like(blocks[:, :1])] * more)], axis=1)


def reordered(values: Array, rows: Indices, axis: int = 0) -> Array:
    """Return the rows of an array of any library in another order."""
    xp = array_namespace(values)
    return xp.concat([values[(*[slice(None)] * axis, slice(row, row + 1))] for row in rows.tolist()], axis=axis)


def on_diagonal(values: Array) -> Array:
    """Return blocks with these values on the diagonal and zero elsewhere: (n, *batch) to (n, n, *batch)."""
    n = values.shape[0]
    unit = constant(np.eye(n), values)
    return unit.reshape((n, n) + (1,) * (values.ndim - 1)) * values


def on_last_diagonal(values: Array) -> Array:
    """Return the same blocks with the joints last: (*batch, n) to (*batch, n, n)."""
    return values[..., None] * constant(np.eye(values.shape[-1]), values)
