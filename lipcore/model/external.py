"""External torque: the residual of a measured torque, and its probability if nothing touches the arm."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lipcore.data.samples import Array
from lipcore.kernels.fast.compile import compiled


@dataclass(frozen=True)
class External:
    """External torque of n joints at N instants, with its tests. It is not a safety function: see docs/safety.md."""

    rows: Array
    """All values below, side by side in this order, (N, 3 n + 2). The last two columns exist only if a covariance
    was given."""

    @property
    def tau(self) -> Array:
        """Measured − predicted torque e, (N, n) N·m (prismatic: N)."""
        return self.rows[:, : self._joints]

    @property
    def std(self) -> Array:
        """Standard deviation s of e if nothing touches the arm, (N, n). Intervals are tau ± 1.96 s."""
        return self.rows[:, self._joints : 2 * self._joints]

    @property
    def z(self) -> Array:
        """Standardised error e / s, (N, n): standard normal if nothing touches the arm."""
        return self.rows[:, 2 * self._joints : 3 * self._joints]

    @property
    def statistic(self) -> Array:
        """T = eᵀ C⁻¹ e of all joints together, (N,). It is at least the max z².

        It is larger if the errors of the joints are correlated in a way that the model does not expect.
        """
        return self.rows[:, -2]

    @property
    def p(self) -> Array:
        """P(χ²_n > T), (N,).

        It applies to one instant alone. Do not multiply it over neighbouring instants: their errors are similar.
        """
        return self.rows[:, -1]

    @property
    def _joints(self) -> int:
        return int(self.rows.shape[1]) // 3


def external(
    tau: Array,
    mean: Array,
    std: Array,
    noise_std: Array,
    scale: Array | None = None,
    covariance: Array | None = None,
) -> External:
    """Return the external torque: e = tau − mean, s = scale · √(std² + noise_std²), z = e / s.

    T = eᵀ C⁻¹ e with C = S (K + Σ) S, S = diag(scale), Σ = diag(noise_std²): the diagonal of C is s².

    tau, mean, std: (N, n), std of the function; noise_std: (n,); scale: (n,), factor on the half width of intervals,
    None for 1; covariance: K, (N, n, n), of the function between the joints; without it, T and p are not computed.
    Values outside the range of numbers become inf or NaN.
    """
    count, n = tau.shape
    scale = np.ones(n) if scale is None else scale
    rows = np.empty((count, 3 * n + (0 if covariance is None else 2)))
    between = np.empty((0, n, n)) if covariance is None else covariance
    # contiguous arrays share one machine code
    tau, mean, std, between = (np.ascontiguousarray(each) for each in (tau, mean, std, between))
    _compare(tau, mean, std, noise_std, scale, between, rows)
    return External(rows)


def warm_up() -> None:
    """Compile the code of `external`, or load it from Numba's cache."""
    external(np.zeros((1, 1)), np.zeros((1, 1)), np.ones((1, 1)), np.ones(1), covariance=np.ones((1, 1, 1)))


@compiled
def _compare(
    tau: Array, mean: Array, std: Array, noise_std: Array, scale: Array, covariance: Array, rows: Array
) -> None:
    """Write `External.rows`. covariance: (N, n, n), or (0, n, n) if it is unknown."""
    count, n = tau.shape
    factor, reduced = np.empty((n, n)), np.empty(n)
    for row in range(count):
        for i in range(n):
            error = tau[row, i] - mean[row, i]
            spread = scale[i] * math.sqrt(std[row, i] ** 2 + noise_std[i] ** 2)
            rows[row, i], rows[row, n + i], rows[row, 2 * n + i] = error, spread, error / spread
        if len(covariance) == 0:
            continue
        statistic = 0.0
        for i in range(n):  # Cholesky factor of K + Σ, and the solution y of L y = S⁻¹ e: T = yᵀ y
            for j in range(i + 1):
                left = covariance[row, i, j] + (noise_std[i] ** 2 if i == j else 0.0)
                for k in range(j):
                    left -= factor[i, k] * factor[j, k]
                factor[i, j] = math.sqrt(left) if i == j else left / factor[j, j]
            value = rows[row, i] / scale[i]
            for k in range(i):
                value -= factor[i, k] * reduced[k]
            reduced[i] = value / factor[i, i]
            statistic += reduced[i] ** 2
        rows[row, 3 * n], rows[row, 3 * n + 1] = statistic, _chi_square_tail(statistic, n)


@compiled
def _chi_square_tail(statistic: float, freedom: int) -> float:
    """Return P(χ² > statistic) for `freedom` degrees of freedom, a finite sum.

    With x half the statistic and n the degrees of freedom: e⁻ˣ Σ xᵏ / k! over k from 0 to n/2 − 1 if n is even,
    erfc(√x) + e⁻ˣ Σ xᵏ⁻¹ᐟ² / Γ(k + ½) over k from 1 to (n − 1)/2 if it is odd.
    """
    half = 0.5 * statistic
    if freedom % 2:
        total, term, following = math.erfc(math.sqrt(half)), 2.0 * math.sqrt(half / math.pi) * math.exp(-half), 1.5
    else:
        total, term, following = 0.0, math.exp(-half), 1.0
    for _ in range(freedom // 2):
        total += term
        term *= half / following
        following += 1.0
    return total
