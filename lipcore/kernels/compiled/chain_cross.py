"""The serial-chain kernel between one query and the inducing samples, and the query and itself (see `chain`).

The query is the kernel's first argument, the inducing samples are its columns; the query also takes the column after
the last of them. All that a call works on lies in one flat array.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lipcore.kernels.compiled.chain import forward
from lipcore.kernels.compiled.chain_blocks import kinetic_blocks
from lipcore.kernels.compiled.chain_data import (
    LANES,
    Array,
    Four,
    Hyper,
    Potential,
    Samples,
    Sums,
    Terms,
    Work,
    columns,
    samples,
)
from lipcore.kernels.compiled.compile import compiled, inlined
from lipcore.kernels.compiled.cross import Cross, symmetrise
from lipcore.kernels.compiled.views import Memory, cube, plane


class ChainCross(Cross):
    """`Cross` of the serial-chain kernel.

    q, v, a: (S, n) of the inducing samples; prismatic: (n,); alpha: (n,), weights: (n, n) and scales: (n,) as of
    `chain_gram`.
    """

    def __init__(
        self, q: Array, v: Array, a: Array, prismatic: NDArray[np.bool_], alpha: Array, weights: Array, scales: Array
    ) -> None:
        self.size, self.n_joints = q.shape
        self._prismatic = prismatic
        inducing = samples(q, v, a, prismatic)
        one_more = Samples(*(np.concatenate([part, np.zeros((1, self.n_joints))]) for part in inducing))
        self._memory = Memory([*columns(one_more), alpha, weights, scales], _work_size(self.n_joints))

    def fill(self, motion: Array, out: Array) -> None:
        """Write the covariances of one query."""
        self.fill_many(motion[None], out[None])

    def fill_many(self, motions: Array, out: Array) -> None:
        """Write the covariances of N queries."""
        _cross(self._memory.flat, self._prismatic, motions, out)


def _work_size(n: int) -> int:
    """Numbers of the query's row, and of `_work`: vectors, square matrices, and the four of n + 1 columns."""
    return 6 * n + LANES * (22 * n + 12 * n * n + 4 * n * (n + 1))


@compiled
def _cross(memory: Array, prismatic: NDArray[np.bool_], motions: Array, out: Array) -> None:
    """motions: (N, 3, n); out: (N, S + 1, n, n)."""
    size, n = out.shape[1] - 1, out.shape[2]
    y, hyper, x, at = _arguments(memory, n, size // LANES + 1)
    work = _work(memory, at, n)
    for query in range(motions.shape[0]):
        _load(motions[query], prismatic, x, y, size)
        for block in range(y.v.shape[0]):
            forward(x, 0, y, block, hyper, work)
            kinetic_blocks(hyper.weights, x.v[0], x.a[0], y.v[block], y.a[block], work)
            start = block * LANES
            _write(work.kinetic, work.potential.block, start, min(LANES, size + 1 - start), out[query])
        symmetrise(out[query, size])


@compiled
def _arguments(memory: Array, n: int, blocks: int) -> tuple[Samples, Hyper, Samples, int]:
    """Columns, hyperparameters and the query's row, and where the work begins."""
    m, c = memory, blocks * n * LANES
    y = Samples(
        cube(m, 0, blocks, n, LANES),
        cube(m, c, blocks, n, LANES),
        cube(m, 2 * c, blocks, n, LANES),
        cube(m, 3 * c, blocks, n, LANES),
        cube(m, 4 * c, blocks, n, LANES),
        cube(m, 5 * c, blocks, n, LANES),
    )
    at = 6 * c
    hyper = Hyper(m[at : at + n], plane(m, at + n, n, n), m[at + n + n * n : at + 2 * n + n * n])
    at += 2 * n + n * n
    x = Samples(
        plane(m, at, 1, n),
        plane(m, at + n, 1, n),
        plane(m, at + 2 * n, 1, n),
        plane(m, at + 3 * n, 1, n),
        plane(m, at + 4 * n, 1, n),
        plane(m, at + 5 * n, 1, n),
    )
    return y, hyper, x, at + 6 * n


@compiled
def _work(m: Array, at: int, n: int) -> Work:
    """As `chain_data.workspace`."""
    vector, matrix, wide = LANES * n, LANES * n * n, LANES * n * (n + 1)
    vectors, matrices = at + 4 * wide, at + 4 * wide + 22 * vector
    return Work(
        unit=_vectors(m, vectors, n),
        base=_vectors(m, vectors + 4 * vector, n),
        jet=_vectors(m, vectors + 8 * vector, n),
        sums=Sums(
            r=_matrices(m, matrices, n, n),
            b=_matrices(m, at, n, n + 1),
            s=_matrices(m, matrices + 4 * matrix, n, n),
            c=cube(m, matrices + 8 * matrix, n, n, LANES),
        ),
        terms=Terms(e=_vectors(m, vectors + 12 * vector, n), f=_vectors(m, vectors + 16 * vector, n)),
        kinetic=cube(m, matrices + 9 * matrix, n, n, LANES),
        potential=Potential(
            before=plane(m, vectors + 20 * vector, n, LANES),
            after=plane(m, vectors + 21 * vector, n, LANES),
            between=cube(m, matrices + 10 * matrix, n, n, LANES),
            block=cube(m, matrices + 11 * matrix, n, n, LANES),
        ),
    )


@compiled
def _vectors(m: Array, at: int, n: int) -> Four:
    step = LANES * n
    return (
        plane(m, at, n, LANES),
        plane(m, at + step, n, LANES),
        plane(m, at + 2 * step, n, LANES),
        plane(m, at + 3 * step, n, LANES),
    )


@compiled
def _matrices(m: Array, at: int, rows: int, columns: int) -> Four:
    step = LANES * rows * columns
    return (
        cube(m, at, rows, columns, LANES),
        cube(m, at + step, rows, columns, LANES),
        cube(m, at + 2 * step, rows, columns, LANES),
        cube(m, at + 3 * step, rows, columns, LANES),
    )


@compiled
def _load(motion: Array, prismatic: NDArray[np.bool_], x: Samples, y: Samples, column: int) -> None:
    """The query as the row and as one of the columns; as `chain_data.samples`."""
    block, lane = column // LANES, column % LANES
    for b in range(prismatic.shape[0]):
        q = motion[0, b]
        cos, sin = np.cos(q), np.sin(q)
        x.x1[0, b] = q if prismatic[b] else cos
        x.x2[0, b] = 0.0 if prismatic[b] else sin
        x.d1[0, b] = 1.0 if prismatic[b] else -sin
        x.d2[0, b] = 0.0 if prismatic[b] else cos
        x.v[0, b] = motion[1, b]
        x.a[0, b] = motion[2, b]
        y.x1[block, b, lane] = x.x1[0, b]
        y.x2[block, b, lane] = x.x2[0, b]
        y.d1[block, b, lane] = x.d1[0, b]
        y.d2[block, b, lane] = x.d2[0, b]
        y.v[block, b, lane] = x.v[0, b]
        y.a[block, b, lane] = x.a[0, b]


@inlined
def _write(kinetic: Array, potential: Array, start: int, width: int, out: Array) -> None:
    """Transposed: the rows of `out` are the torques at the inducing samples."""
    n = kinetic.shape[0]
    for lane in range(width):
        for j in range(n):
            for i in range(n):
                out[start + lane, j, i] = 2 * kinetic[i, j, lane] + potential[i, j, lane]
