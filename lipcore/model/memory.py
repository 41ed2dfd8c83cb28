"""Probability of arms with a geometry far from the linearisation, given the training of the arm.

The posterior N(ŵ, Σ) of the whitened variables w assumes that torque is linear in steps of the geometry. Torque leaves
some steps unidentified if a link bears almost no load, and a payload identifies them. The arm may then be a radian
away, beyond the linear range. With A = Σ⁻¹ − 1 = Sᵀ S, the samples have the likelihood of w

    exp −½ |S w − t|²,    t = S ŵ + A^(−½) ŵ,

which is a statement about torques: S = K Φ with the features Φ of virtual motions in the training range, K = S Φ⁺. An
arm far away has the torque Φ w + c there, where c is the nonlinear part. Its probability is proportional to

    exp −½ (|w|² + |S w − t + K c|² + |O c|²),    O = (1 − Φ Φ⁺) (N / R)^½,

where O represents the N samples of variance R that observed torques which no w produces. To first order in w this is
the posterior. Φ are the features that are nonlinear in the geometry, those of the arm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lipcore.data.samples import Array
from lipcore.posterior.linalg import eigen


@dataclass(frozen=True, eq=False)
class Memory:
    """The samples of an arm's training, as its posterior represents them."""

    motions: Array
    """Virtual motions, (V, 3, n)."""
    base: Array
    """Torque of the linearised arm with w = 0 at the motions, (V, n) N·m. Its torque is base + Φᵀ w."""
    features: Array
    """Features Φ of the linearised arm at the motions, (M, V, n)."""
    slope: Array
    """S, (r, M)."""
    target: Array
    """t, (r,)."""
    spread: Array
    """K, (r, V n)."""
    outside: Array
    """O, (V n, V n)."""
    root: Array
    """Cholesky root of Σ, (M, M)."""

    @classmethod
    def of(
        cls, motions: Array, base: Array, features: Array, arm: slice, mean: Array, covariance: Array, variance: Array
    ) -> Memory:
        """Return the memory of a posterior N(mean, covariance), (M,) and (M, M).

        arm: places of the arm's weights; variance: of a sample at the motions, (V, n) (N·m)².
        """
        flat = features[arm].reshape(-1, variance.size).T
        values, vectors = eigen(covariance)
        precision = 1 / values - 1
        taught = precision > 1e-6  # relative to the prior precision of one
        root, along = np.sqrt(precision[taught]), vectors[:, taught]
        slope = (along * root).T
        left, sizes, right = np.linalg.svd(flat, full_matrices=False)
        spanned = sizes > 1e-8 * sizes[0]
        left, back = left[:, spanned], right[spanned].T / sizes[spanned]
        rows = variance.reshape(-1)
        # number of samples, each with its variance, that give the precision of the posterior
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
        """Return the residual of an arm, (M + r + V n,). Half of its square is the arm's energy.

        w: (M,); torque: its own at the motions, (V, n) N·m.
        """
        bent = (torque - self.base - np.tensordot(w, self.features, axes=1)).reshape(-1)
        return np.concatenate([w, self.slope @ w - self.target + self.spread @ bent, self.outside @ bent])

    def derivative(self, features: Array) -> Array:
        """Return the derivative of the residual by v, w = ŵ + root v, (M + r + V n, M).

        features: of the arm, (M, V, n).
        """
        bent = (features - self.features).reshape(len(features), -1).T
        along = np.concatenate([self.slope + self.spread @ bent, self.outside @ bent])
        return np.concatenate([self.root, along @ self.root])
