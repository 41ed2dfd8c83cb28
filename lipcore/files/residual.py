"""The tensors of a local correction (`lipcore.kernels.residual`)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from lipcore.data.motion import Array, Indices
from lipcore.kernels.residual import JointResidual, ResidualKernel

PREFIX = "residual/"
COUNTS = f"{PREFIX}counts"
"""Numbers of centres, and those of the root, of each joint, (2, n)."""
LENGTHSCALES, CENTRES, WEIGHTS, ROOTS, VARIANCE, TAKEN = (
    f"{PREFIX}{name}" for name in ("lengthscales", "centres", "weights", "roots", "variance", "taken")
)
NAMES = COUNTS, LENGTHSCALES, CENTRES, WEIGHTS, ROOTS, VARIANCE, TAKEN


def residual_tensors(kernel: ResidualKernel) -> dict[str, Array | Indices]:
    """Return the tensors of a correction of n joints: (2, n), (n, 4 n), (K, 4 n), (K,), (R,), (n,), (n,).

    Those of a joint are together. Roots are stored row by row down to the diagonal.
    """
    joints = kernel.joints
    return {
        COUNTS: np.array([[len(each.weights) for each in joints], [len(each.root) for each in joints]], np.int64),
        LENGTHSCALES: np.stack([each.lengthscales for each in joints]),
        CENTRES: np.concatenate([each.centres for each in joints]),
        WEIGHTS: np.concatenate([each.weights for each in joints]),
        ROOTS: np.concatenate([each.triangle for each in joints]),
        VARIANCE: kernel.prior,
        TAKEN: np.array([each.taken for each in joints]),
    }


def check_shapes(shapes: Mapping[str, tuple[int, ...]], n: int) -> str | None:
    """Return the first error in the shapes of a correction's tensors, None if there is none."""
    missing = [name for name in NAMES if name not in shapes]
    if missing:
        return f"lacks the tensor {missing[0]!r}, but has others of a correction"
    total = shapes[WEIGHTS][0] if len(shapes[WEIGHTS]) == 1 else -1
    expected = {COUNTS: (2, n), LENGTHSCALES: (n, 4 * n), CENTRES: (total, 4 * n), VARIANCE: (n,), TAKEN: (n,)}
    for name, shape in expected.items():
        if shapes[name] != shape:
            return f"has {name!r} of shape {shapes[name]}, expected {shape}"
    return None if total >= 0 and len(shapes[ROOTS]) == 1 else f"has {WEIGHTS!r} or {ROOTS!r} with several dimensions"


def read_residual(tensors: Mapping[str, Array]) -> ResidualKernel | None:
    """Return the correction of a model's tensors, None if it has none; raise ValueError for impossible numbers."""
    if COUNTS not in tensors:
        return None
    counts, roots = tensors[COUNTS].astype(np.int64)
    if (roots < 0).any() or (roots > counts).any() or int(counts.sum()) != len(tensors[WEIGHTS]):
        raise ValueError(f"{COUNTS} has {counts.tolist()} and {roots.tolist()}, expected those of {WEIGHTS}")
    if int((roots * (roots + 1) // 2).sum()) != len(tensors[ROOTS]):
        raise ValueError(f"{ROOTS} has {len(tensors[ROOTS])} numbers, expected triangles of {roots.tolist()} rows")
    if (tensors[LENGTHSCALES] <= 0).any() or (tensors[VARIANCE] < 0).any():
        raise ValueError(f"{LENGTHSCALES} or {VARIANCE} has a number below zero")
    if (tensors[TAKEN] < 0).any() or (tensors[TAKEN] > 1).any():
        raise ValueError(f"{TAKEN} has {tensors[TAKEN].tolist()}, expected shares from 0 to 1")
    joints, first, at = [], 0, 0
    for joint, (count, size) in enumerate(zip(counts.tolist(), roots.tolist(), strict=True)):
        rows, root = slice(first, first + count), np.zeros((size, size))
        root[np.tril_indices(size)] = tensors[ROOTS][at : at + size * (size + 1) // 2]
        arrays = tensors[LENGTHSCALES][joint], tensors[CENTRES][rows], tensors[WEIGHTS][rows], root
        joints.append(JointResidual(*arrays, *(float(tensors[name][joint]) for name in (VARIANCE, TAKEN))))
        first, at = rows.stop, at + size * (size + 1) // 2
    return ResidualKernel(joints)
