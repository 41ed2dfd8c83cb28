"""Cross covariances with LANES inducing samples at a time: what those of the baseline kernels have in common.

Samples lie in blocks of LANES, four numbers a joint, so that a formula written for one pair of samples becomes SIMD
instructions for all pairs of a block. The query is written behind the last inducing sample and meets itself like it.
"""

from __future__ import annotations

import threading
from abc import abstractmethod
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lipcore.data.motion import Motion
from lipcore.kernels.compiled.compile import compiled
from lipcore.kernels.compiled.cross import Array, Cross

Flags = NDArray[np.bool_]

LANES = 16
"""Inducing samples evaluated together: long enough to fill vectors, short enough that few lanes stay idle."""
SIN, COS, V, A = range(4)  # what a sample knows of each joint: sine and cosine of its angle or (q, 1), then dq and ddq


class Lanes(threading.local):
    """Memory of one thread, made when the thread first asks.

    samples: (blocks, n, 4, LANES), the inducing samples with room for the query behind them; joints: (n, rows, LANES),
    sums: (rows, LANES) and block: (n, n, LANES), all of one block of pairs.
    """

    def __init__(self, samples: Array, joint_rows: int, sum_rows: int) -> None:
        n = samples.shape[1]
        self.samples = samples.copy()
        self.joints = np.zeros((n, joint_rows, LANES))
        self.sums = np.zeros((sum_rows, LANES))
        self.block = np.zeros((n, n, LANES))


class LaneCross(Cross):
    """A kernel of differences or products of joint positions, velocities and accelerations.

    inducing: S samples; turning: (n,), which joints enter by sine and cosine of `angle` · q, the others by angle · q;
    joint_rows, sum_rows: numbers that the kernel keeps of every pair, a joint and in all.
    """

    def __init__(self, inducing: Motion, turning: Flags, angle: float, joint_rows: int, sum_rows: int) -> None:
        self.n_joints, self.size = inducing.n_joints, len(inducing)
        self.turning, self.angle = turning, angle
        # idle lanes hold zeros: numbers that every kernel is finite at
        samples = np.zeros((self.size // LANES + 1, self.n_joints, 4, LANES))
        parts = (inducing.q, inducing.dq, inducing.ddq)
        for k, motion in enumerate(np.stack([part.detach().cpu().numpy() for part in parts], axis=1)):
            place(motion, turning, angle, k, samples)
        self._lanes = Lanes(samples, joint_rows, sum_rows)

    def fill(self, motion: Array, out: Array) -> None:
        """Write the covariances of the query's torques into `out`, (S + 1, n, n) (N·m)²; see `Cross.fill`."""
        self.evaluate(motion, self._lanes, out)

    @abstractmethod
    def evaluate(self, motion: Array, lanes: Lanes, out: Array) -> None:
        """Compiled `fill`; lanes: the memory of this thread."""


def turning_joints(joint_types: Sequence[str]) -> Flags:
    """Which joints are revolute, (n,)."""
    return np.array([kind == "revolute" for kind in joint_types], dtype=np.bool_)


@compiled
def place(motion: Array, turning: Flags, angle: float, k: int, samples: Array) -> None:
    """Write what sample number k, motion (3, n), knows of each joint into its lane."""
    block, lane = k // LANES, k % LANES
    for b in range(motion.shape[1]):
        q = angle * motion[0, b]
        samples[block, b, SIN, lane] = np.sin(q) if turning[b] else q
        samples[block, b, COS, lane] = np.cos(q) if turning[b] else 1.0
        samples[block, b, V, lane] = motion[1, b]
        samples[block, b, A, lane] = motion[2, b]
