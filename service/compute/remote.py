"""What is sent to a cluster. Its scheduler unpickles each call that passes through: here it finds bytes, and functions
whose modules import nothing. The modules of a call would be numerics, whose import stops a scheduler for seconds."""

from __future__ import annotations

import pickle
from typing import Any


def pack(function: Any, *given: Any, **named: Any) -> bytes:
    """A call of a module's function, for `call`."""
    return pickle.dumps((function, given, named), pickle.HIGHEST_PROTOCOL)


def call(packed: bytes) -> Any:
    """Do a call on a worker. What comes in is trusted as all messages of a cluster are: its network is private."""
    function, given, named = pickle.loads(packed)  # noqa: S301
    return function(*given, **named)


def host(version: str, job: str) -> None:
    """Run a job on a worker, see `service.training.hosting`."""
    from service.training import hosting  # noqa: PLC0415

    hosting.host(version, job)
