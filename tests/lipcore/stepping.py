"""What is computed step by step, waited for."""

from collections.abc import Generator
from typing import TypeVar

Result = TypeVar("Result")


def finished(steps: Generator[None, None, Result]) -> Result:
    """What a generator returns after all of its steps."""
    while True:
        try:
            next(steps)
        except StopIteration as done:
            return done.value
