"""What the training of an arm says of arms whose geometry is far from where it was linearised.

The posterior N(ŵ, Σ) of the whitened variables w takes torque for linear in steps of the geometry. Some of them torque
leaves open, where a link bears next to none, and a payload makes them known: an arm may then lie a radian away, where
nothing is linear. What the samples say of w is, with A = Σ⁻¹ − 1 = Sᵀ S, as probable as

    exp −½ |S w − t|²,    t = S ŵ + A^(−½) ŵ,

and it is said of torques: S = K Φ with the features Φ of virtual motions all over the training range, K = S Φ⁺. An arm
far away has the torque Φ w + c there, where c is what is not linear. It is as probable as

    exp −½ (|w|² + |S w − t + K c|² + |O c|²),    O = (1 − Φ Φ⁺) (N / R)^½,

where O stands for the N samples of variance R that saw torques that no w makes. To first order in w this is the
posterior. Φ are those features that bend, the arm's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lipcore.data.samples import Array
from lipcore.posterior.linalg import eigen


@dataclass(frozen=True, eq=False)
class Memory:
    """The samples of an arm's training, as far as its posterior tells.

    motions: (V, 3, n), virtual ones; base, features: of the arm as linearised there, torque base + Φᵀ w, (V, n) N·m and
    (M, V, n); slope: S, (r, M); target: t, (r,); spread: K, (r, V n); outside: O, (V n, V n); root: Cholesky root of Σ,
    (M, M).
    """

    motions: Array
    base: Array
    features: Array
    slope: Array
    target: Array
    spread: Array
    outside: Array
    root: Array

    @classmethod
    def of(
        cls, motions: Array, base: Array, features: Array, arm: slice, mean: Array, covariance: Array, variance: Array
    ) -> Memory:
        """What a posterior N(mean, covariance), (M,) and (M, M), remembers. arm: places of its weights; variance: of a
        sample at the motions, (V, n) (N·m)²."""
        flat = features[arm].reshape(-1, variance.size).T
        values, vectors = eigen(covariance)
        precision = 1 / values - 1
        taught = precision > 1e-6  # of prior precision one
        root, along = np.sqrt(precision[taught]), vectors[:, taught]
        slope = (along * root).T
        left, sizes, right = np.linalg.svd(flat, full_matrices=False)
        spanned = sizes > 1e-8 * sizes[0]
        left, back = left[:, spanned], right[spanned].T / sizes[spanned]
        rows = variance.reshape(-1)
        # so many samples, of the variance of each, as have taught as much as the posterior knows
        samples = (slope[:, arm] ** 2).sum() / (flat**2 / rows[:, None]).sum()
        outside = (np.eye(len(left)) - left @ left.T) * np.sqrt(samples / rows)[:, None]
        target = slope @ mean + (along / root).T @ mean
        return cls(
            motions,
            base,
            features,
            slope,
            target,
            slope[:, arm] @ back @ left.T,
            outside,
            np.asarray(np.linalg.cholesky(covariance)),
        )

    def residual(self, w: Array, torque: Array) -> Array:
        """What half the square of is the energy of an arm, (M + r + V n,). w: (M,); torque: its own at the motions,
        (V, n) N·m."""
        bent = (torque - self.base - np.tensordot(w, self.features, axes=1)).reshape(-1)
        return np.concatenate([w, self.slope @ w - self.target + self.spread @ bent, self.outside @ bent])

    def derivative(self, features: Array) -> Array:
        """Of the residual with respect to v, w = ŵ + root v: (M + r + V n, M). features: of the arm, (M, V, n)."""
        bent = (features - self.features).reshape(len(features), -1).T
        along = np.concatenate([self.slope + self.spread @ bent, self.outside @ bent])
        return np.concatenate([self.root, along @ self.root])
