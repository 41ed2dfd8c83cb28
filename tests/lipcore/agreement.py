"""How far closed forms of energy kernels are from automatic differentiation of the energies they stand for."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from lipcore.kernels.base import State
from tests.lipcore.oracles import energy_torque, instant, scale_of, torque_terms
from tests.lipcore.problems import Problem

RELATIVE = 1e-10
"""Error admitted, relative to `scale_of` the terms."""
PAIRS = ((0, 0), (0, 1))


def worst_block_error(problem: Problem, pairs: Sequence[tuple[int, int]] = PAIRS) -> float:
    """Largest error of the torques' covariance over pairs of samples, relative to `scale_of` their terms."""
    motion, energies = problem.motion, problem.energies()
    blocks = problem.kernel.blocks(problem.params, State.rows(motion), State.columns(motion))
    worst = 0.0
    for i, j in pairs:
        x, y = instant(motion, i), instant(motion, j)
        terms = torque_terms(energies, x, y)
        error = float((blocks[:, :, i, j] - terms.sum(0)).abs().max())
        worst = max(worst, error / scale_of(energies, x, y, terms))
    return worst


def worst_energy_error(problem: Problem, pairs: Sequence[tuple[int, int]] = PAIRS) -> float:
    """The same for the covariances of kinetic and potential energy with the torques and with themselves."""
    kernel, motion, energies = problem.kernel, problem.motion, problem.energies()
    rows, columns = State.rows(motion), State.columns(motion)
    torques = kernel.energies(problem.params, rows, columns)
    values = kernel.energy_covariance(problem.params, rows, columns)
    worst = 0.0
    for i, j in pairs:
        x, y = instant(motion, i), instant(motion, j)
        terms = energy_torque(energies, x, y)
        alone = torch.stack([energy.kernel(*x[:2], *y[:2]) for energy in energies])
        scale = scale_of(energies, x, y, terms)
        for found, each in ((torques, terms), (values, alone)):
            expected = torch.stack([each[1:].sum(0), each[0]])
            worst = max(worst, float((found[..., i, j] - expected).abs().max()) / scale)
    return worst


def opposite(kind: str, share: Sequence[float], q: float) -> float:
    """The position q' at which the base kernel p(q, q') of shares (σ, α, β) is zero."""
    sigma, alpha, beta = share
    if kind == "prismatic":
        return -(sigma + beta) / (alpha * q)
    cosine, sine = alpha * math.cos(q), beta * math.sin(q)
    return math.atan2(sine, cosine) + math.acos(-sigma / math.hypot(cosine, sine))
