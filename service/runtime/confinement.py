"""Confinement of a process that reads an untrusted file, enforced by the kernel whatever code the file may run.

Memory, time and disk are limited; the process reads only the given files, and has no network or other processes.
The resource limits are POSIX. On Linux the process also drops its capabilities. Landlock restricts its files
(https://docs.kernel.org/userspace-api/landlock.html), and a seccomp filter the system calls. All are irrevocable.
"""

from __future__ import annotations

import ctypes
import os
import platform
import resource
import sys
import sysconfig
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from errno import ENOSYS, EPERM
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

LINUX = sys.platform == "linux"
MAX_OPEN_FILES = 256


@dataclass(frozen=True)
class Bounds:
    """Resource limits of one call.

    memory: bytes of address space beyond the current size of the process. cpu_s: processor time, s. file: max bytes of
    a file that it writes.
    """

    memory: int
    cpu_s: int
    file: int


@cache
def protections() -> dict[str, bool]:
    """Return the protections of this platform by name; a process is confined by all that are True."""
    return {
        "memory": LINUX,  # macOS accepts the limit but does not enforce it
        "processor": True,
        "landlock": LINUX and _landlock_version() > 0,
        "seccomp": _architecture() is not None and _has_filters(),
    }


def drop_privileges() -> None:
    """Give up rights, network and other processes for good, which no call needs; end with the parent.

    The process must have one thread. Raise OSError if a protection that `protections` names cannot be applied.
    """
    if LINUX:
        _call("prctl", Prctl.SET_PDEATHSIG, 9, 0, 0, 0)
        with suppress(OSError):  # another sandbox may forbid it
            Path("/proc/self/oom_score_adj").write_text("1000")
        _drop_capabilities()
        _call("prctl", Prctl.SET_NO_NEW_PRIVS, 1, 0, 0, 0)
    if protections()["seccomp"]:
        _filter_calls()


def confine(bounds: Bounds, read: Iterable[Path], write: Iterable[Path]) -> None:
    """Give up all resources and files that a call does not need.

    read, write: files and folders that it keeps; it can always read its own modules. Raise OSError as `drop_privileges`
    does.
    """
    has = protections()
    _limit(bounds, has["memory"])
    if has["landlock"]:
        _restrict_files([*read, *own_files()], write)


def _limit(bounds: Bounds, memory: bool) -> None:
    limits = {
        resource.RLIMIT_CPU: bounds.cpu_s,
        resource.RLIMIT_FSIZE: bounds.file,
        resource.RLIMIT_NOFILE: MAX_OPEN_FILES,
        resource.RLIMIT_CORE: 0,
    }
    if memory:
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        limits[resource.RLIMIT_AS] = pages * resource.getpagesize() + bounds.memory
    for kind, most in limits.items():
        hard = resource.getrlimit(kind)[1]
        soft = most if hard == resource.RLIM_INFINITY else min(most, hard)
        # a process that ignores the signal of its processor time is killed a second later
        spare = 1 if kind == resource.RLIMIT_CPU else 0
        resource.setrlimit(kind, (soft, soft + spare if hard == resource.RLIM_INFINITY else min(soft + spare, hard)))


class Prctl(IntEnum):
    """Options of the system call `prctl`."""

    SET_PDEATHSIG = 1
    GET_SECCOMP = 21
    SET_SECCOMP = 22
    SET_NO_NEW_PRIVS = 38


class Landlock(IntEnum):
    """System calls of Landlock, with the same numbers on all machines."""

    CREATE_RULESET = 444
    ADD_RULE = 445
    RESTRICT_SELF = 446


def _call(name: str, *given: Any) -> int:
    """Call a function of the C library; raise OSError."""
    result: int = getattr(ctypes.CDLL(None, use_errno=True), name)(*given)
    if result < 0:
        number = ctypes.get_errno()
        raise OSError(number, f"{name}: {os.strerror(number)}")
    return result


def _drop_capabilities() -> None:
    header, none = (ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)()  # version 3
    _call("capset", header, none)


def _landlock_version() -> int:
    try:
        return _call("syscall", Landlock.CREATE_RULESET, None, ctypes.c_size_t(0), 1)
    except OSError:  # an older kernel, or Landlock is switched off
        return 0


class Rights(IntFlag):
    """Landlock's rights on given files: none on links, pipes, sockets or devices."""

    WRITE_FILE = 1 << 1
    READ_FILE = 1 << 2
    READ_DIR = 1 << 3
    REMOVE_DIR = 1 << 4
    REMOVE_FILE = 1 << 5
    MAKE_DIR = 1 << 7
    MAKE_FILE = 1 << 8
    TRUNCATE = 1 << 14
    READ = READ_FILE | READ_DIR
    FILE = WRITE_FILE | READ_FILE | TRUNCATE
    """Rights on a file, as opposed to a folder."""
    WRITE = READ | FILE | REMOVE_DIR | REMOVE_FILE | MAKE_DIR | MAKE_FILE


class _Rule(ctypes.Structure):
    _pack_ = 1
    _fields_ = (("allowed", ctypes.c_uint64), ("parent", ctypes.c_int32))


def _restrict_files(read: Iterable[Path], write: Iterable[Path]) -> None:
    """Allow some files and folders; forbid all others, TCP and signals to other processes."""
    version = _landlock_version()
    rights_since = {1: 13, 2: 14, 3: 15, 5: 16}  # number of rights by the version that added them
    handled = (1 << max(count for since, count in rights_since.items() if since <= version)) - 1
    # files; TCP bind and connect, from version 4; abstract sockets and signals, from version 6
    attributes = (ctypes.c_uint64 * 3)(handled, 3, 3)
    size = ctypes.c_size_t(8 * (3 if version >= 6 else 2 if version >= 4 else 1))
    rules = _call("syscall", Landlock.CREATE_RULESET, attributes, size, 0)
    for paths, rights in ((read, Rights.READ), (write, Rights.WRITE)):
        for path in paths:
            with suppress(FileNotFoundError):
                opened = os.open(path, os.O_PATH | os.O_CLOEXEC)
                allowed = rights & handled & (-1 if path.is_dir() else Rights.FILE)
                _call("syscall", Landlock.ADD_RULE, rules, 1, ctypes.byref(_Rule(allowed, opened)), 0)
                os.close(opened)
    _call("syscall", Landlock.RESTRICT_SELF, rules, 0)
    os.close(rules)


@cache
def own_files() -> list[Path]:
    """Return our modules, and the libraries and tables that they open.

    Other files beside a package are left out; a home may lie there.
    """
    modules = [Path(str(import_module(name).__file__)).parent for name in ("lipcore", "lipserve", "service")]
    python = [Path(each) for name, each in sysconfig.get_paths().items() if name in ("stdlib", "platstdlib")]
    packages = [Path(each) for name, each in sysconfig.get_paths().items() if name in ("purelib", "platlib")]
    return [*modules, *python, *packages, *map(Path, ("/usr/lib", "/lib", "/lib64", "/usr/share/zoneinfo"))]


_ARCHITECTURES = {"x86_64": (0xC000003E, 0), "aarch64": (0xC00000B7, 1)}
"""By machine: its number in a filter, and its column in the tables below."""
FORBIDDEN_CALLS = {
    **{"socket": (41, 198), "socketpair": (53, 199)},
    **{"execve": (59, 221), "execveat": (322, 281), "fork": (57, None), "vfork": (58, None)},
    **{"ptrace": (101, 117), "process_vm_readv": (310, 270), "process_vm_writev": (311, 271)},
    **{"pidfd_open": (434, 434), "pidfd_getfd": (438, 438), "pidfd_send_signal": (424, 424)},
    **{"rt_sigqueueinfo": (129, 138), "tkill": (200, 130)},
    **{"setpriority": (141, 140), "ioprio_set": (251, 30), "sched_setparam": (142, 118)},
    **{"sched_setscheduler": (144, 119), "sched_setattr": (314, 274), "sched_setaffinity": (203, 122)},
    **{"migrate_pages": (256, 238), "move_pages": (279, 239)},
    **{"shmget": (29, 194), "semget": (64, 190), "msgget": (68, 186), "mq_open": (240, 180)},
    **{"add_key": (248, 217), "request_key": (249, 218), "keyctl": (250, 219)},
    **{"unshare": (272, 97), "setns": (308, 268), "bpf": (321, 280), "userfaultfd": (323, 282)},
    **{"perf_event_open": (298, 241), "io_uring_setup": (425, 425), "io_uring_enter": (426, 426)},
}
"""Numbers of forbidden system calls (x86_64, aarch64): network, other programs and processes, objects that outlive a
process, and kernel parts that were exploited often."""
SELF_ONLY_CALLS = {"kill": (62, 129), "tgkill": (234, 131), "rt_tgsigqueueinfo": (297, 240), "prlimit64": (302, 261)}
"""System calls that a process may apply only to itself: their first argument is a process."""
Instruction = tuple[int, int, int, int]


class Code(IntEnum):
    """Instructions of a filter: classic BPF."""

    LOAD = 0x20
    EQUAL = 0x15
    AT_LEAST = 0x35
    ANY_BIT = 0x45
    RETURN = 0x06


class Action(IntEnum):
    """Results of a filter."""

    ALLOW = 0x7FFF0000
    KILL = 0x80000000
    ERROR = 0x50000


class CallOffset(IntEnum):
    """Offsets of the call's number, the machine, and the lower half of the first argument."""

    NUMBER = 0
    MACHINE = 4
    FIRST = 16


class _Instruction(ctypes.Structure):
    _fields_ = (("code", ctypes.c_uint16), ("yes", ctypes.c_uint8), ("no", ctypes.c_uint8), ("k", ctypes.c_uint32))


class _Program(ctypes.Structure):
    _fields_ = (("length", ctypes.c_uint16), ("instructions", ctypes.POINTER(_Instruction)))


def _architecture() -> tuple[int, int] | None:
    return _ARCHITECTURES.get(platform.machine()) if LINUX and sys.byteorder == "little" else None


def _has_filters() -> bool:
    return LINUX and ctypes.CDLL(None).prctl(Prctl.GET_SECCOMP, 0, 0, 0, 0) >= 0


def _filter_calls() -> None:
    machine, place = _ARCHITECTURES[platform.machine()]
    made = (_Instruction * len(program := build_filter(machine, place, os.getpid())))(
        *(_Instruction(*each) for each in program)
    )
    _call("prctl", Prctl.SET_SECCOMP, 2, ctypes.byref(_Program(len(made), made)), 0, 0)


def build_filter(machine: int, place: int, pid: int) -> Sequence[Instruction]:
    """Return the filter's program: (code, steps to skip if true, if false, constant) each."""
    refuse, allow = (Code.RETURN, 0, 0, Action.ERROR | EPERM), (Code.RETURN, 0, 0, Action.ALLOW)
    program = [
        (Code.LOAD, 0, 0, CallOffset.MACHINE),
        (Code.EQUAL, 1, 0, machine),
        (Code.RETURN, 0, 0, Action.KILL),
        (Code.LOAD, 0, 0, CallOffset.NUMBER),
        (Code.AT_LEAST, 0, 1, 0x40000000),  # the calls of x32, a second set of the same calls
        refuse,
        (Code.EQUAL, 0, 1, 435),  # clone3: a filter cannot see its flags; without it the C library uses `clone`
        (Code.RETURN, 0, 0, Action.ERROR | ENOSYS),
    ]
    for numbers in FORBIDDEN_CALLS.values():
        if (number := numbers[place]) is not None:
            program += [(Code.EQUAL, 0, 1, number), refuse]
    # clone may make threads, not processes
    program += [
        (Code.EQUAL, 0, 4, (56, 220)[place]),
        (Code.LOAD, 0, 0, CallOffset.FIRST),
        (Code.ANY_BIT, 0, 1, 0x10000),
        allow,
        refuse,
    ]
    for numbers in SELF_ONLY_CALLS.values():
        program += [(Code.EQUAL, 0, 5, numbers[place]), (Code.LOAD, 0, 0, CallOffset.FIRST)]
        program += [(Code.EQUAL, 1, 0, pid), (Code.EQUAL, 0, 1, 0), allow, refuse]
    return [*program, allow]
