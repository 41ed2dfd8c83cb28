"""What each method needs to be told, what its user writes, and the uncertainty that it states."""

from __future__ import annotations

import inspect
import io
import tokenize
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

LAYOUT = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}


@dataclass(frozen=True)
class Peer:
    """Facts about a method.

    Attributes:
        needs: what it needs besides positions, velocities and torque.
        friction: friction that it can find.
        parameters: uncertainty that it states of parameters.
        torque: uncertainty that it states of a predicted torque.
        code: functions that a user writes.
    """

    needs: str
    friction: str
    parameters: str
    torque: str
    code: tuple[Callable[..., Any], ...]

    @property
    def lines(self) -> int:
        """Number of lines of `code`, without documentation, comments and blank lines."""
        return sum(count_lines(inspect.getsource(each)) for each in self.code)


def count_lines(source: str) -> int:
    """Return the number of lines with code. A docstring or another statement of a text alone is no code."""
    found: set[int] = set()
    statement: list[tokenize.TokenInfo] = []
    for token in tokenize.generate_tokens(io.StringIO(inspect.cleandoc("\n" + source)).readline):
        if token.type not in LAYOUT:
            statement.append(token)
        elif token.type == tokenize.NEWLINE:
            if any(each.type != tokenize.STRING for each in statement):
                found.update(line for each in statement for line in range(each.start[0], each.end[0] + 1))
            statement = []
    return len(found)
