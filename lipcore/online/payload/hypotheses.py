"""What has happened to an arm: nothing, a payload taken up or put down, a contact, other friction. Weighed by evidence.

Rows are averaged in cells of 50 ms: torque is linear in what is unknown, so that nothing is lost but what white noise
there is. Of the last cells, those before an instant and those after it, the residual r has the covariance

    C = Φ Σ Φᵀ + errors like in motion that is alike + white noise,

and a hypothesis adds Y c in the cells after it, c ~ N(0, P). Its evidence over that of nothing is

    ½ vᵀ M⁻¹ v − ½ log det M,    M = 1 + P^½ Yᵀ C⁻¹ Y P^½,    v = P^½ Yᵀ C⁻¹ r.

What the arm's model gets wrong is in both kinds of cells alike and cancels: so small payloads show on a dirty arm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.linalg import solve_triangular

from lipcore.data.motion import Motion
from lipcore.data.samples import Array
from lipcore.kernels.friction import SIGN_WIDTH
from lipcore.model.payload import Linearised
from lipcore.online.batch import Rows
from lipcore.online.payload.bodies import ANY, CONTACTS, SHAPE, evidence, most_likely, usual
from lipcore.online.payload.errors import likeness, noise_parts
from lipcore.robots.urdf import PARAMETERS

Kind = Literal["payload", "contact", "friction"]


@dataclass(frozen=True)
class WindowOptions:
    """Cells that are compared, and scales of what may have happened."""

    cell_s: float = 0.05
    like: tuple[float, float] = (1.0, 0.5)
    rest_s: float = 0.3
    """Lengths of errors that change with motion, see `errors.likeness`, and of what holds a joint at rest. Tuned on the
    dirty Panda of seed 50: with those of `errors` 0.5 kg are not seen, with twice as much fast motion looks like a
    payload."""
    min_leap: float = 6.0
    """Min deviations of the noise by which the residual differs from row to row if something has happened."""
    before: int = 6
    min_before: int = 4
    """Max and min number of cells before the instant."""
    after: tuple[int, ...] = (1, 2, 3, 4, 5, 6)
    """Numbers of cells after the instant."""
    masses: tuple[float, ...] = (0.5, 1.5, 5.0)
    """Scales of a payload's mass, kg; first moment and inertia are those of `bodies.SHAPE`."""
    frictions: tuple[float, ...] = (0.1, 0.3)
    """Scales of a change of friction, in units of the usual torque, see `bodies.usual`."""

    @property
    def cells(self) -> int:
        """Cells that are compared together."""
        return self.before + self.after[-1]


WINDOW = WindowOptions()


@dataclass(frozen=True, eq=False)
class Cell:
    """Means over the rows of one stretch of time. end: event time of its last row, s; q, dq, residual:
    (n,); new, lasting, rest: (n,), variances of the residual, of this cell alone, shared with cells of like motion, and
    with those before and after;
    features: (M + K + 10, n), see `Linearised.all_rows`."""

    end: float
    q: Array
    dq: Array
    residual: Array
    new: Array
    lasting: Array
    rest: Array
    features: Array


def parted(around: Linearised, parts: Sequence[Rows]) -> tuple[list[Rows], tuple[Cell, ...]]:
    """Part stretches of rows where the residual leaps; return the parts and their cells. A payload is taken up between
    two rows, and a mean over both sides fits neither."""
    rows = _joined(parts)
    features, expected = around.all_rows(rows.motion())
    white, lasting, rest = noise_parts(around.carrier, rows.motion())
    usual = np.sqrt(2 * white + (lasting + rest)[1:])
    leaps = (np.abs(np.diff(rows.tau - expected, axis=0)) > WINDOW.min_leap * usual).any(axis=1)
    ends = np.cumsum([len(each) for each in parts])[:-1]
    edges = np.union1d(ends, np.flatnonzero(leaps) + 1)
    parts = [rows.take(each) for each in np.split(np.arange(len(rows)), edges)]
    return parts, _means(around, parts, rows, features, expected)


def cells_of(around: Linearised, parts: Sequence[Rows]) -> tuple[Cell, ...]:
    """The cells of stretches of rows, seen from an arm with the payload that it has, or none."""
    rows = _joined(parts)
    return _means(around, parts, rows, *around.all_rows(rows.motion()))


def _joined(parts: Sequence[Rows]) -> Rows:
    return parts[0] if len(parts) == 1 else Rows.concatenate(parts)


def _means(around: Linearised, parts: Sequence[Rows], rows: Rows, features: Array, expected: Array) -> tuple[Cell, ...]:
    """The cells of parts that are these rows together; features, expected: of each row, see `Linearised.all_rows`."""
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
            lasting[k],
            rest[k],
            features[:, k],
        )
        for k, part in enumerate(parts)
    )


@dataclass(frozen=True, eq=False)
class Window:
    """The last cells, whitened: z = L⁻¹ r, (N n,), and the root L of their covariance C, (N n, N n)."""

    cells: tuple[Cell, ...]
    root: Array
    residual: Array

    @classmethod
    def of(cls, around: Linearised, cells: Sequence[Cell]) -> Window:
        """The window of cells, seen around a load, which their residuals and features belong to."""
        return cls.among(around, cells, [range(len(cells))])[0]

    @classmethod
    def among(cls, around: Linearised, cells: Sequence[Cell], choices: Sequence[Sequence[int]]) -> list[Window]:
        """The windows of some of the cells each, by their places, whose covariances are parts of one."""
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
        """Logarithm of the density of the residuals, but for a constant."""
        return float(-0.5 * self.residual @ self.residual - np.log(np.diagonal(self.root)).sum())

    def of_body(self, after: int, carried: Array) -> float:
        """Nats by which a body that can exist explains the last cells better than that which is carried, (10,), does:
        of ten free numbers seven torques are soon explained, of a real mass they are not."""
        gram, pull = self._of_payload(after)
        total = pull + gram @ carried
        return most_likely(gram, total, ANY, ANY.centre)[3] + float(0.5 * carried @ gram @ carried - total @ carried)

    def past_contact(self) -> float:
        """Nats by which a contact that began and ended within the cells explains them better than nothing, at most."""
        n, count = len(self.cells[0].q), len(self.cells)
        spans = [(begin, end) for begin in range(1, count) for end in range(begin + 1, count)]
        during = np.array([(np.arange(count) >= begin) & (np.arange(count) < end) for begin, end in spans], np.float64)
        columns = np.einsum("sk,ij->kjsi", during, np.eye(n)).reshape(count * n, -1)
        whitened = solve_triangular(self.root, columns, lower=True, check_finite=False)
        blocks = whitened.reshape(-1, len(spans), n).transpose(1, 0, 2)
        typical = usual(self.cells[-1].features[-PARAMETERS:])
        return float(self._evidence(blocks, [np.full(n, each * typical) for each in CONTACTS]).max())

    def mass(self, after: int) -> tuple[float, float]:
        """Mean and standard deviation, kg, of the mass that is carried more for the last cells, of either sign."""
        gram, pull = self._of_payload(after)
        scale = WINDOW.masses[1] * SHAPE
        spread = np.linalg.inv(np.eye(PARAMETERS) + scale[:, None] * gram * scale)
        return WINDOW.masses[1] * float(spread[0] @ (scale * pull)), WINDOW.masses[1] * float(np.sqrt(spread[0, 0]))

    def _evidence(self, features: Array, scales: Sequence[Array]) -> Array:
        """Nats gained by each of K sets of whitened features, (K, N n, p), see `bodies.evidence`."""
        gram, pull = features.transpose(0, 2, 1) @ features, np.einsum("kni,n->ki", features, self.residual)
        return evidence(gram, pull, scales)

    def _of_payload(self, after: int) -> tuple[Array, Array]:
        """Λ (10, 10) and ξ (10,) of what the last cells say of a payload, as in `payload`."""
        payload = np.stack([each.features[-PARAMETERS:] for each in self.cells], axis=1)
        late = (np.arange(len(self.cells)) >= len(self.cells) - after)[:, None]
        columns = (payload * late).reshape(PARAMETERS, -1).T
        whitened = solve_triangular(self.root, columns, lower=True, check_finite=False)
        return whitened.T @ whitened, whitened.T @ self.residual

    def gains(self, after: Sequence[int] = WINDOW.after) -> dict[int, dict[Kind, float]]:
        """Nats by which hypotheses explain the cells better than nothing does, by the number of cells that they hold
        for: of a payload, of a contact, and of other friction. after: numbers that are looked at, where at least
        `min_before` cells come before, or none does."""
        n, count = len(self.cells[0].q), len(self.cells)
        payload = np.stack([each.features[-PARAMETERS:] for each in self.cells], axis=1)  # (10, N, n)
        contact = np.broadcast_to(np.eye(n)[:, None], (n, count, n))
        turns = np.tanh(np.array([each.dq for each in self.cells]) / SIGN_WIDTH)
        friction = contact * turns
        typical = usual(self.cells[-1].features[-PARAMETERS:])
        scales: dict[Kind, list[Array]] = {
            "payload": [mass * SHAPE for mass in WINDOW.masses],
            "contact": [np.full(n, each * typical) for each in CONTACTS],
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
