"""Joint motion: what a torque is a function of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from lipcore.vocabulary import JOINT_TYPES, JointType

Array = NDArray[np.float64]


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
    """q, dq and ddq as arrays (N, n); raise ValueError where shapes differ or a value is not finite."""
    arrays = []
    for name, values in (("q", q), ("dq", dq), ("ddq", ddq)):
        array = np.atleast_2d(np.asarray(values, dtype=np.float64))
        if array.ndim != 2 or array.size == 0:
            raise ValueError(f"{name} has shape {array.shape}, expected (N, n) or (n,), neither of them 0")
        check_finite(name, array)
        arrays.append(array)
    for name, array in zip(("dq", "ddq"), arrays[1:], strict=True):
        if array.shape != arrays[0].shape:
            raise ValueError(f"{name} has shape {array.shape}, expected {arrays[0].shape} as q has")
    return arrays[0], arrays[1], arrays[2]


@dataclass(frozen=True)
class Motion:
    """N instants of motion of n joints, float64 tensors on one device.

    q, dq, ddq: (N, n) position, velocity, acceleration in rad, rad/s, rad/s² (prismatic: m, m/s, m/s²).
    """

    q: Tensor
    dq: Tensor
    ddq: Tensor

    @classmethod
    def from_arrays(cls, q: ArrayLike, dq: ArrayLike, ddq: ArrayLike, device: torch.device | str = "cpu") -> Motion:
        """Build from arrays of shape (N, n) or (n,); raise ValueError where shapes differ or a value is not finite."""
        return cls(*(torch.from_numpy(array.copy()).to(device) for array in motion_arrays(q, dq, ddq)))

    def __len__(self) -> int:
        return self.q.shape[0]

    def __getitem__(self, rows: slice | Tensor) -> Motion:
        return Motion(self.q[rows], self.dq[rows], self.ddq[rows])

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return self.q.shape[1]

    @property
    def device(self) -> torch.device:
        """Device of the tensors."""
        return self.q.device

    def arrays(self) -> Array:
        """q, dq and ddq as one C-contiguous array (N, 3, n), which compiled code reads."""
        return np.ascontiguousarray(np.stack([part.cpu().numpy() for part in (self.q, self.dq, self.ddq)], axis=1))

    def to(self, device: torch.device | str) -> Motion:
        """Return the same motion on `device`."""
        return Motion(self.q.to(device), self.dq.to(device), self.ddq.to(device))
