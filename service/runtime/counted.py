"""What may be open only so many times at once, such as streams and followers."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import ClassVar

from service.foundation.errors import BusyError


class Counted:
    """Counts what is open. too_many: the message beyond the most, with a place for the number; headers: go with it."""

    too_many: ClassVar[str]
    headers: ClassVar[dict[str, str]] = {}

    def __init__(self) -> None:
        self.open = 0

    @contextmanager
    def one_more(self, most: int) -> Iterator[None]:
        """Count one while it lasts; raise BusyError beyond `most`."""
        if self.open >= most:
            raise BusyError(self.too_many.format(self.open), headers=self.headers)
        self.open += 1
        try:
            yield
        finally:
            self.open -= 1
