"""The linear terms' features of bodies: which weights they have, and the features of gravity."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lipcore.data.motion import Array, Indices
from lipcore.kernels.base import LinearKernel, Regressor
from lipcore.kernels.drive.kernel import DriveKernel
from lipcore.kernels.fast.play import POSITIONS
from lipcore.kernels.mixture import MixtureKernel
from lipcore.kernels.residual import ResidualKernel


class Gravity:
    """Gravity in the features of linear terms: the torque of bodies and payload at rest, with their gains.

    It is thread-safe.
    """

    def __init__(self, linear: Sequence[LinearKernel], regressors: Sequence[Regressor]) -> None:
        self._terms: list[tuple[Regressor, int, slice | Indices]] = []
        first = 0
        for kernel, regressor in zip(linear, regressors, strict=True):
            places = _places(kernel, first, first + regressor.size)
            if places is not None:
                self._terms.append((regressor, first, places))
            first += regressor.size
        self.mask = np.zeros(first)
        """1 for the weights of bodies and gains, 0 for those of friction, correction and alternative arms, (P,)."""
        for _, _, places in self._terms:
            self.mask[places] = 1.0

    def features(self, motions: Array) -> Array:
        """Return the features of N queries, (N, P, n), whose product with `mask` is that of bodies and gains.

        motions: as of `Motion.arrays`.
        """
        features = np.zeros((len(motions), len(self.mask), motions.shape[2]))
        for regressor, first, _ in self._terms:
            regressor.fill_many(motions, features, first)
        return features

    def subtract(self, motions: Array, features: Array) -> None:
        """Subtract gravity from the features of N queries, (N, P, n). motions: as of `Motion.arrays`."""
        still, own = at_rest(motions), np.empty_like(features)
        for regressor, first, places in self._terms:
            regressor.fill_many(still, own, first)
            features[:, places] -= own[:, places]

    def subtract_one(self, motion: Array, features: Array) -> None:
        """Subtract gravity from the features of one query, (P, n), to the last bit like `subtract`."""
        still, own = np.zeros((POSITIONS, len(motion[0]))), np.empty(features.shape)
        still[0] = motion[0]
        for regressor, first, places in self._terms:
            regressor.fill(still, own[first : first + regressor.size])
            features[places] -= own[places]


def at_rest(motions: Array) -> Array:
    """Return the same postures at rest, (N, 3, n). motions: as of `Motion.arrays`."""
    still = np.zeros_like(motions[:, :POSITIONS])
    still[:, 0] = motions[:, 0]
    return still


def _places(kernel: LinearKernel, first: int, last: int) -> slice | Indices | None:
    """Return the places of a term's features that contain gravity, among those of all linear terms; None if none do."""
    if isinstance(kernel, DriveKernel):
        gains = first + np.flatnonzero(kernel.gains)
        return gains if len(gains) else None
    return None if isinstance(kernel, ResidualKernel | MixtureKernel) else slice(first, last)
