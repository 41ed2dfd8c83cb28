"""Readers of hostile files that misbehave in various ways, to be called in a cage."""

import ctypes
import os
import resource
import socket
import subprocess
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from service.foundation.errors import TooLargeError, invalid_data


def add(first: int, second: float, path: Path) -> dict[str, float | str]:
    return {"sum": first + second, "path": str(path)}


def text() -> str:
    return "no number"


def long_text(size: int) -> str:
    return "x" * size


def crash() -> None:
    ctypes.string_at(0)


def exit_at_once() -> None:
    os._exit(3)


def allocate(size: int) -> int:
    try:
        return len(np.zeros(size, np.uint8))
    except MemoryError:
        raise invalid_data("file", "damaged", "undamaged") from None


def spin() -> None:
    while True:
        pass


def sleep() -> None:
    time.sleep(3600)


def close_all_and_sleep() -> None:
    os.closerange(0, 100)
    time.sleep(3600)


def write(folder: Path, size: int) -> None:
    with (folder / "large").open("wb") as file:
        file.truncate(size)


def open_files(path: Path) -> None:
    files = []
    while True:
        files.append(path.open())


def raise_reader_error(kind: str) -> None:
    raise invalid_data("q1, row 3", "x", "a number") if kind == "data" else TooLargeError("too large")


def raise_key_error() -> None:
    os.write(2, b"noise\n\x1b[31m of a library\n")
    raise KeyError("a bug")


def write_output(size: int) -> int:
    os.write(1, b"out\n")
    os.write(2, b"\x1b[2J" + b"x" * size)
    return 7


def count_threads() -> int:
    found = []
    each = threading.Thread(target=lambda: found.append(1))
    each.start()
    each.join()
    return len(found)


def environment() -> str:
    at_start = Path("/proc/self/environ")
    with suppress(OSError):
        return repr(dict(os.environ)) + at_start.read_text()
    return repr(dict(os.environ))


def open_descriptors() -> list[int]:
    return [number for number in range(256) if _is_open(number)]


def _is_open(number: int) -> bool:
    try:
        os.fstat(number)
    except OSError:
        return False
    return True


def attempt(action: str, secret: str, pid: int) -> str:
    """Attempt something that no reader does; return the name of the error."""
    actions = {
        "socket": socket.socket,
        "fork": os.fork,
        "exec": lambda: os.execv("/bin/true", ["true"]),
        "spawn": lambda: subprocess.run(["/bin/true"], check=True),
        "kill": lambda: os.kill(pid, 0),
        "kill all": lambda: os.kill(-1, 0),
        "priority": lambda: os.setpriority(os.PRIO_PROCESS, pid, 19),
        "limit of another": lambda: resource.prlimit(pid, resource.RLIMIT_NOFILE, (1, 1)),
        "read": lambda: Path(secret).read_text(),
        "write": lambda: Path(secret).write_text("x"),
        "list": lambda: os.listdir(Path(secret).parent),
        "link": lambda: os.link(secret, Path(os.environ["TMPDIR"], "link")),
        "symbolic link": lambda: os.symlink(secret, Path(os.environ["TMPDIR"], "link")),
        "memory": lambda: Path(f"/proc/{pid}/environ").read_text(),
        "more processor time": lambda: resource.setrlimit(resource.RLIMIT_CPU, (10**6, 10**6)),
    }
    try:
        actions[action]()
    except (OSError, ValueError) as error:
        return type(error).__name__
    return "done"


def crash_reader(upload: Any, kind: Any, options: Any, robot: Any, usage: Any, folder: Any, settings: Any) -> None:
    crash()
