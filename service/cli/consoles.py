"""Where commands print: results to standard output, all else to standard error."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

PIPE_WIDTH = 160
"""Columns of a table that no terminal shows: room for the inertia matrix of seven joints."""
out = Console(soft_wrap=True, width=None if sys.stdout.isatty() else PIPE_WIDTH)
err = Console(stderr=True, soft_wrap=True)


def say(text: str) -> None:
    """Print a line of a result as it is: neither marked up, nor coloured, nor wrapped."""
    out.print(escape(text), highlight=False, soft_wrap=True)


def note(text: str) -> None:
    """Print a line that is no result to standard error."""
    err.print(escape(text), highlight=False, soft_wrap=True)


def print_json(value: Any, one_line: bool = False) -> None:
    """Print a result as one JSON document; see `plain`."""
    sys.stdout.write(json.dumps(plain(value), indent=None if one_line else 2, ensure_ascii=False, allow_nan=False))
    sys.stdout.write("\n")
    sys.stdout.flush()


def plain(value: Any) -> Any:
    """Return records, arrays, paths and numbers as JSON knows them; numbers that are not finite become null."""
    if hasattr(value, "model_dump"):  # a record of the API
        return value.model_dump(mode="json")
    if hasattr(value, "as_dict"):  # a result of the client
        return value.as_dict()
    if is_dataclass(value) and not isinstance(value, type):
        return {each.name: plain(getattr(value, each.name)) for each in fields(value)}
    if hasattr(value, "tolist"):  # of NumPy
        return plain(value.tolist())
    if isinstance(value, Mapping):
        return {str(name): plain(each) for name, each in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [plain(each) for each in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value
