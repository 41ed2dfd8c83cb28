"""A baseline: the incremental sparse spectrum Gaussian process of Gijsberts and Metta (2013), with forgetting.

Each joint has its own model: random Fourier features of a squared exponential kernel, lipcore's friction features, and
weights by recursive least squares. Hyperparameters are those of a fitted `se` estimator.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from lipcore.data.samples import Array
from lipcore.kernels.drive.terms import BASE_TERMS, drive_features
from lipcore.model.torque_model import TorqueModel
from lipcore.online.batch import Rows

FEATURES = 500


@dataclass(frozen=True)
class FourierModel:
    """Torque φ_i(x)ᵀ w_i of each joint i, with w_i ~ N(0, I) and P features: cosines, sines and friction.

    Unlike plain recursive least squares, the prior is not forgotten, as weights without excitation would wind up.

    Attributes:
        frequencies: draws from the kernel's spectrum, (n, 3 n, F).
        scales: scales of the torque, (n,), N·m.
        friction: prior standard deviations of friction, (n, 3).
        noise_std: (n,), N·m.
        forgetting_s: time constant of the weights γ = exp(−age / forgetting_s); None: no forgetting.
        a: Σ γ φ φᵀ / σ² over all rows, (n, P, P).
        b: Σ γ φ τ / σ² over all rows, (n, P).
        time: time at which ages are 0, s.
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
        """Return the prior with the hyperparameters of a fitted `se` estimator."""
        params, n = fitted.posterior.params, fitted.n_joints
        normal = np.random.default_rng(seed).standard_normal((n, 3 * n, features // 2))
        lengthscales = np.exp(params["se.log_lengthscales"])
        size = 2 * (features // 2) + len(BASE_TERMS)
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
        """Return the model after more rows, in the order of their times."""
        now = float(rows.time[-1])
        weight, kept = self._weight(now - rows.time), float(self._weight(np.array(now - self.time)))
        a, b = kept * self.a, kept * self.b
        for joint, features in enumerate(self._features(rows.q, rows.dq, rows.ddq)):
            scaled = features * (weight / self.noise_std[joint] ** 2)[:, None]
            a[joint] += features.T @ scaled
            b[joint] += scaled.T @ rows.tau[:, joint]
        return replace(self, a=a, b=b, time=now)

    def predict(self, q: Array, dq: Array, ddq: Array) -> tuple[Array, Array]:
        """Return mean and standard deviation of the function, (N, n), N·m."""
        mean, std = np.empty_like(q), np.empty_like(q)
        for joint, features in enumerate(self._features(q, dq, ddq)):
            factor = cho_factor(np.eye(len(self.b[joint])) + self.a[joint], lower=True)
            mean[:, joint] = features @ cho_solve(factor, self.b[joint])
            white = solve_triangular(factor[0], features.T, lower=True)
            std[:, joint] = np.sqrt((white**2).sum(0))
        return mean, std

    def _weight(self, age: Array) -> Array:
        """Return the weights of rows of these ages, s."""
        return np.ones_like(age) if self.forgetting_s is None else np.exp(-age / self.forgetting_s)

    def _features(self, q: Array, dq: Array, ddq: Array) -> list[Array]:
        """Return φ of every joint, (N, P) each."""
        state = np.concatenate([q, dq, ddq], axis=1)
        friction = drive_features(dq)  # (3, N, n)
        found = []
        for joint, frequencies in enumerate(self.frequencies):
            phase = state @ frequencies
            waves = self.scales[joint] / np.sqrt(phase.shape[1]) * np.hstack([np.cos(phase), np.sin(phase)])
            found.append(np.hstack([waves, friction[:, :, joint].T * self.friction[joint]]))
        return found
