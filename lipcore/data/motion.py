"""Joint motion, the input of a torque model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lipcore.vocabulary import JOINT_TYPES, JointType

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


def spaced_rows(size: int, count: int, first: int = 0) -> Indices:
    """Return at most `count` of `size` row numbers from `first` on, evenly spaced, with the first and the last.

    >>> spaced_rows(9, 3).tolist()
    [0, 4, 8]
    """
    return np.linspace(first, first + size - 1, min(count, size)).round().astype(np.int64)


def check_joint_types(joint_types: Sequence[str]) -> tuple[JointType, ...]:
    """Return `joint_types` as a tuple; raise ValueError naming the first one that is unknown."""
    if not joint_types:
        raise ValueError("joint_types is empty: a robot has at least one joint")
    for index, kind in enumerate(joint_types):
        if kind not in JOINT_TYPES:
            raise ValueError(f"joint_types[{index}] is {kind!r}, expected one of {', '.join(JOINT_TYPES)}")
    return cast(tuple[JointType, ...], tuple(joint_types))


def check_finite(name: str, array: NDArray[np.float64]) -> None:
    """Raise ValueError naming the first element of `array` (N, n) that is not finite."""
    if not np.isfinite(array).all():
        sample, joint = np.argwhere(~np.isfinite(array))[0]
        raise ValueError(f"{name}[{sample}, {joint}] is {array[sample, joint]}, expected a finite number")


def motion_arrays(q: ArrayLike, dq: ArrayLike, ddq: ArrayLike) -> tuple[Array, Array, Array]:
    """Return q, dq and ddq as arrays (N, n); raise ValueError if shapes differ or a value is not finite."""
    arrays = []
    for name, values in (("q", q), ("dq", dq), ("ddq", ddq)):
        array = np.atleast_2d(np.asarray(values, dtype=np.float64))
        if array.ndim != 2 or array.size == 0:
            raise ValueError(f"{name} has shape {array.shape}, expected (N, n) or (n,) with N and n of at least 1")
        check_finite(name, array)
        arrays.append(array)
    for name, array in zip(("dq", "ddq"), arrays[1:], strict=True):
        if array.shape != arrays[0].shape:
            raise ValueError(f"{name} has shape {array.shape}, expected {arrays[0].shape}, the shape of q")
    return arrays[0], arrays[1], arrays[2]


@dataclass(frozen=True)
class Motion:
    """N instants of motion of n joints, float64.

    q, dq, ddq: (N, n) position, velocity, acceleration in rad, rad/s, rad/s² (prismatic: m, m/s, m/s²). deflections:
    (N, 2 K, n), of the drive's K play elements: their expected values, then their standard deviations
    (`lipcore.kernels.drive.play`); None if the motion before these instants is unknown.
    """

    q: Array
    dq: Array
    ddq: Array
    deflections: Array | None = None

    @classmethod
    def from_arrays(cls, q: ArrayLike, dq: ArrayLike, ddq: ArrayLike) -> Motion:
        """Build from copies of arrays, (N, n) or (n,); raise ValueError if shapes differ or a value is not finite."""
        return cls(*(array.copy() for array in motion_arrays(q, dq, ddq)))

    def __len__(self) -> int:
        return len(self.q)

    def __getitem__(self, rows: slice | Indices) -> Motion:
        return Motion(
            self.q[rows], self.dq[rows], self.ddq[rows], None if self.deflections is None else self.deflections[rows]
        )

    @property
    def n_joints(self) -> int:
        """Return the number of joints n."""
        return int(self.q.shape[1])

    def arrays(self) -> Array:
        """Return q, dq, ddq and the deflections, if known, as one C-contiguous array for compiled code.

        It has the shape (N, 3, n) or (N, 3 + 2 K, n).
        """
        own = np.stack([self.q, self.dq, self.ddq], axis=1)
        return own if self.deflections is None else np.concatenate([own, self.deflections], axis=1)

    @classmethod
    def of(cls, motions: Array) -> Motion:
        """Return the motion that `arrays` returned."""
        q, dq, ddq = motions[:, :3].swapaxes(0, 1)
        return cls(q, dq, ddq, motions[:, 3:] if motions.shape[1] > 3 else None)
