"""A limit on what is open at once, such as streams and followers."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import ClassVar

from service.foundation.errors import BusyError


class OpenCounter:
    """Counts open things of one kind.

    too_many: message of the error beyond the limit, with a place for the number. headers: sent with the error.
    """

    too_many: ClassVar[str]
    headers: ClassVar[dict[str, str]] = {}

    def __init__(self) -> None:
        self.open = 0

    @contextmanager
    def count_one(self, most: int) -> Iterator[None]:
        """Count one for the duration of the block; raise BusyError beyond `most`."""
        if self.open >= most:
            raise BusyError(self.too_many.format(self.open), headers=self.headers)
        self.open += 1
        try:
            yield
        finally:
            self.open -= 1
