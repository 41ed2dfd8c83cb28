"""The incremental sparse spectrum Gaussian process of Gijsberts and Metta (2013), with forgetting: a baseline.

Each joint on its own: the squared exponential kernel in random Fourier features, and weights by recursive least
squares. The friction features of every estimator here are added, and hyperparameters are those that `se` fits.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from lipcore.data.samples import Array
from lipcore.kernels.friction import FRICTION_TERMS, friction_features
from lipcore.model.torque_model import TorqueModel
from lipcore.online.batch import Rows

FEATURES = 500


@dataclass(frozen=True)
class FourierModel:
    """Torque of joint i: φ_i(x)ᵀ w_i, w_i ~ N(0, I), measured with noise; P features, cosines, sines and friction.

    frequencies: (n, 3 n, F) drawn from the kernel's spectrum; scales: (n,) of the torque, N·m; friction: (n, 3) prior
    standard deviations; noise_std: (n,) N·m; a: (n, P, P), Σ γ φ φᵀ / σ² and b: (n, P), Σ γ φ τ / σ² over the rows so
    far with γ = exp(−age / forgetting_s), ages in s at `time`.
    The prior is not forgotten, which plain recursive least squares does: it would wind up where nothing excites it.
    """

    frequencies: Array
    scales: Array
    friction: Array
    noise_std: Array
    forgetting_s: float | None
    a: Array
    b: Array
    time: float

    @classmethod
    def start(
        cls, fitted: TorqueModel, forgetting_s: float | None, features: int = FEATURES, seed: int = 0
    ) -> FourierModel:
        """Before any row, with the hyperparameters of a fitted `se` estimator."""
        params, n = fitted.posterior.params, fitted.n_joints
        normal = np.random.default_rng(seed).standard_normal((n, 3 * n, features // 2))
        lengthscales = np.exp(params["se.log_lengthscales"])
        size = 2 * (features // 2) + len(FRICTION_TERMS)
        return cls(
            normal / lengthscales[:, :, None],
            np.exp(0.5 * params["se.log_scale"]),
            np.exp(params["friction.log_std"]),
            fitted.noise_std,
            forgetting_s,
            np.zeros((n, size, size)),
            np.zeros((n, size)),
            -np.inf,
        )

    def learn(self, rows: Rows) -> FourierModel:
        """Fold in rows, in the order of their times."""
        now = float(rows.time[-1])
        weight, kept = self._weight(now - rows.time), float(self._weight(np.array(now - self.time)))
        a, b = kept * self.a, kept * self.b
        for joint, features in enumerate(self._features(rows.q, rows.dq, rows.ddq)):
            scaled = features * (weight / self.noise_std[joint] ** 2)[:, None]
            a[joint] += features.T @ scaled
            b[joint] += scaled.T @ rows.tau[:, joint]
        return replace(self, a=a, b=b, time=now)

    def predict(self, q: Array, dq: Array, ddq: Array) -> tuple[Array, Array]:
        """Mean and standard deviation of the function, both (N, n) N·m: posterior of the weights (I + A)⁻¹."""
        mean, std = np.empty_like(q), np.empty_like(q)
        for joint, features in enumerate(self._features(q, dq, ddq)):
            factor = cho_factor(np.eye(len(self.b[joint])) + self.a[joint], lower=True)
            mean[:, joint] = features @ cho_solve(factor, self.b[joint])
            white = solve_triangular(factor[0], features.T, lower=True)
            std[:, joint] = np.sqrt((white**2).sum(0))
        return mean, std

    def _weight(self, age: Array) -> Array:
        """Weight of a row so many seconds ago."""
        return np.ones_like(age) if self.forgetting_s is None else np.exp(-age / self.forgetting_s)

    def _features(self, q: Array, dq: Array, ddq: Array) -> list[Array]:
        """φ of every joint, (N, P) each."""
        state = np.concatenate([q, dq, ddq], axis=1)
        friction = friction_features(dq)  # (3, N, n)
        found = []
        for joint, frequencies in enumerate(self.frequencies):
            phase = state @ frequencies
            waves = self.scales[joint] / np.sqrt(phase.shape[1]) * np.hstack([np.cos(phase), np.sin(phase)])
            found.append(np.hstack([waves, friction[:, :, joint].T * self.friction[joint]]))
        return found
