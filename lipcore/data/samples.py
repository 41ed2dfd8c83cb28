"""A table of samples: recorded, simulated, uploaded, and the input of a training."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lipcore.data.motion import Motion

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Samples:
    """N samples of n joints, SI units, joint order as in `joint_names`.

    q, dq, ddq, tau: (N, n); t: (N,) seconds; episode: (N,) integers, constant over one contiguous recording;
    deflections: as in `Motion`, from the motion before each sample, or None.

    Example:
        >>> t, rest = np.linspace(0.0, 1.0, 5), np.zeros((5, 1))
        >>> samples = Samples(("joint1",), t, np.zeros(5, np.int64), rest, rest, rest, tau=rest + 2.0)
        >>> len(samples), samples.n_joints
        (5, 1)

    """

    joint_names: tuple[str, ...]
    t: Array
    episode: NDArray[np.int64]
    q: Array
    dq: Array
    ddq: Array
    tau: Array
    deflections: Array | None = None

    def __post_init__(self) -> None:
        shape = (len(self.t), len(self.joint_names))
        for name in ("q", "dq", "ddq", "tau"):
            if getattr(self, name).shape != shape:
                raise ValueError(f"{name} has shape {getattr(self, name).shape}, expected {shape}")
        if self.episode.shape != (shape[0],):
            raise ValueError(f"episode has shape {self.episode.shape}, expected {(shape[0],)}")
        if self.deflections is not None and self.deflections.shape[::2] != shape:
            raise ValueError(f"deflections have shape {self.deflections.shape}, expected {shape} around elements")

    def __len__(self) -> int:
        return len(self.t)

    @property
    def n_joints(self) -> int:
        """Return the number of joints n."""
        return len(self.joint_names)

    def rows(self, index: slice | NDArray[np.int64] | NDArray[np.bool_]) -> Samples:
        """Return the chosen rows. index: a slice, indices, or a mask (N,)."""
        arrays = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "joint_names"}
        return replace(self, **{name: each[index] for name, each in arrays.items() if each is not None})

    def joints(self, index: NDArray[np.int64]) -> Samples:
        """Return the chosen joints, in this order."""
        arrays = {name: np.ascontiguousarray(getattr(self, name)[:, index]) for name in ("q", "dq", "ddq", "tau")}
        known = None if self.deflections is None else np.ascontiguousarray(self.deflections[:, :, index])
        return replace(self, joint_names=tuple(self.joint_names[joint] for joint in index), deflections=known, **arrays)

    def episodes(self) -> list[slice]:
        """Return the contiguous runs of equal `episode`, in order of rows."""
        edges = np.flatnonzero(np.diff(self.episode)) + 1
        bounds = [0, *edges.tolist(), len(self)]
        return [slice(a, b) for a, b in pairwise(bounds) if b > a]

    def motion(self) -> Motion:
        """Return the motion, with copies of q, dq and ddq; raise ValueError if one of their numbers is not finite."""
        return replace(Motion.from_arrays(self.q, self.dq, self.ddq), deflections=self.deflections)

    @staticmethod
    def concatenate(parts: list[Samples]) -> Samples:
        """Return the rows of all parts in order; episodes are renumbered so that parts never share one."""
        if not parts:
            raise ValueError("no samples to concatenate")
        if empty := [index for index, part in enumerate(parts) if len(part) == 0]:
            raise ValueError(f"part {empty[0]} has no samples")
        names = parts[0].joint_names
        for part in parts[1:]:
            if part.joint_names != names:
                raise ValueError(f"joint names differ: {list(part.joint_names)}, expected {list(names)}")
        episodes, used = [], 0
        for part in parts:
            numbered = np.unique(part.episode, return_inverse=True)[1].astype(np.int64) + used
            episodes.append(numbered)
            used = int(numbered.max()) + 1
        stack = {k: np.concatenate([getattr(p, k) for p in parts]) for k in ("t", "q", "dq", "ddq", "tau")}
        deflections = joined_deflections([part.deflections for part in parts], [len(part) for part in parts])
        return Samples(joint_names=names, episode=np.concatenate(episodes), deflections=deflections, **stack)


def joined_deflections(parts: Sequence[Array | None], rows: Sequence[int]) -> Array | None:
    """Return the deflections of several parts, as in `Motion`; None if all are unknown. rows: of each part."""
    known = next((part for part in parts if part is not None), None)
    if known is None:
        return None
    unknown = np.repeat([0.0, 1.0], known.shape[1] // 2)[None, :, None] * np.ones((1, 1, known.shape[2]))
    return np.concatenate(
        [np.repeat(unknown, count, axis=0) if part is None else part for part, count in zip(parts, rows, strict=True)]
    )
