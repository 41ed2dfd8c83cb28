"""Mean and covariance of the torques at a few queries, from their covariances with the anchors (see `Evaluator`).

The inner loop of every standard deviation is a lower triangular matrix times a few columns. BLAS is made for larger
products: here it reaches half of a core's speed, and it may start threads. So the matrix is stored in panels of ROWS
rows, each column by column up to its diagonal. One loop over Lanes keeps all ROWS × WIDTH sums in registers
(12 of AVX2's 16).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lipcore.kernels.fast.compile import brief, compiled, inlined
from lipcore.kernels.fast.lanes import LANES, spread
from lipcore.kernels.fast.play import deflection_std
from lipcore.kernels.fast.triangles import HEIGHT, multiply_triangle, triangle_size
from lipcore.kernels.fast.views import lay, numbers

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

ROWS = 6
"""Rows of a panel."""
WIDTH = LANES
"""Columns that a panel is multiplied with. A robot with more joints needs several rounds."""


def pack(matrix: Array, before: int, height: int = ROWS) -> Array:
    """Return the panels of `matrix`, (K, M), one after the other, flat. Zeros fill the last panel.

    before: number of columns before those of the diagonal; height: rows of a panel. Elements to the right of each
    panel's last diagonal element are zero and are not stored.
    """
    panels = [np.zeros(0)]
    for first in range(0, matrix.shape[0], height):
        rows = matrix[first : first + height, : before + min(first + height, matrix.shape[0])]
        panel = np.zeros((rows.shape[1], height))
        panel[:, : len(rows)] = rows.T
        panels.append(panel.reshape(-1))
    return np.concatenate(panels)


@inlined
def multiply(panels: Array, panel: int, columns: Array, first: int, count: int, out: Array, at: int) -> None:
    """Write Σ_k panels[panel + ROWS k + r] columns[first + WIDTH k + c], (ROWS, WIDTH) at (r, c), to out[at:].

    k runs from 0 to count − 1. All arrays are flat; count is the number of the panel's columns.
    """
    (x,), (y,) = lay(columns, first, ((count,),))[0], lay(out, at, ((ROWS,),))[0]
    rows = numbers(panels, panel, (count, ROWS))
    a = b = c = d = e = f = spread(0.0)
    for k in range(count):
        factors = x[k]
        a, b, c = a + rows[k, 0] * factors, b + rows[k, 1] * factors, c + rows[k, 2] * factors
        d, e, f = d + rows[k, 3] * factors, e + rows[k, 4] * factors, f + rows[k, 5] * factors
    y[0], y[1], y[2], y[3], y[4], y[5] = a, b, c, d, e, f


def pack_joints(slopes: Array, root: Array, places: list[Indices]) -> Array:
    """Return the means and roots of parts of M variables, one part for each joint, flat.

    slopes: (M,); root: Q, (M, M) lower triangular; places: those of the part among the variables, rising. Each begins
    with the part's slopes.
    """
    parts = [(slopes[each], pack(root_of_part(root, each), 0, HEIGHT)) for each in places]
    return np.concatenate([np.zeros(0), *(each for part in parts for each in part)])


def root_of_part(root: Array, places: Indices) -> Array:
    """Return the lower triangular root, (K, K), of the same squares as Q has on K of its variables.

    root: Q, (M, M) lower triangular; places: (K,), rising.
    """
    rows = np.flatnonzero(root[:, places].any(axis=1))
    if np.isin(rows, places).all():
        return root[np.ix_(places, places)]
    upper = np.asarray(np.linalg.qr(root[np.ix_(rows, places[::-1])], mode="r"))
    lower = np.zeros((len(places),) * 2)
    lower[len(lower) - len(upper) :] = upper[::-1, ::-1]
    return lower


MISFIT_ROWS = 6
"""Rows of a misfit before those of the play elements."""
MEAN, STD, COVARIANCE = range(3)  # how much to compute: each value includes the ones before
FALLBACK_START, FALLBACK_END = 1.0, 3.0
"""Posterior variance of a torque, as a multiple of its training variance, at which the fallback starts and is complete.

Tuned on ten short recordings of seven real arms. A start at 0.25 to 0.75 made more good joints worse, and no more bad
joints harmless.
"""
ACCELERATED = 0.1
"""Weight of a mean square acceleration relative to a mean square speed, if motion exceeds that of the training.

Errors of inertias grow with acceleration, errors of friction with speed. Tuned on simulated arms with `Dirt` (seeds 50
and 51 of `benchmarks/studies/dirty_arms.py`) among 0, 0.02, 0.05, 0.1 and 0.2. In motion three times as fast, 1 to 3 %
of the arms' joints have a coverage below 85 % with it, 6 to 9 % without.
"""


@inlined
def fallback_share(variance: float, usual: float) -> float:
    """Return the share of the fallback, 0 to 1, from the posterior variance and the training variance, (N·m)²."""
    if not variance > FALLBACK_START * usual:  # without variation of the torque, `usual` is zero
        return 0.0
    return min((variance - FALLBACK_START * usual) / ((FALLBACK_END - FALLBACK_START) * usual), 1.0)


@compiled
def answer(
    fixed: Array,
    outputs: Indices,
    places: Indices,
    counts: Indices,
    blocks: Array,
    features: Array,
    beyond: Array,
    std_factor: float,
    floor: Array,
    misfit: Array,
    arms: Indices,
    sign_width: float,
    usual: Array,
    motions: Array,
    what: int,
    memory: Array,
    tau: Array,
    std: Array,
    covariance: Array,
    share: Array,
) -> bool:
    """Write the torques of N queries and, depending on `what`, their uncertainty.

    Return whether any `share` is above zero.

    - fixed: the panel of the mean, the panels of the root's rows that are subtracted, one for each output, and the
      panels of the rows that are added, one for each linear weight; then, if `counts` is not empty, what
      `pack_joints` returns;
    - places, counts: (n, most) and (n,), see `pack_joints`, or empty;
    - blocks: (N, S + 1, n, n), from `Cross`;
    - features: (N, P, n), Φᵀ;
    - beyond: (N, n), variance of a torque that the anchors do not change; no reason for the fallback;
    - floor: (n,), min variance, at least 0;
    - misfit: (6 + 2 K, n), see `Misfit.packed`: variance at rest, the speed at which it has decayed to exp(−1),
      variance of faster motion, the usual speed and acceleration, variance at standstill, torque and widths of the play
      elements;
    - arms: (n,), index of each joint's arm, whose motion may be faster;
    - sign_width: speed at which the variance at standstill has decayed to exp(−1);
    - usual: (n,), training variance of the torque, infinite if unknown;
    - motions: (N, …, n), of which dq, ddq and the deflections are read;
    - tau, std: (N, n);
    - covariance: (N, n, n), work memory unless requested;
    - share: (N, n), of the fallback, see `fallback_share`; not written for MEAN.
    """
    queries, n = tau.shape
    chosen, linear = outputs.shape[0], features.shape[1]
    size, groups = chosen + linear, (n + WIDTH - 1) // WIDTH
    step = groups * size * WIDTH
    products = queries * step
    full, alone = what == COVARIANCE, counts.shape[0] > 0
    if alone:
        _torques(fixed, places, counts, features, tau)
    if full or not alone:
        for query in range(queries):
            _gather(blocks[query].reshape(-1), outputs, features[query], n, query * step, memory)
    for query in range(0 if alone else queries):
        for group in range(groups):
            multiply(fixed, 0, memory, query * step + group * size * WIDTH, size, memory, products)
            for j in range(min(WIDTH, n - group * WIDTH)):
                tau[query, group * WIDTH + j] = memory[products + j]
    if what == MEAN:
        return False

    any_share = False
    if full or not alone:
        for query in range(queries):
            _begin(blocks[query, -1], full, covariance[query])
        panel = _add_panels(fixed, ROWS * size, 0, chosen, size, memory, full, covariance)
        for query in range(queries):
            _scale(-1.0, full, covariance[query])
        _add_panels(fixed, panel, chosen, size, size, memory, full, covariance)
    if alone:
        _variances(fixed, places, counts, features, memory, covariance)
    for query in range(queries):
        _scale(std_factor * std_factor, full, covariance[query])
        faster = 0.0
        for j in range(n):
            if j == 0 or arms[j] != arms[j - 1]:
                faster = _faster(misfit, motions[query], arms, arms[j])
            share[query, j] = fallback_share(covariance[query, j, j], usual[j])
            any_share |= share[query, j] > 0.0
            more = misfit[0, j] * np.exp(-((motions[query, 1, j] / misfit[1, j]) ** 2)) + misfit[2, j] * faster
            more += misfit[5, j] * np.exp(-((motions[query, 1, j] / sign_width) ** 2))
            more += _of_elements(misfit, motions[query], j) + beyond[query, j]
            covariance[query, j, j] = max(covariance[query, j, j] + more, floor[j])
            std[query, j] = np.sqrt(covariance[query, j, j])
    return any_share


@inlined
def _faster(misfit: Array, motion: Array, arms: Indices, arm: int) -> float:
    """Return by how much an arm's motion exceeds that of the training, see `Misfit`."""
    speed, acceleration, joints = 0.0, 0.0, 0
    for j in range(misfit.shape[1]):
        if arms[j] == arm:
            speed += (motion[1, j] / misfit[3, j]) ** 2
            acceleration += (motion[2, j] / misfit[4, j]) ** 2
            joints += 1
    return max(speed / joints - 1.0, 0.0) + ACCELERATED * max(acceleration / joints - 1.0, 0.0)


@inlined
def _of_elements(misfit: Array, motion: Array, joint: int) -> float:
    """Return the variance of the play elements' unknown deflections at a joint."""
    count = (misfit.shape[0] - MISFIT_ROWS) // 2
    torque = 0.0
    for k in range(count):
        width = misfit[MISFIT_ROWS + count + k, joint]
        torque += misfit[MISFIT_ROWS + k, joint] * deflection_std(motion, joint, k, count, width, misfit[4, joint])
    return torque * torque


@compiled
def _torques(fixed: Array, places: Indices, counts: Indices, features: Array, tau: Array) -> None:
    """Write the torques of N queries joint by joint, (N, n). `fixed` ends with the joints' `pack_joints`."""
    queries, n = tau.shape
    at = _first_joint(fixed, counts)
    for j in range(n):
        for query in range(queries):
            torque = 0.0
            for k in range(counts[j]):
                torque += fixed[at + k] * features[query, places[j, k], j]
            tau[query, j] = torque
        at += counts[j] + triangle_size(counts[j])


@compiled
def _variances(
    fixed: Array, places: Indices, counts: Indices, features: Array, memory: Array, covariance: Array
) -> None:
    """Write the variances of N queries' torques on the diagonals of (N, n, n), joint by joint; see `_torques`."""
    queries, n = covariance.shape[:2]
    at, learnt = _first_joint(fixed, counts), np.empty(places.shape[1] + HEIGHT)
    for j in range(n):
        count = counts[j]
        for query in range(queries):
            for k in range(count):
                memory[k] = features[query, places[j, k], j]
            multiply_triangle(fixed, at + count, memory, count, learnt)
            left = 0.0
            for k in range(count):
                left += learnt[k] * learnt[k]
            covariance[query, j, j] = left
        at += count + triangle_size(count)


@inlined
def _first_joint(fixed: Array, counts: Indices) -> int:
    """Return where the parts of all joints begin."""
    at = fixed.shape[0]
    for count in counts:
        at -= count + triangle_size(count)
    return at


@brief
def answer_one(
    fixed: Array,
    outputs: Indices,
    places: Indices,
    counts: Indices,
    blocks: Array,
    features: Array,
    beyond: Array,
    std_factor: float,
    floor: Array,
    misfit: Array,
    arms: Indices,
    sign_width: float,
    usual: Array,
    motions: Array,
    what: int,
    memory: Array,
    tau: Array,
    std: Array,
    covariance: Array,
    share: Array,
) -> bool:
    """Write the torque of one query; see `answer`."""
    return answer(
        fixed,
        outputs,
        places,
        counts,
        blocks,
        features,
        beyond,
        std_factor,
        floor,
        misfit,
        arms,
        sign_width,
        usual,
        motions,
        what,
        memory,
        tau,
        std,
        covariance,
        share,
    )


@compiled
def _gather(rows: Array, outputs: Indices, features: Array, n: int, at: int, memory: Array) -> None:
    """Write the covariances of the query's torques with all anchors, (groups, M, WIDTH).

    Columns past the last are never read.
    """
    chosen, linear = outputs.shape[0], features.shape[0]
    for group in range(0, n, WIDTH):
        count = min(WIDTH, n - group)
        for row in range(chosen):
            for j in range(count):
                memory[at + j] = rows[outputs[row] * n + group + j]
            at += WIDTH
        for row in range(linear):
            for j in range(count):
                memory[at + j] = features[row, group + j]
            at += WIDTH


@compiled
def _begin(prior: Array, full: bool, out: Array) -> None:
    """Write the negative covariance of the nonlinear term, (n, n), or only its diagonal unless `full`."""
    out[:] = 0.0
    for i in range(prior.shape[0]):
        for j in range(0 if full else i, i + 1):
            out[i, j] = -prior[i, j]


@compiled
def _add_panels(
    fixed: Array, panel: int, first: int, last: int, size: int, memory: Array, full: bool, out: Array
) -> int:
    """Add the squares of the root's rows times the columns in memory to the covariances of N queries, (N, n, n).

    The rows are `first` to before `last`; their panels begin at `panel`. Return where the next panel begins.
    """
    queries, groups = out.shape[0], (out.shape[1] + WIDTH - 1) // WIDTH
    step = groups * size * WIDTH
    products = queries * step
    for row in range(first, last, ROWS):  # all queries use a panel while it is in the cache
        reach = min(row + ROWS, last)
        for query in range(queries):
            for group in range(groups):
                columns = query * step + group * size * WIDTH
                multiply(fixed, panel, memory, columns, reach, memory, products + group * ROWS * WIDTH)
            _add_squares(memory, products, full, out[query])
        panel += ROWS * reach
    return panel


@compiled
def _add_squares(memory: Array, products: int, full: bool, out: Array) -> None:
    """Add Vᵀ V of one panel's products V, (groups, ROWS, WIDTH), or only its diagonal unless `full`."""
    for i in range(out.shape[0]):
        left = products + (i // WIDTH) * ROWS * WIDTH + i % WIDTH
        for r in range(ROWS):
            out[i, i] += memory[left + r * WIDTH] * memory[left + r * WIDTH]
        if full:
            for j in range(i):
                right = products + (j // WIDTH) * ROWS * WIDTH + j % WIDTH
                for r in range(ROWS):
                    out[i, j] += memory[left + r * WIDTH] * memory[right + r * WIDTH]


@compiled
def _scale(factor: float, full: bool, out: Array) -> None:
    """Multiply the lower triangle by a factor and mirror it, or only the diagonal unless `full`."""
    for i in range(out.shape[0]):
        for j in range(0 if full else i, i + 1):
            out[i, j] = out[j, i] = factor * out[i, j]
