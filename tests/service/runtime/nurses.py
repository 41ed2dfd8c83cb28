"""Functions that tests of forked processes call in them, and a process with a nursery: `python -m … SCENARIO`."""

import os
import sys
import threading
import time
from multiprocessing.connection import Connection, Pipe
from pathlib import Path

from service.runtime import forking, nursery
from service.runtime.process import ProcessOptions
from tests.service.planes.little import say

PLACE = ProcessOptions(threads=1)


def answer(word: str, connection: Connection) -> None:
    """Send a word, and how many threads this process has and whether it shares a module that is imported late."""
    threads = len(list(Path("/proc/self/task").iterdir()))
    connection.send((word, threads, "colorsys" in sys.modules, Path("/proc/self/comm").read_text().strip()))
    connection.recv()


def fail(_: Connection) -> None:
    """End with exit code 7."""
    sys.exit(7)


def shared() -> None:
    """Print what two processes of a nursery answer, although this process has threads."""
    import colorsys  # noqa: F401

    nursery.start()
    threading.Thread(target=time.sleep, args=(60,), daemon=True).start()
    forks = nursery.current()
    assert forks is not None
    for word in ("one", "two"):
        ours, theirs = Pipe()
        process = forks.start(word, PLACE, theirs, answer, word)
        theirs.close()
        say(*ours.recv(), process.is_alive(), process.exitcode)
        process.kill()
        process.join()
        say(process.is_alive(), process.exitcode)
    ours, theirs = Pipe()
    process = forks.start("three", PLACE, theirs, fail)
    process.join()
    say(process.exitcode)


def orphaned() -> None:
    """Print the ids of this process, of its nursery and of a process of that; then of one that starts without it."""
    nursery.start()
    forks = nursery.current()
    assert forks is not None
    ours, theirs = Pipe()
    process = forks.start("one", PLACE, theirs, answer, "one")
    ours.recv()
    say(os.getpid(), forks.pid, process.pid)
    sys.stdin.readline()
    process.join()
    try:
        forks.start("two", PLACE, theirs, answer, "two")
    except OSError as error:
        say(type(error).__name__, process.exitcode)
    sys.stdin.readline()


def threads() -> None:
    """Print the error of a process that has a thread."""
    forking.check_threads()
    threading.Thread(target=time.sleep, args=(60,), daemon=True).start()
    try:
        forking.check_threads()
    except forking.ThreadsError as error:
        say(error)
    os._exit(0)


if __name__ == "__main__":
    {each.__name__: each for each in (shared, orphaned, threads)}[sys.argv[1]]()
