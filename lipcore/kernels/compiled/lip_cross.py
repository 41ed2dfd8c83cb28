"""The LIP kernel between one query and the inducing samples, and the query and itself (see `lip`).

The query is the kernel's first argument, the inducing samples are its columns; the query also takes the column after
the last of them. All that a call works on lies in one flat array.
"""

from __future__ import annotations

import numpy as np

from lipcore.kernels.compiled.compile import compiled
from lipcore.kernels.compiled.cross import Cross, symmetrise
from lipcore.kernels.compiled.lip import changed_links
from lipcore.kernels.compiled.lip_data import DF, DG, PAIRS, A, Array, F, Flags, G, Scratch, V, features
from lipcore.kernels.compiled.lip_energies import add_kinetic, kinetic, potential
from lipcore.kernels.compiled.views import Memory, cube, plane


class LipCross(Cross):
    """`Cross` of the LIP kernel.

    q, v, a: (S, n) of the inducing samples; prismatic: (n,); kinetic_shares, weights, potential_shares and
    potential_scale as of `lip_gram`.
    """

    def __init__(
        self,
        q: Array,
        v: Array,
        a: Array,
        prismatic: Flags,
        kinetic_shares: Array,
        weights: Array,
        potential_shares: Array,
        potential_scale: float,
    ) -> None:
        self.size, self.n_joints = size, n = q.shape
        self._flags = np.concatenate([prismatic, changed_links(kinetic_shares)])
        blocks = size // PAIRS + 1
        columns = np.zeros((blocks * PAIRS, 6, n))
        columns[:size] = features(q, v, a, prismatic)
        columns = columns.reshape(blocks, PAIRS, 6, n).transpose(0, 2, 3, 1)
        work = 6 * n + PAIRS * (13 * n + 2 * n * n + 2 * n * (n + 1) + 2 * (n + 1) + 9)
        fixed = [columns, kinetic_shares, weights, potential_shares, np.array([potential_scale])]
        self._memory = Memory(fixed, work)

    def fill(self, motion: Array, out: Array) -> None:
        """Write the covariances of one query."""
        self.fill_many(motion[None], out[None])

    def fill_many(self, motions: Array, out: Array) -> None:
        """Write the covariances of N queries."""
        _cross(self._memory.flat, self._flags, motions, out)


@compiled
def _cross(m: Array, flags: Flags, motions: Array, out: Array) -> None:
    """motions: (N, 3, n); out: (N, S + 1, n, n)."""
    size, n = out.shape[1] - 1, out.shape[2]
    prismatic, changed = flags[:n], flags[n:]
    blocks, step = size // PAIRS + 1, 6 * n * PAIRS
    at = blocks * step
    kinetic_shares, weights = cube(m, at, n, n, 3), plane(m, at + 3 * n * n, n, n)
    potential_shares, scale = plane(m, at + 4 * n * n, n, 3), m[at + 4 * n * n + 3 * n]
    at += 4 * n * n + 3 * n + 1
    x, at = plane(m, at, 6, n), at + 6 * n
    for query in range(motions.shape[0]):
        _load(motions[query], prismatic, x)
        last = cube(m, (blocks - 1) * step, 6, n, PAIRS)
        for c in range(6):
            for b in range(n):
                last[c, b, size % PAIRS] = x[c, b]
        for block in range(blocks):
            s = _scratch(m, block * step, at, n)
            start = block * PAIRS
            width = min(PAIRS, size + 1 - start)
            potential(potential_shares, prismatic, x, n, width, s)
            for i in range(n):
                for j in range(n):
                    for k in range(width):
                        s.total[i, j, k] = scale * s.mixed[i, j, k]
            for link in range(n - 1, -1, -1):
                kinetic(kinetic_shares[link], prismatic, weights[link], x, link + 1, width, changed[link], s)
                add_kinetic(weights[link], x, link + 1, width, s)
            # transposed: the rows of `out` are the torques at the inducing samples
            for k in range(width):
                for j in range(n):
                    for i in range(n):
                        out[query, start + k, j, i] = s.total[i, j, k]
        symmetrise(out[query, size])


@compiled
def _load(motion: Array, prismatic: Flags, x: Array) -> None:
    """As `lip_data.features`, of one sample: (6, n)."""
    for b in range(prismatic.shape[0]):
        q, straight = motion[0, b], prismatic[b]
        cos, sin = np.cos(q), np.sin(q)
        x[F, b] = q if straight else cos
        x[G, b] = 0.0 if straight else sin
        x[DF, b] = 1.0 if straight else -sin
        x[DG, b] = 0.0 if straight else cos
        x[V, b] = motion[1, b]
        x[A, b] = motion[2, b]


@compiled
def _scratch(m: Array, block: int, at: int, n: int) -> Scratch:
    """As `lip_data.scratch`, with the columns from element `block` of `m` on and all else from `at` on."""
    row = n * PAIRS
    squares = at + 13 * row
    prefixes = squares + 2 * n * row
    rest = prefixes + 2 * (n + 1) * row
    return Scratch(
        cube(m, block, 6, n, PAIRS),
        cube(m, at, n, 4, PAIRS),
        cube(m, at + 4 * row, n, 4, PAIRS),
        plane(m, rest, n + 1, PAIRS),
        plane(m, rest + row + PAIRS, n + 1, PAIRS),
        cube(m, prefixes, n + 1, n, PAIRS),
        cube(m, prefixes + (n + 1) * row, n + 1, n, PAIRS),
        cube(m, squares, n, n, PAIRS),
        plane(m, rest + 2 * row + 2 * PAIRS, 9, PAIRS),
        plane(m, at + 8 * row, n, PAIRS),
        plane(m, at + 9 * row, n, PAIRS),
        plane(m, at + 10 * row, n, PAIRS),
        plane(m, at + 11 * row, n, PAIRS),
        plane(m, at + 12 * row, n, PAIRS),
        cube(m, squares + n * row, n, n, PAIRS),
    )
