"""The recipe for a live stream: a causal filter with a known delay."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from lipcore.data.samples import Array
from lipcore.data.signals import ORDER
from lipcore.preparation.filtering import QUANTITIES, Filters, QuantityReader
from lipcore.preparation.resampling import BLOCK_ROWS


class CausalFilter:
    """Low-pass and differences of evenly spaced rows, row after row, as `Filters` configures them, without thinning.

    All quantities pass the same filter, so they stay those of one moment, `delay_s` before the last row. Differences
    are central, hence exact on quadratics, and belong to the row before the last: two rows are too few.
    """

    def __init__(self, work: Filters, n_joints: int) -> None:
        from scipy.signal import butter, sosfilt, sosfilt_zi  # noqa: PLC0415 - half a second

        self.work, self.n_joints = work, n_joints
        self._sosfilt = sosfilt
        self._sections: Array | None = None
        self._at_rest: Array | None = None
        if work.cutoff is not None:
            self._sections = butter(ORDER, work.cutoff, fs=work.rate, output="sos")
            self._at_rest = sosfilt_zi(self._sections)
        self.lag = 1 if work.derived else 0
        self.delay_s = (self._group_delay() + self.lag) / work.rate
        self.reset()

    def reset(self) -> None:
        """Forget all rows: after a gap, or before another recording."""
        self._state: Array | None = None
        self._history = np.empty((0, len(self.work.given) * self.n_joints))

    def batch(self, rows: Mapping[str, Array]) -> dict[str, Array]:
        """Return q, dq, ddq, tau, (N, n) each, for further rows, (N, n) of every quantity given.

        If a quantity is derived, the first batch returns two rows fewer. Raise ValueError for rows of another shape, or
        that are not finite: the filter would never forget these.
        """
        signals = np.hstack([self._checked(name, rows) for name in self.work.given])
        smooth = self._low_pass(signals)
        if not self.lag:
            return self._named(smooth)
        known = np.concatenate([self._history, smooth])
        self._history = known[-2:].copy()
        if len(known) < 3:
            return self._named(known[:0])
        before, now, after = known[:-2], known[1:-1], known[2:]
        slope = self._named((after - before) * (0.5 * self.work.rate))
        middle = self._named(now)
        if "ddq" in self.work.derived:
            bend = self._named((after - 2 * now + before) * self.work.rate**2)
            middle["ddq"] = bend["q"] if "dq" in self.work.derived else slope["dq"]
        if "dq" in self.work.derived:
            middle["dq"] = slope["q"]
        return middle

    def part(self, read: QuantityReader) -> Iterator[tuple[str, Array]]:
        """Yield all quantities, in turn, of one contiguous part of one joint, filtered causally: columns (N,)."""
        self.reset()
        signals = {name: read(name)[:, None] for name in self.work.given}
        rows = len(signals["q"])
        columns = {name: np.empty(rows - 2 * self.lag) for name in QUANTITIES}
        done = 0
        for begin in range(0, rows, BLOCK_ROWS):
            block = self.batch({name: values[begin : begin + BLOCK_ROWS] for name, values in signals.items()})
            for name, values in block.items():
                columns[name][done : done + len(values)] = values[:, 0]
            done += len(block["q"])
        for name in QUANTITIES:
            yield name, columns.pop(name)

    def _checked(self, name: str, rows: Mapping[str, Array]) -> Array:
        values = np.asarray(rows[name], dtype=np.float64)
        if values.ndim != 2 or values.shape != (len(rows["q"]), self.n_joints):
            raise ValueError(f"{name} has shape {values.shape}, expected {(len(rows['q']), self.n_joints)}")
        if not np.isfinite(values).all():
            raise ValueError(f"{name} is not finite in row {int(np.flatnonzero(~np.isfinite(values).all(1))[0])}")
        return values

    def _low_pass(self, signals: Array) -> Array:
        if self._sections is None or self._at_rest is None or not len(signals):
            return signals
        if self._state is None:  # starts at rest at the first row
            self._state = self._at_rest[:, :, None] * signals[0]
        smooth, self._state = self._sosfilt(self._sections, signals, axis=0, zi=self._state)
        return np.asarray(smooth)

    def _named(self, table: Array) -> dict[str, Array]:
        """Return columns of the quantities given, and placeholders for those derived."""
        n = self.n_joints
        columns = {name: table[:, index * n : (index + 1) * n] for index, name in enumerate(self.work.given)}
        return {name: columns.get(name, columns["q"]) for name in QUANTITIES}

    def _group_delay(self) -> float:
        """Return the delay of slow motions, in samples: minus the slope of the phase at frequency 0."""
        if self._sections is None:
            return 0.0
        late = 0.0
        for section in self._sections:
            for sign, taps in ((1, section[:3]), (-1, section[3:])):
                late += sign * float(taps @ np.arange(3.0)) / float(taps.sum())
        return late
