"""What is sent to a cluster. Its scheduler unpickles each call that passes through: here it finds bytes, and functions
whose modules import nothing. The modules of a call would be numerics, whose import stops a scheduler for seconds."""

from __future__ import annotations

import gc
import importlib
import pickle
from types import ModuleType
from typing import Any


def pack(function: Any, *given: Any, **named: Any) -> bytes:
    """A call of a module's function, for `call`."""
    return pickle.dumps((function, given, named), pickle.HIGHEST_PROTOCOL)


def call(packed: bytes) -> Any:
    """Do a call on a worker. What comes in is trusted as all messages of a cluster are: its network is private."""
    function, given, named = pickle.loads(packed)  # noqa: S301
    return function(*given, **named)


def call_named(name: str, *given: Any) -> Any:
    """Do a call on a worker of a function by its name, `package.module:function`, which only the worker imports."""
    module, _, function = name.partition(":")
    return getattr(importlib.import_module(module), function)(*given)


def imported(name: str) -> ModuleType:
    """Import a module, with all that it needs, unexamined.

    Searching for garbage in what is never freed would take a fifth of the time, and 40 ms of a service's loop later.
    """
    gc.disable()
    try:
        module = importlib.import_module(name)
        gc.freeze()
    finally:
        gc.enable()
    return module
