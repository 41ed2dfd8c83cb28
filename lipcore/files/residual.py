"""The tensors of a local correction (`lipcore.kernels.residual`)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from lipcore.data.motion import Array, Indices
from lipcore.kernels.residual import JointResidual, ResidualKernel

PREFIX = "residual/"
COUNTS = f"{PREFIX}counts"
"""Numbers of centres, those of the root and those of fast answers, of each joint, (3, n)."""
NUMBERS = LENGTHSCALES, CENTRES, WEIGHTS, ROOTS, VARIANCE, TAKEN, FAST_WEIGHTS, FAST_TAKEN = tuple(
    f"{PREFIX}{name}"
    for name in ("lengthscales", "centres", "weights", "roots", "variance", "taken", "fast_weights", "fast_taken")
)
NAMES = COUNTS, *NUMBERS


def residual_tensors(kernel: ResidualKernel) -> dict[str, Array | Indices]:
    """Return the tensors of a correction of n joints: (3, n), (n, 4 n), (K, 4 n), (K,), (R,), (n,), (n,), (F,), (n,).

    Those of a joint are together. Roots are stored row by row down to the diagonal.
    """
    joints = kernel.joints
    return {
        COUNTS: np.array([[len(each.weights), len(each.root), len(each.fast_weights)] for each in joints], np.int64).T,
        LENGTHSCALES: np.stack([each.lengthscales for each in joints]),
        CENTRES: np.concatenate([each.centres for each in joints]),
        WEIGHTS: np.concatenate([each.weights for each in joints]),
        ROOTS: np.concatenate([each.triangle for each in joints]),
        VARIANCE: kernel.prior,
        TAKEN: np.array([each.taken for each in joints]),
        FAST_WEIGHTS: np.concatenate([each.fast_weights for each in joints]),
        FAST_TAKEN: np.array([each.fast_taken for each in joints]),
    }


def check_shapes(shapes: Mapping[str, tuple[int, ...]], n: int) -> str | None:
    """Return the first error in the shapes of a correction's tensors, None if there is none."""
    missing = [name for name in NAMES if name not in shapes]
    if missing:
        return f"lacks the tensor {missing[0]!r}, but has others of a correction"
    total = shapes[WEIGHTS][0] if len(shapes[WEIGHTS]) == 1 else -1
    expected: dict[str, tuple[int, ...]] = {COUNTS: (3, n), LENGTHSCALES: (n, 4 * n), CENTRES: (total, 4 * n)}
    expected |= {VARIANCE: (n,), TAKEN: (n,), FAST_TAKEN: (n,)}
    for name, shape in expected.items():
        if shapes[name] != shape:
            return f"has {name!r} of shape {shapes[name]}, expected {shape}"
    flat = total >= 0 and len(shapes[ROOTS]) == len(shapes[FAST_WEIGHTS]) == 1
    return None if flat else f"has {WEIGHTS!r}, {FAST_WEIGHTS!r} or {ROOTS!r} with several dimensions"


def read_residual(tensors: Mapping[str, Array]) -> ResidualKernel | None:
    """Return the correction of a model's tensors, None if it has none; raise ValueError for impossible numbers."""
    if COUNTS not in tensors:
        return None
    counts, roots, fast = tensors[COUNTS].astype(np.int64)
    ordered = (roots >= 0).all() and (roots <= fast).all() and (fast <= counts).all()
    if not ordered or [int(counts.sum()), int(fast.sum())] != [len(tensors[WEIGHTS]), len(tensors[FAST_WEIGHTS])]:
        raise ValueError(f"{COUNTS} has {tensors[COUNTS].tolist()}, expected those of {WEIGHTS} and {FAST_WEIGHTS}")
    if int((roots * (roots + 1) // 2).sum()) != len(tensors[ROOTS]):
        raise ValueError(f"{ROOTS} has {len(tensors[ROOTS])} numbers, expected triangles of {roots.tolist()} rows")
    if (tensors[LENGTHSCALES] <= 0).any() or (tensors[VARIANCE] < 0).any():
        raise ValueError(f"{LENGTHSCALES} or {VARIANCE} has a number below zero")
    for name in (TAKEN, FAST_TAKEN):
        if (tensors[name] < 0).any() or (tensors[name] > 1).any():
            raise ValueError(f"{name} has {tensors[name].tolist()}, expected shares from 0 to 1")
    joints, first, at = [], 0, 0
    fast_weights = np.split(tensors[FAST_WEIGHTS], np.cumsum(fast)[:-1])
    for joint, (count, size) in enumerate(zip(counts.tolist(), roots.tolist(), strict=True)):
        rows, root = slice(first, first + count), np.zeros((size, size))
        root[np.tril_indices(size)] = tensors[ROOTS][at : at + size * (size + 1) // 2]
        arrays = tensors[LENGTHSCALES][joint], tensors[CENTRES][rows], tensors[WEIGHTS][rows], root
        variance, taken, fast_taken = (float(tensors[name][joint]) for name in (VARIANCE, TAKEN, FAST_TAKEN))
        joints.append(JointResidual(*arrays, variance, taken, fast_weights[joint], fast_taken))
        first, at = rows.stop, at + size * (size + 1) // 2
    return ResidualKernel(joints)
