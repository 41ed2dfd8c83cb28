"""Compiled likelihood of samples, each given its neighbours, for a Gaussian process with its own lengthscales.

It is the approximation of Vecchia (1988): log p(y) = Σ log p(y_i | y_j for j in N(i)), with few neighbours N(i) among
the samples before i in some order. Its cost grows with the samples and not with their cube.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lipcore.kernels.fast.compile import compiled, inlined
from lipcore.kernels.fast.joints import Array

Indices = NDArray[np.int64]


@compiled
def likelihood_given_neighbours(
    inputs: Array, values: Array, weights: Array, rows: Indices, neighbours: Indices, logs: Array, gradient: Array
) -> float:
    """Return −Σ w_i log p(y_i | y_N(i)), without its constant, and write its gradient by `logs`, (D + 2,).

    y_i = g(x_i) + e_i with the covariance s² exp(−½ Σ_d (x_d − x'_d)² / ℓ_d²) of g, and the variance r / w_i of e_i.

    inputs: (N, D); values: y, (N,); weights: w, (N,), from above 0 to 1; rows: i, (B,); neighbours: (B, K), −1 where
    there are fewer; logs: log ℓ_d, then log s² and log r. With C the covariance of the neighbours' y, k theirs with
    y_i, a = C⁻¹ k, b = C⁻¹ y_N, e = y_i − aᵀ y_N and v = s² + r − aᵀ k, a term is ½ log v + ½ e² / v. Its change is
    (½ / v − ½ e² / v²) (dv) + (e / v) (de) with dv = d(s² + r) − 2 aᵀ dk + aᵀ dC a and de = −bᵀ dk + aᵀ dC b.
    """
    size, most = inputs.shape[1], neighbours.shape[1]
    rates, scale, noise = np.exp(-logs[:size]), math.exp(logs[size]), math.exp(logs[size + 1])
    scaled = np.empty((most + 1, size))
    root, gram = np.empty((most, most)), np.empty((most + 1, most + 1))
    a, b = np.empty(most), np.empty(most)
    gradient[:] = 0.0
    total = 0.0
    for row in range(rows.shape[0]):
        here, count = rows[row], 0
        while count < most and neighbours[row, count] >= 0:
            count += 1
        _compare(inputs, here, neighbours[row, :count], rates, scale, scaled, gram)
        for p in range(count):  # Cholesky factor of C, and both solutions forwards
            for q in range(p):
                left = gram[p, q]
                for k in range(q):
                    left -= root[p, k] * root[q, k]
                root[p, q] = left / root[q, q]
            left = scale + noise / weights[neighbours[row, p]]
            a[p], b[p] = gram[count, p], values[neighbours[row, p]]
            for k in range(p):
                left -= root[p, k] ** 2
                a[p] -= root[p, k] * a[k]
                b[p] -= root[p, k] * b[k]
            root[p, p] = np.sqrt(max(left, 1e-12 * scale))
            a[p] /= root[p, p]
            b[p] /= root[p, p]
        variance, error = scale + noise, values[here]
        for p in range(count):
            variance -= a[p] * a[p]
            error -= a[p] * b[p]
        for p in range(count - 1, -1, -1):
            for k in range(p + 1, count):
                a[p] -= root[k, p] * a[k]
                b[p] -= root[k, p] * b[k]
            a[p] /= root[p, p]
            b[p] /= root[p, p]
        variance = max(variance, 1e-9 * scale)
        weight = weights[here]
        total += 0.5 * weight * (np.log(variance) + error * error / variance)
        by_variance = 0.5 * weight * (1 / variance - (error / variance) ** 2)
        by_error = weight * error / variance
        by_scale, by_noise = by_variance * scale, by_variance * noise
        for p in range(count):
            own = a[p] * (by_variance * a[p] + by_error * b[p])
            by_scale += own * scale
            by_noise += own * noise / weights[neighbours[row, p]]
            change = -(2 * by_variance * a[p] + by_error * b[p]) * gram[count, p]
            by_scale += change
            for d in range(size):
                gradient[d] += change * (scaled[count, d] - scaled[p, d]) ** 2
            for q in range(p):
                change = (2 * by_variance * a[p] * a[q] + by_error * (a[p] * b[q] + b[p] * a[q])) * gram[p, q]
                by_scale += change
                for d in range(size):
                    gradient[d] += change * (scaled[p, d] - scaled[q, d]) ** 2
        gradient[size] += by_scale
        gradient[size + 1] += by_noise
    return total


@inlined
def _compare(inputs: Array, here: int, others: Indices, rates: Array, scale: float, scaled: Array, gram: Array) -> None:
    """Write x_d / ℓ_d and the covariances of all pairs of the others and, last, of `here` with them."""
    count, size = others.shape[0], inputs.shape[1]
    for p in range(count + 1):
        one = here if p == count else others[p]
        for d in range(size):
            scaled[p, d] = inputs[one, d] * rates[d]
        for q in range(p):
            distance = 0.0
            for d in range(size):
                distance += (scaled[p, d] - scaled[q, d]) ** 2
            gram[p, q] = scale * np.exp(-0.5 * distance)
