"""The evidence of a geometry, with masses, rotor inertia and friction integrated out, and its minimisation.

    τ = Y(θ) π + r ∘ ddq + P f + ε,    ε_j ~ N(0, σ_j²),    w = (π, r, f) ~ N(μ, diag s²)

The torque is linear in w, so w is integrated out in closed form. The objective is −log p(τ | θ, σ) − log p(θ). The step
is that of Gauss–Newton on (w, θ) together, damped in θ (Levenberg–Marquardt). J = ∂(Y π)/∂θ is exact.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.linalg import LinAlgError
from numpy.typing import NDArray
from scipy.linalg import cho_solve, lapack, solve_triangular

from lipcore.data.motion import Indices
from lipcore.data.samples import Array
from lipcore.kernels.drive.kernel import Drive
from lipcore.kernels.fast.arm import PARAMETERS, arm_masses, arm_shapes
from lipcore.kernels.geometry import Geometry


@dataclass(frozen=True)
class PriorWidths:
    """Prior standard deviations of an arm without a robot."""

    angle: float = 1.0
    """Directions of axes, rad."""
    length: float = 0.5
    """Places of axes, m."""
    noise: float = 3.0
    """Logarithm of σ."""
    scale: float = 2.0
    """Parts of the logarithms of s (`arm.scales`): a factor of seven either way within one standard deviation."""
    unit: float = 0.3
    """Parts of the logarithms of s for masses and rotor inertias, if the prior is another unit. The difference to that
    unit is about as large as expected."""


WIDTHS = PriorWidths()


@dataclass(frozen=True)
class GeometryPrior:
    """Prior of a geometry."""

    widths: Array
    """Standard deviations, (g,) rad and m."""
    around: Geometry | None = None
    """Geometry of a URDF, if there is one. Without it axes may have any direction, and lie near the frame before
    them."""

    @classmethod
    def anything(cls, geometry: Geometry) -> GeometryPrior:
        """Return the prior of an unknown arm: axes in any direction, within some 0.5 m of the frame before."""
        return cls(np.where(geometry.turns, WIDTHS.angle, WIDTHS.length))

    def step(self, geometry: Geometry) -> Array:
        """Return the step from a geometry to the prior mean, (g,) rad and m."""
        return -geometry.shifts() if self.around is None else geometry.towards(self.around)

    def value(self, geometry: Geometry) -> float:
        """Return −log of the prior density at a geometry, nats, without its constant."""
        return 0.5 * float(np.sum((self.step(geometry) / self.widths) ** 2))


@dataclass(frozen=True)
class Point:
    """A geometry with its evidence and its most likely weights."""

    geometry: Geometry
    sigma: Array
    """Noise std, (n,) N·m."""
    value: float
    """−log posterior, nats."""
    weights: Array
    """Most likely w, in units of s around μ, (k,)."""
    features: Array
    """Features of w, (N, n, k)."""
    factor: Array
    """Cholesky factor of I plus the precision of w."""


@dataclass(frozen=True)
class Problem:
    """Samples, with the prior of the arm that is learnt from them."""

    motions: Array
    """Motion from base to tip, as of `Motion.arrays`, (N, 3, n) or (N, 3 + 2 K, n)."""
    tau: Array
    """Torques, (N, n) N·m."""
    counts: Array
    """Independent measurements that each torque represents, (N, n)."""
    friction: Array
    """Features of friction, (N, n, f n), those of `drive`."""
    centre: Array
    """μ, prior mean of w, (k,)."""
    scale: Array
    """s, prior standard deviations of w, (k,)."""
    unit: Array
    """s before any samples, (k,); that of friction is the joint's torque."""
    noise: Array
    """Prior median of the noise, (n,) N·m."""
    floor: Array
    """Min noise, (n,) N·m."""
    expected: GeometryPrior | None
    """Prior of the geometry, None if it is fixed."""
    drive: Drive
    """Terms of friction, base to tip."""
    used: NDArray[np.bool_]
    """Terms that a joint has, (n, f). The coefficients of others are zero."""
    scale_width: float = WIDTHS.scale
    """Prior standard deviation of the parts of the logarithms of s, except those of friction."""

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return int(self.tau.shape[1])

    @property
    def bodies(self) -> int:
        """Number of weights of masses and rotors, which come before those of friction."""
        return (PARAMETERS + 1) * self.n_joints

    def rows(self, rows: Indices) -> Problem:
        """Return the same problem with some of the samples. rows: indices, or a mask (N,)."""
        kept = {name: getattr(self, name)[rows] for name in ("motions", "tau", "counts", "friction")}
        return replace(self, **kept)

    def recombined(self, count: int) -> Problem:
        """Return a problem of at most `count` recombined motions, without torque.

        Position, velocity and acceleration of a motion are those of three samples, deflections those of the velocity.
        It is in the range of the samples, but new.
        """
        rng, size = np.random.default_rng(0), min(count, len(self.tau))
        rows = rng.integers(len(self.tau), size=(3, size))
        motions = self.motions[rows[1]]
        motions[:, 0], motions[:, 2] = self.motions[rows[0], 0], self.motions[rows[2], 2]
        nothing = np.zeros((size, self.n_joints))
        return replace(
            self, motions=motions, tau=nothing, counts=np.ones_like(nothing), friction=self.drive.features(motions)
        )

    def mean(self, point: Point) -> Array:
        """Return the most likely torque of a point at these samples, (N, n) N·m."""
        return np.asarray(self.features(point.geometry) @ (self.weights(point) / self.scale))

    def weights(self, point: Point) -> Array:
        """Return the most likely w of a point, (k,), in SI units."""
        return self.centre + point.weights * self.scale

    def parameters(self, point: Point) -> Array:
        """Return the inertial parameters π of a point, (n, 10)."""
        n = self.n_joints
        return np.ascontiguousarray(self.weights(point)[: PARAMETERS * n].reshape(n, PARAMETERS))

    def features(self, geometry: Geometry) -> Array:
        """Return the features Φ of w at a geometry, in units of s, (N, n, k) (eq. 12 of docs/method.md)."""
        size, n = self.tau.shape
        out = np.empty((size, n, len(self.scale)))
        masses = np.empty((size, PARAMETERS * n, n))
        arm_masses(geometry.constants, geometry.gravity, np.arange(n), self.motions, masses)
        first = PARAMETERS * n
        out[:, :, :first] = masses.transpose(0, 2, 1)
        out[:, :, first : first + n] = self.motions[:, 2, :, None] * np.eye(n)
        out[:, :, first + n :] = self.friction
        out *= self.scale
        return out

    def shapes(self, point: Point) -> Array:
        """Return J = ∂(Y π)/∂θ at a point, (N, n, g); g = 0 if the geometry is fixed."""
        n = self.n_joints
        geometry = point.geometry
        out = np.empty((len(self.tau), geometry.size if self.expected is not None else 0, n))
        if self.expected is None:
            return out.transpose(0, 2, 1)
        parameters = self.parameters(point)
        arm_shapes(geometry.constants, geometry.gravity, parameters, np.arange(n), self.motions, out)
        return out.transpose(0, 2, 1)

    def at(self, geometry: Geometry, sigma: Array, features: Array | None = None) -> Point:
        """Return the point of a geometry and a noise, with its evidence and priors (eq. 18 of docs/method.md).

        sigma: (n,) N·m; features: result of `features`, if known. Raise LinAlgError if the evidence cannot be computed.
        """
        features = self.features(geometry) if features is None else features
        scaled, target = self._scaled(features, sigma)
        precision = scaled.T @ scaled
        precision.flat[:: len(precision) + 1] += 1.0
        lower = root_of(precision)
        weights = cho_solve((lower, True), scaled.T @ target, check_finite=False)
        left = target - scaled @ weights  # target² − … would lose all digits if the noise is small
        value = 0.5 * (left @ left + weights @ weights) + np.log(lower.diagonal()).sum()
        value += self.counts.sum(0) @ np.log(sigma)
        value += 0.0 if self.expected is None else self.expected.value(geometry)
        value += 0.5 * np.sum((np.log(sigma / self.noise) / WIDTHS.noise) ** 2)
        return Point(geometry, sigma, float(value), weights, features, lower)

    def laplace(self, point: Point) -> float:
        """Return −log p(τ | σ), nats, of all geometries near a point.

        It is the point's value plus half the log determinant of the precision of θ after w is integrated out. The
        constant of the prior is not included.
        """
        hessian, _, k = self.normal(point)
        roots = root_of(hessian).diagonal()  # w comes first
        return point.value + float(np.log(roots[k:]).sum())

    def residual(self, point: Point) -> Array:
        """Return the residual torque of a point, (N, n) N·m."""
        return self.tau - point.features @ (self.weights(point) / self.scale)

    def with_noise(self, point: Point) -> Point:
        """Return the point with the noise of its residuals: their squares divided by the remaining degrees of freedom.

        Every row counts, even if few of them are independent: lasting errors are as large as others.
        """
        size, n = self.tau.shape
        scaled, _ = self._scaled(point.features, point.sigma)
        white = solve_triangular(point.factor, scaled.T, lower=True, check_finite=False)
        leverage = np.square(white).sum(0).reshape(size, n).sum(0)
        left = size - np.minimum(leverage, 0.9 * size)
        squares = (self.counts / self.counts.mean(0) * self.residual(point) ** 2).sum(0)
        sigma = np.maximum(np.sqrt(squares / left), self.floor)
        return self.at(point.geometry, sigma, point.features)

    def descend(
        self,
        start: Geometry,
        sigma: Array,
        iterations: int,
        stop: Callable[[], bool] | None = None,
        noise: bool = True,
    ) -> Point:
        """Return the local optimum from a geometry. `noise`: whether to estimate the noise too.

        stop: called at every step. Raise LinAlgError if the evidence cannot be computed.
        """
        point, damping = self.at(start, sigma), 1e-2
        largest = np.where(start.turns, 0.5, 0.3)  # rad and m; the linearisation is not valid beyond
        for iteration in range(iterations):
            before = point.value
            hessian, gradient, k = self.normal(point)
            for _ in range(7 if self.expected is not None else 0):
                damped = hessian.copy()
                shape = np.arange(k, len(damped))
                damped[shape, shape] *= 1 + damping
                step = cho_solve((root_of(damped), True), gradient, check_finite=False)[k:]
                step /= max(1.0, float(np.abs(step / largest).max(initial=0.0)))
                moved = point.geometry.moved(step)
                if self.expected is not None and self.expected.around is None:
                    moved = moved.canonical()
                trial = self.at(moved, point.sigma)
                if trial.value < point.value:
                    point, damping = trial, max(damping / 8, 1e-8)
                    break
                damping = min(damping * 8, 1e8)
            for _ in range(2 if noise else 0):
                point = self.with_noise(point)
            if (abs(before - point.value) < 0.01 and iteration > 2) or (stop is not None and stop()):
                break
        return point

    def all_features(self, point: Point) -> Array:
        """Return the features of (w, θ) around a point at these samples, those of w in units of s, (N, n, k + g)."""
        return np.concatenate([self.features(point.geometry), self.shapes(point)], axis=2)

    def normal(self, point: Point) -> tuple[Array, Array, int]:
        """Return the undamped normal equations of (w, θ) (eq. 19 of docs/method.md).

        They are the precision (k + g, k + g), the right-hand side (k + g,), and k, where θ begins.
        """
        k = len(self.scale)
        both = np.concatenate([point.features, self.shapes(point)], axis=2)
        scaled, _ = self._scaled(both, point.sigma)
        weight = np.sqrt(self.counts) / point.sigma
        left = (self.residual(point) * weight).reshape(-1)
        hessian, gradient = scaled.T @ scaled, scaled.T @ left
        gradient[:k] -= point.weights
        precision = np.ones(len(hessian))
        if self.expected is not None:
            precision[k:] = self.expected.widths**-2.0
            gradient[k:] += self.expected.step(point.geometry) * precision[k:]
        hessian.flat[:: len(hessian) + 1] += precision
        return hessian, gradient, k

    def _scaled(self, features: Array, sigma: Array) -> tuple[Array, Array]:
        """Return the features (N n, …) and the torque minus that of μ, (N n,), in units of the noise."""
        weight = np.sqrt(self.counts) / sigma
        target = self.tau
        if np.any(self.centre):
            k = len(self.centre)
            target = target - features[:, :, :k] @ (self.centre / self.scale)
        scaled = features * weight[:, :, None]
        return scaled.reshape(-1, features.shape[2]), (target * weight).reshape(-1)


def root_of(precision: Array) -> Array:
    """Return lower L with L Lᵀ = precision.

    A precision is a Gram matrix plus the identity of the prior, so its eigenvalues are at least one. Rounding may make
    some of them negative, if noise is small and features are similar. These are replaced by one.
    Raise LinAlgError for numbers that are not finite.
    """
    lower, failed = lapack.dpotrf(precision, lower=1)
    if not failed and np.isfinite(lower[-1, -1]):
        return np.asarray(lower)
    if not np.isfinite(precision).all():
        raise LinAlgError("the precision of the weights contains a number that is not finite")
    values, vectors = np.linalg.eigh(precision)
    upper = np.asarray(np.linalg.qr((vectors * np.sqrt(np.maximum(values, 1.0))).T, mode="r"))
    return np.ascontiguousarray((upper * np.where(upper.diagonal() < 0, -1.0, 1.0)[:, None]).T)
