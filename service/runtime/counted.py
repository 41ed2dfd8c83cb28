"""A limit on what is open at once, such as streams and followers."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import ClassVar

from service.foundation.errors import BusyError
from service.telemetry.counters import Gauge, new_gauge


class OpenCounter:
    """Counts open things of one kind.

    too_many: message of the error beyond the limit, with a place for the number. headers: sent with the error.
    gauge: their number, which processes may share.
    """

    too_many: ClassVar[str]
    headers: ClassVar[dict[str, str]] = {}

    def __init__(self, gauge: Gauge | None = None) -> None:
        self._gauge = new_gauge() if gauge is None else gauge

    @property
    def open(self) -> int:
        """The number of open things, of all processes that share it."""
        return self._gauge.total

    @contextmanager
    def count_one(self, most: int) -> Iterator[None]:
        """Count one for the duration of the block; raise BusyError beyond `most`."""
        already = self.open
        if already >= most:
            raise BusyError(self.too_many.format(already), headers=self.headers)
        self._gauge.add(1)
        try:
            yield
        finally:
            self._gauge.add(-1)
