"""What a recording, or what is asked of it, may be refused for."""

from __future__ import annotations


class PreparationError(ValueError):
    """A recording cannot be prepared as asked: `field` is `value`, but `expected` was expected."""

    def __init__(self, field: str, value: object, expected: str) -> None:
        super().__init__(f"{field} is {value}, expected {expected}")
        self.field, self.value, self.expected = field, value, expected
