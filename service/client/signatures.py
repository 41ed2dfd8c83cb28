"""What `help` shows of methods that are made of calls."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")

_RESULT = re.compile(r"Call\[(?:Page\[(?P<item>.+)\]|(?P<one>.+))\]")


def bound(method: Callable[P, T], result: str = "{}") -> Callable[P, T]:
    """Give a function that wraps a call's the signature of a method, and return it.

    result: what it returns, with {} for what the call makes or its page lists.
    """
    own = inspect.signature(method)
    itself = inspect.Parameter("self", inspect.Parameter.POSITIONAL_ONLY)
    made = _RESULT.fullmatch(str(own.return_annotation))
    returned = result.format(made["item"] or made["one"]) if made else own.return_annotation
    parameters = [itself, *own.parameters.values()]
    method.__signature__ = own.replace(  # type: ignore[attr-defined]
        parameters=parameters, return_annotation=returned
    )
    return method
