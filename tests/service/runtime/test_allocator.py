"""The C library's heaps in a process that limits free memory, counted with `malloc_info`."""

import ctypes
import os
import subprocess
import sys

import pytest

from service.runtime.allocator import HEAPS

glibc = pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "malloc_info"), reason="another C library")
THREADS = 8
SCRIPT = f"""
import ctypes, threading
from service.runtime.allocator import limit_free_memory
print(limit_free_memory())
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
    """Return whether the process limits free memory, and its number of heaps after threads have allocated."""
    usual = {name: value for name, value in os.environ.items() if not name.startswith(("MALLOC_", "GLIBC_TUNABLES"))}
    command = [sys.executable, "-u", "-c", SCRIPT]
    done = subprocess.run(command, env={**usual, **environment}, capture_output=True, text=True, check=True)
    first, _, report = done.stdout.partition("\n")
    return first == "True", report.count("<heap nr=")


@glibc
def test_threads_share_few_heaps():
    assert heaps() == (True, HEAPS)


@glibc
def test_environment_variable_takes_precedence():
    kept, count = heaps(MALLOC_ARENA_MAX="5")
    assert not kept
    assert HEAPS < count <= 5


BLOCKS = 2000
PINNED = f"""
import ctypes, os
from pathlib import Path
from service.runtime.allocator import release_memory
library = ctypes.CDLL(None)
library.malloc.restype = ctypes.c_void_p
library.malloc.argtypes = [ctypes.c_size_t]
library.free.argtypes = [ctypes.c_void_p]
def resident():
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
blocks = [library.malloc(50_000) for _ in range({BLOCKS})]
for block in blocks:
    ctypes.memset(block, 1, 50_000)
for block in blocks[:-1]:
    library.free(block)
before = resident()
release_memory()
print((before - resident()) / {BLOCKS * 50_000})
"""


@glibc
def test_free_memory_below_a_used_block_is_returned():
    done = subprocess.run([sys.executable, "-c", PINNED], capture_output=True, text=True, check=True)
    assert float(done.stdout) > 0.9
