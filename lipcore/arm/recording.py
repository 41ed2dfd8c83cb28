"""What a recording holds of an arm: how many independent rows, and how many independent motions."""

from __future__ import annotations

import numpy as np

from lipcore.samples import Array, Samples


def residual_correlation(residual: Array, samples: Samples) -> float:
    """Rows that one independent row stands for, from the residuals (N, n) of samples in order of time: at least 1.

    1 + 2 Σ ρ_k over the lags at which the autocorrelation, averaged over the joints and within episodes, stays above
    its chance level: what a filter has smeared over several rows counts once.
    """
    white = residual / np.maximum(np.sqrt(np.mean(residual**2, axis=0)), 1e-12)
    episodes = [part for part in samples.episodes() if part.stop - part.start > 1]
    longest = max((part.stop - part.start for part in episodes), default=0)
    total = 1.0
    for lag in range(1, longest // 4):
        products = [white[part][lag:] * white[part][:-lag] for part in episodes if part.stop - part.start > lag]
        pairs = sum(map(len, products))
        level = float(np.concatenate(products).mean())
        if level < 2.0 / np.sqrt(pairs * residual.shape[1]):
            break
        total += 2 * level
    return total


def motion_dimensions(dq: Array) -> float:
    """How many joints' worth of independent motion velocities (N, n) hold: 1 where all move together, n where each
    moves by itself.

    The participation ratio (Σ λ)² / Σ λ² of their correlation matrix's eigenvalues.
    """
    spread = dq.std(axis=0)
    moving = spread > 1e-9
    if not moving.any():
        return 0.0
    values = np.linalg.eigvalsh(np.atleast_2d(np.corrcoef(dq[:, moving].T)))
    return float(values.sum() ** 2 / np.square(values).sum())
