"""Which torques to stand for all: pivoted Cholesky of a Gram matrix, with a preference for few samples."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

PREFERENCE = 10.0
"""An output of a sample that is chosen already is taken as long as its residual is at least a tenth of the largest.

All outputs of a sample cost a query little more than one. On a 500-sample simulated Panda, 350 outputs then lie in 51
samples instead of 240, and deviate from the exact posterior no more.
"""
ROUNDING = 1e-13
"""Residuals below this share of the largest variance are rounding."""


@dataclass(frozen=True)
class Pivots:
    """Outputs in the order chosen, (m,), and the columns of L that belong to them, (M, m), for all M outputs.

    residual: (m,), largest variance that the outputs chosen before each step leave unexplained.
    """

    outputs: Tensor
    lower: Tensor
    residual: Tensor

    def __len__(self) -> int:
        return len(self.outputs)


def pivots(gram: Tensor, per_sample: int, most: int, residual: float) -> Pivots:
    """Choose at most `most` outputs until no residual variance exceeds `residual`.

    gram: (M, M), outputs sample by sample, `per_sample` a sample; it is read column by column and not changed.
    """
    size = len(gram)
    lower = torch.zeros((min(most, size), size), dtype=gram.dtype)  # rows are contiguous: L transposed
    left = gram.diagonal().clone()
    stop = max(residual, ROUNDING * float(left.max()))
    handicap = torch.full((size,), 1 / PREFERENCE, dtype=gram.dtype)
    chosen: list[int] = []
    residuals: list[float] = []
    while len(chosen) < len(lower) and float(left.max()) > stop:
        pivot, step = int((left * handicap).argmax()), len(chosen)
        row = (gram[pivot] - lower[:step, pivot] @ lower[:step]) / left[pivot].sqrt()
        lower[step] = row
        residuals.append(float(left.max()))
        chosen.append(pivot)
        left = (left - row.square()).clamp_min(0.0)
        left[pivot] = 0.0
        sample = pivot // per_sample
        handicap[sample * per_sample : (sample + 1) * per_sample] = 1.0
    order = torch.tensor(chosen, dtype=torch.int64)
    return Pivots(order, lower[: len(chosen)].T, torch.tensor(residuals, dtype=gram.dtype))
