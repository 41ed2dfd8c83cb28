"""Centres of one joint's residual: chosen among samples, and the features of their correlations."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lipcore.data.motion import Indices
from lipcore.data.samples import Array
from lipcore.data.splits import SplitRows
from lipcore.kernels.residual import JointResidual
from lipcore.posterior.linalg import add_diagonal, cholesky, whiten_rows
from lipcore.posterior.selection import TargetFunction, pivots

Blocks = Sequence[tuple[slice, SplitRows]]
"""Contiguous blocks of N samples, which they cover, each with the rows to train on and to test."""
CHUNK = 2048
"""Samples of one matrix product."""


@dataclass(frozen=True)
class CentreOptions:
    """Numbers of centres."""

    features: int = 100
    """Max number of centres that standard deviations and streams use, because their cost grows with its square."""
    fast: int = 200
    """Max number of centres of fast answers, because the cost of a mean grows with it."""
    rich: tuple[int, ...] = (400, 800, 1500)
    """Larger numbers of centres that are tried, the fewest first."""
    open_share: float = 1e-4
    """Max share of the correction's variance that the centres do not explain at the samples."""


OPTIONS = CentreOptions()


@dataclass(frozen=True)
class Centres:
    """Centres of one joint's residual, in the order of choice."""

    lengthscales: Array
    """ℓ, (4 n,), in the units of the inputs."""
    places: Array
    """z, (m, 4 n), in lengthscales, of float32 numbers."""
    root: Array
    """Cholesky factor of their correlations, (m, m)."""

    @classmethod
    def choose(
        cls, candidates: Array, lengthscales: Array, values: Array, noise: Array, blocks: Blocks
    ) -> tuple[Centres, Indices]:
        """Return centres, and their rows among K candidates.

        Centres of fast answers interpolate the residual that the other blocks predict: what is learnt only there must
        not choose them. The others are where candidates are far from centres, and have large weights in the residual.

        candidates: inputs, (K, 4 n); lengthscales: (4 n,); values: residual, (K,), in any unit; noise: its variance
        over that of the residual, (K,); blocks: of the candidates.
        """
        some = (candidates / lengthscales).astype(np.float32).astype(np.float64)
        near = _correlations(some, some)
        expected, weights = predict_held_out(near, values, noise, blocks)
        function = TargetFunction(expected, OPTIONS.fast, np.abs(weights))
        order = pivots(near, 1, OPTIONS.rich[-1], OPTIONS.open_share, function)
        rows = order.outputs
        return cls(lengthscales, some[rows], np.ascontiguousarray(order.lower[rows])), rows

    @classmethod
    def of(cls, joint: JointResidual) -> Centres:
        """Return the centres of a residual."""
        return cls(joint.lengthscales, joint.centres, cholesky(_correlations(joint.centres, joint.centres)).lower)

    def sizes(self) -> list[int]:
        """Return the numbers of centres to try: of the features, of fast answers, and larger ones."""
        count = len(self.places)
        return [*(size for size in (OPTIONS.features, OPTIONS.fast, *OPTIONS.rich) if size < count), count]

    def near(self, inputs: Array, rows: slice) -> Iterator[tuple[slice, Array]]:
        """Yield the correlations of samples with the centres, CHUNK by CHUNK. inputs: (N, 4 n), of all samples."""
        for first in range(rows.start, rows.stop, CHUNK):
            part = slice(first, min(first + CHUNK, rows.stop))
            yield part, _correlations(inputs[part] / self.lengthscales, self.places)

    def whiten(self, near: Array) -> NDArray[np.float32]:
        """Return the features φ of correlations, (K, m) both."""
        features = near.astype(np.float32)
        whiten_rows(self._single_root, features)
        return features

    @cached_property
    def _single_root(self) -> NDArray[np.float32]:
        return self.root.astype(np.float32)

    def features(self, inputs: Array, rows: Indices, blocks: Blocks) -> tuple[NDArray[np.float32], Array]:
        """Return the features φ of N samples, (N, m), and their nearness, (N, sizes).

        The nearness is the largest squared correlation with one of the first centres that is not held out with the
        sample, for each number of `sizes`. rows: samples that are the centres, (m,).
        """
        sizes = self.sizes()
        features, nearness = np.empty((len(inputs), len(rows)), np.float32), np.empty((len(inputs), len(sizes)))
        for block, parts in blocks:
            others = parts.train[rows]
            for part, near in self.near(inputs, block):
                most = [(near * others)[:, a:b].max(axis=1) for a, b in pairwise([0, *sizes])]
                nearness[part] = np.maximum.accumulate(np.square(most), axis=0).T
                features[part] = self.whiten(near)
        return features, nearness


def predict_held_out(gram: Array, values: Array, noise: Array, blocks: Blocks) -> tuple[Array, Array]:
    """Return the mean of a Gaussian process at K samples, (K,), each block from the others, and all samples' weights.

    With P = (K + R)⁻¹, samples S that are not trained on have the mean y_S − P_SS⁻¹ (P y)_S. The weights are P y, (K,).
    gram: K, (K, K); values: y, (K,); noise: diagonal of R, (K,).
    """
    noisy, mean, change = gram.copy(), values.copy(), np.zeros(len(values))
    add_diagonal(noisy, noise)
    inverse = cholesky(noisy).inverse()
    weights = inverse @ values
    for block, parts in blocks:
        out = np.flatnonzero(~parts.train)
        change[out] = cholesky(inverse[np.ix_(out, out)]).solve(weights[out])
        mean[block] -= change[block]
    return mean, weights


def blocks_of(rows: Indices, blocks: Blocks) -> Blocks:
    """Return the blocks of some rows, sorted, of N samples."""
    return [
        (slice(*np.searchsorted(rows, (block.start, block.stop))), SplitRows(parts.train[rows], parts.held_out[rows]))
        for block, parts in blocks
    ]


def _correlations(a: Array, b: Array) -> Array:
    """Return exp(−½ |a − b|²), (K, m). a: (K, D); b: (m, D)."""
    squares = np.einsum("kd,kd->k", a, a)[:, None] - 2 * (a @ b.T) + np.einsum("md,md->m", b, b)
    return np.asarray(np.exp(-0.5 * np.maximum(squares, 0.0)))
