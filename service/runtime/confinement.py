"""Confinement of a process that reads an untrusted file, enforced by the kernel whatever code the file may run.

Memory, time and disk are limited (POSIX). On Linux, Landlock restricts the files, and a seccomp filter the system
calls: https://docs.kernel.org/userspace-api/landlock.html and seccomp_filter.html. All are irrevocable.
"""

from __future__ import annotations

import ctypes
import os
import platform
import resource
import struct
import sys
import sysconfig
from collections.abc import Iterable
from contextlib import suppress
from errno import ENOSYS, EPERM
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

ENVIRONMENT = {
    "LANG": "C.UTF-8",
    **dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1"),  # a running thread is not copied by a fork
    "MALLOC_ARENA_MAX": "2",  # each uses address space, even if empty
    "ARROW_DEFAULT_MEMORY_POOL": "system",
}
"""Environment of readers, set before they are imported."""
LINUX = sys.platform == "linux"
MAX_OPEN_FILES = 256
CREATE_RULESET, ADD_RULE, RESTRICT_SELF = 444, 445, 446
READ, WRITE, FILE = 0b1100, 0b100000110111110, 0b100000000000110
"""Rights of Landlock: to read files and folders; to read, write, make and delete them; and those on a file."""
MACHINES = {"x86_64": (0xC000003E, 0), "aarch64": (0xC00000B7, 1)}
"""By machine: its number in a filter, and its column in the tables below."""
FORBIDDEN = {
    **{"socket": (41, 198), "socketpair": (53, 199), "execve": (59, 221), "execveat": (322, 281), "fork": (57, None)},
    **{"vfork": (58, None), "ptrace": (101, 117), "process_vm_readv": (310, 270), "process_vm_writev": (311, 271)},
    **{"pidfd_open": (434, 434), "pidfd_getfd": (438, 438), "pidfd_send_signal": (424, 424), "kill": (62, 129)},
    **{"tkill": (200, 130), "tgkill": (234, 131), "rt_sigqueueinfo": (129, 138), "rt_tgsigqueueinfo": (297, 240)},
    **{"prlimit64": (302, 261), "setpriority": (141, 140), "unshare": (272, 97), "setns": (308, 268)},
    **{"bpf": (321, 280), "io_uring_setup": (425, 425)},
}
"""System calls (x86_64, aarch64) for network, and for other programs and processes."""
ALLOW, KILL, REFUSE = 0x7FFF0000, 0x80000000, 0x50000 | EPERM
LOAD, EQUAL, AT_LEAST, ANY_BIT, RETURN = 0x20, 0x15, 0x35, 0x45, 0x06


@cache
def protections() -> dict[str, bool]:
    """Return the protections of this platform by name; a process is confined by all that are True."""
    return {
        "memory": LINUX,  # macOS accepts the limit but does not enforce it
        "processor": True,
        "landlock": LINUX and _landlock_version() > 0,
        "seccomp": LINUX and platform.machine() in MACHINES and ctypes.CDLL(None).prctl(21, 0, 0, 0, 0) >= 0,
    }


def confine(memory: int, cpu_s: int, file: int, read: Iterable[Path], write: Iterable[Path]) -> None:
    """Give up all rights, resources, files, network and processes that a call does not need.

    memory: bytes beyond the current size of the process; cpu_s: processor time, s; file: max bytes of a file that it
    writes; read, write: files and folders that it keeps, besides its own modules. The process must have one thread.
    Raise OSError if a protection that `protections` names cannot be applied.
    """
    if LINUX:
        _call("prctl", 1, 9, 0, 0, 0)  # it ends with its parent
        with suppress(OSError):  # another sandbox may forbid it
            Path("/proc/self/oom_score_adj").write_text("1000")
        _call("capset", (ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)())
        _call("prctl", 38, 1, 0, 0, 0)  # no new privileges
    limits = {resource.RLIMIT_CPU: cpu_s, resource.RLIMIT_FSIZE: file, resource.RLIMIT_CORE: 0}
    limits[resource.RLIMIT_NOFILE] = MAX_OPEN_FILES
    if protections()["memory"]:
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        limits[resource.RLIMIT_AS] = pages * resource.getpagesize() + memory
    for kind, wanted in limits.items():
        # a process that ignores the signal of its processor time is killed a second later
        hard = resource.getrlimit(kind)[1]
        most = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
        resource.setrlimit(kind, (most, most + (kind == resource.RLIMIT_CPU and hard != most)))
    if protections()["landlock"]:
        _restrict_files([*read, *own_files()], write)
    if protections()["seccomp"]:
        program = b"".join(struct.pack("<HBBI", *each) for each in build_filter(*MACHINES[platform.machine()]))
        pointer = struct.pack("@HP", len(program) // 8, ctypes.addressof(kept := ctypes.create_string_buffer(program)))
        _call("prctl", 22, 2, pointer, 0, 0)
        del kept


def _call(name: str, *given: Any) -> int:
    """Call a function of the C library; raise OSError."""
    result: int = getattr(ctypes.CDLL(None, use_errno=True), name)(*given)
    if result < 0:
        raise OSError(ctypes.get_errno(), f"{name}: {os.strerror(ctypes.get_errno())}")
    return result


def _landlock_version() -> int:
    try:
        return _call("syscall", CREATE_RULESET, None, ctypes.c_size_t(0), 1)
    except OSError:  # an older kernel, or Landlock is switched off
        return 0


def _restrict_files(read: Iterable[Path], write: Iterable[Path]) -> None:
    """Allow some files and folders; forbid all others, TCP, and signals to other processes."""
    version = _landlock_version()
    handled = (1 << max(count for since, count in {1: 13, 2: 14, 3: 15, 5: 16}.items() if since <= version)) - 1
    attributes, size = (ctypes.c_uint64 * 3)(handled, 3, 3), 24 if version >= 6 else 16 if version >= 4 else 8
    rules = _call("syscall", CREATE_RULESET, attributes, ctypes.c_size_t(size), 0)
    for paths, rights in ((read, READ), (write, WRITE)):
        for path in paths:
            with suppress(FileNotFoundError):
                opened = os.open(path, os.O_PATH | os.O_CLOEXEC)
                allowed = rights & handled & (-1 if path.is_dir() else FILE)
                _call("syscall", ADD_RULE, rules, 1, struct.pack("=Qi", allowed, opened), 0)
                os.close(opened)
    _call("syscall", RESTRICT_SELF, rules, 0)
    os.close(rules)


@cache
def own_files() -> list[Path]:
    """Return our modules, and the libraries and tables that they open. A home may lie beside a package."""
    modules = [Path(str(import_module(name).__file__)).parent for name in ("lipcore", "lipserve", "service")]
    packages = [sysconfig.get_paths()[name] for name in ("stdlib", "platstdlib", "purelib", "platlib")]
    return [*modules, *map(Path, (*packages, "/usr/lib", "/lib", "/lib64", "/usr/share/zoneinfo"))]


def build_filter(machine: int, place: int) -> list[tuple[int, int, int, int]]:
    """Return a filter in classic BPF: (code, instructions to skip if true, if false, constant) each."""
    refuse, allow = (RETURN, 0, 0, REFUSE), (RETURN, 0, 0, ALLOW)
    program = [(LOAD, 0, 0, 4), (EQUAL, 1, 0, machine), (RETURN, 0, 0, KILL), (LOAD, 0, 0, 0)]
    program += [(AT_LEAST, 0, 1, 0x40000000), refuse]  # the calls of x32, a second set of the same calls
    # clone3, whose flags a filter cannot see: without it the C library uses clone, which may make threads only
    program += [(EQUAL, 0, 1, 435), (RETURN, 0, 0, 0x50000 | ENOSYS)]
    for numbers in FORBIDDEN.values():
        program += [] if numbers[place] is None else [(EQUAL, 0, 1, int(numbers[place] or 0)), refuse]
    program += [(EQUAL, 0, 4, (56, 220)[place]), (LOAD, 0, 0, 16), (ANY_BIT, 0, 1, 0x10000), allow, refuse]
    return [*program, allow]
