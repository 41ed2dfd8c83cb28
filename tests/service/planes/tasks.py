"""Tasks of workers that end, wait or fail."""

import os
import signal
from pathlib import Path
from typing import Any

from service.foundation.errors import ConflictError, problem


def echo(_storage: Any, _served: Any, *given: Any) -> Any:
    """Return the arguments, with copies of buffers."""
    return tuple(bytes(each) if isinstance(each, memoryview) else each for each in given)


def process_id(_storage: Any, _served: Any) -> int:
    """Return the id of the process."""
    return os.getpid()


def home(storage: Any, _served: Any) -> Path:
    """Return the home of the storage."""
    path: Path = storage.settings.home
    return path


def models(_storage: Any, served: Any) -> list[int]:
    """Return the identity of the models."""
    return [id(each.default_model) for each in (served if isinstance(served, tuple) else (served,))]


def die(_storage: Any, _served: Any, runs: str, lives: int) -> str:
    """Kill the process, except in its last run. runs: file with a byte for each run."""
    with Path(runs).open("ab") as file:
        file.write(b".")
    if Path(runs).stat().st_size < lives:
        os.kill(os.getpid(), signal.SIGKILL)
    return "done"


def wait_for(_storage: Any, _served: Any, begun: str, pipe: str) -> bytes:
    """Write the id of the process to a pipe, and wait for the end of another one."""
    Path(begun).write_text(f"{os.getpid()}\n")
    return Path(pipe).read_bytes()


def fail(_storage: Any, _served: Any, kind: str) -> None:
    """Raise an error: one of the service, one that cannot be pickled, or another one."""
    if kind == "service":
        raise ConflictError("It changed.", [problem("name", 3, "another")], {"Retry-After": "7"})
    if kind == "local":

        class LocalError(Exception):
            pass

        raise LocalError("of no module")
    raise ZeroDivisionError(kind)
