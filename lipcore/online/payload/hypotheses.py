"""Weigh by evidence what has happened to an arm: nothing, a payload picked up or put down, a contact, changed friction.

Rows are averaged in cells of 50 ms. Torque is linear in the unknowns, so only white noise is lost. For the last cells,
before and after an instant, the residual r has the covariance

    C = Φ Σ Φᵀ + errors that are similar in similar motion + white noise,

and a hypothesis adds Y c in the cells after the instant, c ~ N(0, P). Its evidence over that of nothing is

    ½ vᵀ M⁻¹ v − ½ log det M,    M = 1 + P^½ Yᵀ C⁻¹ Y P^½,    v = P^½ Yᵀ C⁻¹ r.

Errors of the arm's model occur on both sides of the instant and cancel: this reveals small payloads on a dirty arm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.linalg import solve_triangular

from lipcore.data.motion import Motion
from lipcore.data.samples import Array
from lipcore.kernels.drive.terms import SIGN_WIDTH
from lipcore.model.payload import LinearisedCarrier
from lipcore.online.batch import Rows
from lipcore.online.payload.bodies import ANY_PAYLOAD, CONTACT_SCALES, UNIT_BODY, evidence, most_likely, typical_torque
from lipcore.online.payload.errors import likeness, noise_parts
from lipcore.robots.urdf import PARAMETERS

Kind = Literal["payload", "contact", "friction"]


@dataclass(frozen=True)
class CellWindowOptions:
    """Cells that are compared, and scales of possible events."""

    cell_s: float = 0.05
    like: tuple[float, float] = (1.0, 0.5)
    rest_s: float = 0.3
    """Scales of errors that change with motion, see `errors.likeness`, and of stiction at rest. Tuned on the dirty
    Panda of seed 50: with those of `errors`, 0.5 kg are not noticed; with twice these, fast motion looks like a
    payload."""
    min_leap: float = 6.0
    """Min jump of the residual from row to row that shows an event, in standard deviations of the noise."""
    before: int = 6
    min_before: int = 4
    """Max and min number of cells before the instant."""
    after: tuple[int, ...] = (1, 2, 3, 4, 5, 6)
    """Numbers of cells after the instant."""
    masses: tuple[float, ...] = (0.5, 1.5, 5.0)
    """Scales of a payload's mass, kg; first moment and inertia are those of `bodies.UNIT_BODY`."""
    frictions: tuple[float, ...] = (0.1, 0.3)
    """Scales of a change of friction, in units of `bodies.typical_torque`."""

    @property
    def cells(self) -> int:
        """Return the number of cells that are compared together."""
        return self.before + self.after[-1]


WINDOW = CellWindowOptions()


@dataclass(frozen=True, eq=False)
class Cell:
    """Means over the rows of a short time."""

    end: float
    """Event time of its last row, s."""
    q: Array
    """Mean position, (n,)."""
    dq: Array
    """Mean velocity, (n,)."""
    residual: Array
    """Mean residual, (n,) N·m."""
    new: Array
    """Variance of the residual of this cell alone, (n,)."""
    lasting: Array
    """Variance shared with cells of similar motion, (n,)."""
    rest: Array
    """Variance shared with neighbouring cells, (n,)."""
    features: Array
    """Mean features, (M + K + 10, n), see `LinearisedCarrier.all_rows`."""


def split_cells(around: LinearisedCarrier, parts: Sequence[Rows]) -> tuple[list[Rows], tuple[Cell, ...]]:
    """Split parts of rows where the residual jumps; return the parts and their cells.

    A payload is picked up between two rows, and a mean over both sides fits neither.
    """
    rows = _joined(parts)
    features, expected = around.all_rows(rows.motion())
    white, lasting, rest = noise_parts(around.carrier, rows.motion())
    usual = np.sqrt(2 * white + (lasting + rest)[1:])
    leaps = (np.abs(np.diff(rows.tau - expected, axis=0)) > WINDOW.min_leap * usual).any(axis=1)
    ends = np.cumsum([len(each) for each in parts])[:-1]
    edges = np.union1d(ends, np.flatnonzero(leaps) + 1)
    parts = [rows.take(each) for each in np.split(np.arange(len(rows)), edges)]
    return parts, _means(around, parts, rows, features, expected)


def cells_of(around: LinearisedCarrier, parts: Sequence[Rows]) -> tuple[Cell, ...]:
    """Return the cells of parts of rows, linearised around an arm with a payload or without."""
    rows = _joined(parts)
    return _means(around, parts, rows, *around.all_rows(rows.motion()))


def _joined(parts: Sequence[Rows]) -> Rows:
    return parts[0] if len(parts) == 1 else Rows.concatenate(parts)


def _means(
    around: LinearisedCarrier, parts: Sequence[Rows], rows: Rows, features: Array, expected: Array
) -> tuple[Cell, ...]:
    """Return the cells of parts, which together are `rows`.

    features, expected: of each row, see `LinearisedCarrier.all_rows`.
    """
    counts = np.array([len(each) for each in parts])
    first = np.cumsum(counts) - counts

    def mean(values: Array) -> Array:
        return np.asarray(np.add.reduceat(values, first, axis=-2) / counts[:, None])

    features, left = mean(features), mean(rows.tau - expected)
    q, dq, ddq = (mean(each) for each in (rows.q, rows.dq, rows.ddq))
    white, lasting, rest = noise_parts(around.carrier, Motion.from_arrays(q, dq, ddq))
    return tuple(
        Cell(
            float(part.time[-1]),
            q[k],
            dq[k],
            left[k],
            white / len(part),
            lasting[k] + around.load.excess,
            rest[k],
            features[:, k],
        )
        for k, part in enumerate(parts)
    )


@dataclass(frozen=True, eq=False)
class CellWindow:
    """The last cells, whitened: z = L⁻¹ r, (N n,), and the root L of their covariance C, (N n, N n)."""

    cells: tuple[Cell, ...]
    root: Array
    residual: Array

    @classmethod
    def of(cls, around: LinearisedCarrier, cells: Sequence[Cell]) -> CellWindow:
        """Return the window of cells with residuals and features that belong to `around`."""
        return cls.among(around, cells, [range(len(cells))])[0]

    @classmethod
    def among(
        cls, around: LinearisedCarrier, cells: Sequence[Cell], choices: Sequence[Sequence[int]]
    ) -> list[CellWindow]:
        """Return the windows of some of the cells each, by their places; their covariances are parts of one."""
        n, count = len(cells[0].q), len(cells)
        features = np.stack([each.features for each in cells], axis=1).reshape(len(cells[0].features), -1)
        covariance = (features.T @ around.covariance @ features).reshape(count, n, count, n)
        q, dq = np.array([each.q for each in cells]), np.array([each.dq for each in cells])
        alike = likeness(around.carrier, q, dq, *WINDOW.like)
        end, places = np.array([each.end for each in cells]), np.arange(count)
        near = np.exp(-np.abs(np.subtract.outer(end, end)) / WINDOW.rest_s)
        lasting, rest = (np.sqrt([getattr(each, name) for each in cells]) for name in ("lasting", "rest"))
        for j in range(n):
            covariance[:, j, :, j] += alike[j] * np.outer(lasting[:, j], lasting[:, j])
            covariance[:, j, :, j] += near * np.outer(rest[:, j], rest[:, j])
            covariance[places, j, places, j] += [each.new[j] for each in cells]
        windows = []
        for choice in choices:
            size, chosen = len(choice) * n, [cells[place] for place in choice]
            part = covariance[choice][:, :, choice].reshape(size, size)
            root = np.asarray(np.linalg.cholesky(part), np.float64)
            residual = np.concatenate([each.residual for each in chosen])
            whitened = solve_triangular(root, residual, lower=True, check_finite=False)
            windows.append(cls(tuple(chosen), root, whitened))
        return windows

    @property
    def density(self) -> float:
        """Return the log density of the residuals, up to a constant."""
        return float(-0.5 * self.residual @ self.residual - np.log(np.diagonal(self.root)).sum())

    def of_body(self, after: int, carried: Array) -> float:
        """Return the nats by which a possible body explains the last cells better than the current payload, (10,).

        Ten free numbers easily explain seven torques; a real mass does not.
        """
        gram, pull = self._of_payload(after)
        total = pull + gram @ carried
        return most_likely(gram, total, ANY_PAYLOAD, ANY_PAYLOAD.centre)[3] + float(
            0.5 * carried @ gram @ carried - total @ carried
        )

    def past_contact(self) -> float:
        """Return the max nats by which a contact within the cells explains them better than nothing."""
        n, count = len(self.cells[0].q), len(self.cells)
        spans = [(begin, end) for begin in range(1, count) for end in range(begin + 1, count)]
        during = np.array([(np.arange(count) >= begin) & (np.arange(count) < end) for begin, end in spans], np.float64)
        columns = np.einsum("sk,ij->kjsi", during, np.eye(n)).reshape(count * n, -1)
        whitened = solve_triangular(self.root, columns, lower=True, check_finite=False)
        blocks = whitened.reshape(-1, len(spans), n).transpose(1, 0, 2)
        typical = typical_torque(self.cells[-1].features[-PARAMETERS:])
        return float(self._evidence(blocks, [np.full(n, each * typical) for each in CONTACT_SCALES]).max())

    def mass(self, after: int) -> tuple[float, float]:
        """Return mean and standard deviation of the mass added in the last cells, of either sign, kg."""
        gram, pull = self._of_payload(after)
        scale = WINDOW.masses[1] * UNIT_BODY
        spread = np.linalg.inv(np.eye(PARAMETERS) + scale[:, None] * gram * scale)
        return WINDOW.masses[1] * float(spread[0] @ (scale * pull)), WINDOW.masses[1] * float(np.sqrt(spread[0, 0]))

    def _evidence(self, features: Array, scales: Sequence[Array]) -> Array:
        """Return the nats gained by each of K sets of whitened features, (K, N n, p), see `bodies.evidence`."""
        gram, pull = features.transpose(0, 2, 1) @ features, np.einsum("kni,n->ki", features, self.residual)
        return evidence(gram, pull, scales)

    def _of_payload(self, after: int) -> tuple[Array, Array]:
        """Return Λ (10, 10) and ξ (10,) of the last cells for a payload, see `payload`."""
        payload = np.stack([each.features[-PARAMETERS:] for each in self.cells], axis=1)
        late = (np.arange(len(self.cells)) >= len(self.cells) - after)[:, None]
        columns = (payload * late).reshape(PARAMETERS, -1).T
        whitened = solve_triangular(self.root, columns, lower=True, check_finite=False)
        return whitened.T @ whitened, whitened.T @ self.residual

    def gains(self, after: Sequence[int] = WINDOW.after) -> dict[int, dict[Kind, float]]:
        """Return the nats by which each hypothesis explains the cells better than nothing, by number of last cells.

        after: numbers of last cells to check. At least `min_before` cells must come before them, or none.
        """
        n, count = len(self.cells[0].q), len(self.cells)
        payload = np.stack([each.features[-PARAMETERS:] for each in self.cells], axis=1)  # (10, N, n)
        contact = np.broadcast_to(np.eye(n)[:, None], (n, count, n))
        turns = np.tanh(np.array([each.dq for each in self.cells]) / SIGN_WIDTH)
        friction = contact * turns
        typical = typical_torque(self.cells[-1].features[-PARAMETERS:])
        scales: dict[Kind, list[Array]] = {
            "payload": [mass * UNIT_BODY for mass in WINDOW.masses],
            "contact": [np.full(n, each * typical) for each in CONTACT_SCALES],
            "friction": [np.full(n, each * typical) for each in WINDOW.frictions],
        }
        kinds: dict[Kind, Array] = {"payload": payload, "contact": contact, "friction": friction}
        spans = [each for each in after if count - each >= WINDOW.min_before or count == each]
        columns = []
        for each in kinds.values():
            for span in spans:
                late = (np.arange(count) >= count - span)[:, None]
                columns.append((each * late).reshape(len(each), -1))
        whitened = solve_triangular(self.root, np.concatenate(columns).T, lower=True, check_finite=False)
        out: dict[int, dict[Kind, float]] = {span: {} for span in spans}
        at = 0
        for kind, each in kinds.items():
            size, number = len(each), len(spans)
            block = whitened[:, at : at + size * number].reshape(-1, number, size).transpose(1, 0, 2)
            at += size * number
            for span, gain in zip(spans, self._evidence(block, scales[kind]), strict=True):
                out[span][kind] = float(gain)
        return out
