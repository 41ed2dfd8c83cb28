"""The C library's heaps in a process that keeps little, counted by what it tells of itself."""

import ctypes
import os
import subprocess
import sys

import pytest

from service.compute.allocator import HEAPS

glibc = pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "malloc_info"), reason="another C library")
THREADS = 8
SCRIPT = f"""
import ctypes, threading
from service.compute.allocator import keep_little
print(keep_little())
library = ctypes.CDLL(None)
library.malloc.restype = library.fopen.restype = ctypes.c_void_p
library.malloc.argtypes = [ctypes.c_size_t]
met = threading.Barrier({THREADS})
def allocate():
    met.wait()
    library.malloc(1000)
    met.wait()
threads = [threading.Thread(target=allocate) for _ in range({THREADS})]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
library.malloc_info.argtypes = [ctypes.c_int, ctypes.c_void_p]
library.fflush.argtypes = [ctypes.c_void_p]
file = library.fopen(b"/dev/stdout", b"w")
library.malloc_info(0, file)
library.fflush(file)
"""


def heaps(**environment: str) -> tuple[bool, int]:
    """What a process says of whether it keeps little, and how many heaps it has after threads have allocated."""
    usual = {name: value for name, value in os.environ.items() if not name.startswith(("MALLOC_", "GLIBC_TUNABLES"))}
    command = [sys.executable, "-u", "-c", SCRIPT]
    done = subprocess.run(command, env={**usual, **environment}, capture_output=True, text=True, check=True)
    first, _, told = done.stdout.partition("\n")
    return first == "True", told.count("<heap nr=")


@glibc
def test_threads_share_few_heaps():
    assert heaps() == (True, HEAPS)


@glibc
def test_what_the_environment_says_stays():
    kept, count = heaps(MALLOC_ARENA_MAX="5")
    assert not kept
    assert HEAPS < count <= 5
