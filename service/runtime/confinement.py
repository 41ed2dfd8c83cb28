"""What a process that reads a stranger's file is left with: so much memory, time and disk, the files that it is given,
no network, no other process. Each is what the kernel keeps to, whatever code the file may bring to run.

Limits of resources are POSIX. On Linux capabilities are given up, Landlock keeps the process from files
(https://docs.kernel.org/userspace-api/landlock.html), and a seccomp filter from system calls that no parser makes. All
are irrevocable.
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
OPEN_FILES = 256


@dataclass(frozen=True)
class Bounds:
    """memory: bytes of address space beyond what the process has now; cpu_s: of processor time; file: bytes of the
    largest file that it may write."""

    memory: int
    cpu_s: int
    file: int


@cache
def protections() -> dict[str, bool]:
    """What this platform has, by name; a process is confined by all of it. Nothing is changed by asking."""
    return {
        "memory": LINUX,  # macOS takes the limit, and does not keep to it
        "processor": True,
        "landlock": LINUX and _landlock_version() > 0,
        "seccomp": _architecture() is not None and _has_filters(),
    }


def renounce() -> None:
    """Give up for good what no call needs: rights, the network, other processes. This one has one thread, and ends with
    the one that has forked it. Raise OSError where anything that `protections` names cannot be had."""
    if LINUX:
        _call("prctl", Prctl.SET_PDEATHSIG, 9, 0, 0, 0)
        with suppress(OSError):  # a sandbox of its own may have closed it
            Path("/proc/self/oom_score_adj").write_text("1000")
        _drop_capabilities()
        _call("prctl", Prctl.SET_NO_NEW_PRIVS, 1, 0, 0, 0)
    if protections()["seccomp"]:
        _filter_calls()


def confine(bounds: Bounds, read: Iterable[Path], write: Iterable[Path]) -> None:
    """Give up what a call does not need, either: all resources and files but some.

    read, write: files and folders that it keeps; it can read its own modules, too. Raise OSError as `renounce` does.
    """
    has = protections()
    _limit(bounds, has["memory"])
    if has["landlock"]:
        _keep_files([*read, *own_files()], write)


def _limit(bounds: Bounds, memory: bool) -> None:
    limits = {
        resource.RLIMIT_CPU: bounds.cpu_s,
        resource.RLIMIT_FSIZE: bounds.file,
        resource.RLIMIT_NOFILE: OPEN_FILES,
        resource.RLIMIT_CORE: 0,
    }
    if memory:
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        limits[resource.RLIMIT_AS] = pages * resource.getpagesize() + bounds.memory
    for kind, most in limits.items():
        hard = resource.getrlimit(kind)[1]
        soft = most if hard == resource.RLIM_INFINITY else min(most, hard)
        # a process that passes over the signal of its processor time is ended a second later
        spare = 1 if kind == resource.RLIMIT_CPU else 0
        resource.setrlimit(kind, (soft, soft + spare if hard == resource.RLIM_INFINITY else min(soft + spare, hard)))


class Prctl(IntEnum):
    """Options of the system call `prctl`."""

    SET_PDEATHSIG = 1
    GET_SECCOMP = 21
    SET_SECCOMP = 22
    SET_NO_NEW_PRIVS = 38


class Landlock(IntEnum):
    """System calls of Landlock, numbered alike on all machines."""

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
    except OSError:  # an older kernel, or one that was started without it
        return 0


class Rights(IntFlag):
    """Landlock's rights on files that are given: none to links, pipes, sockets or devices."""

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
    """Rights that a file has, and not its folder."""
    WRITE = READ | FILE | REMOVE_DIR | REMOVE_FILE | MAKE_DIR | MAKE_FILE


class _Rule(ctypes.Structure):
    _pack_ = 1
    _fields_ = (("allowed", ctypes.c_uint64), ("parent", ctypes.c_int32))


def _keep_files(read: Iterable[Path], write: Iterable[Path]) -> None:
    """Keep some files and folders; all else, TCP and processes outside are out of reach."""
    version = _landlock_version()
    rights_since = {1: 13, 2: 14, 3: 15, 5: 16}  # how many there are from a version on
    handled = (1 << max(count for since, count in rights_since.items() if since <= version)) - 1
    # files; TCP, from version 4 on: to bind and connect; abstract sockets and signals, from version 6 on
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
    """Modules, and the libraries and tables that they open. Not what else lies beside a package, as a home may."""
    modules = [Path(str(import_module(name).__file__)).parent for name in ("lipcore", "lipserve", "service")]
    python = [Path(each) for name, each in sysconfig.get_paths().items() if name in ("stdlib", "platstdlib")]
    packages = [Path(each) for name, each in sysconfig.get_paths().items() if name in ("purelib", "platlib")]
    return [*modules, *python, *packages, *map(Path, ("/usr/lib", "/lib", "/lib64", "/usr/share/zoneinfo"))]


_ARCHITECTURES = {"x86_64": (0xC000003E, 0), "aarch64": (0xC00000B7, 1)}
"""By the name of a machine: what a filter sees of it, and the place of its numbers in the tables below."""
FORBIDDEN = {
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
"""Numbers of system calls (x86_64, aarch64): the network, other programs and processes, what outlives a process, and
parts of the kernel that have been the way in for many an attack."""
OF_ITSELF = {"kill": (62, 129), "tgkill": (234, 131), "rt_tgsigqueueinfo": (297, 240), "prlimit64": (302, 261)}
"""Those that a process may do to itself: their first argument is a process."""
Instruction = tuple[int, int, int, int]


class Code(IntEnum):
    """Instructions of a filter: classic BPF."""

    LOAD = 0x20
    EQUAL = 0x15
    AT_LEAST = 0x35
    ANY_BIT = 0x45
    RETURN = 0x06


class Action(IntEnum):
    """Answers of a filter."""

    ALLOW = 0x7FFF0000
    KILL = 0x80000000
    ERROR = 0x50000


class At(IntEnum):
    """Where the number of a call, the machine and the lower half of the first argument lie."""

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
    made = (_Instruction * len(program := calls(machine, place, os.getpid())))(
        *(_Instruction(*each) for each in program)
    )
    _call("prctl", Prctl.SET_SECCOMP, 2, ctypes.byref(_Program(len(made), made)), 0, 0)


def calls(machine: int, place: int, pid: int) -> Sequence[Instruction]:
    """The filter's program: (code, steps over where true, where false, constant) each."""
    refuse, allow = (Code.RETURN, 0, 0, Action.ERROR | EPERM), (Code.RETURN, 0, 0, Action.ALLOW)
    program = [
        (Code.LOAD, 0, 0, At.MACHINE),
        (Code.EQUAL, 1, 0, machine),
        (Code.RETURN, 0, 0, Action.KILL),
        (Code.LOAD, 0, 0, At.NUMBER),
        (Code.AT_LEAST, 0, 1, 0x40000000),  # the calls of x32, which are the same once more
        refuse,
        (Code.EQUAL, 0, 1, 435),  # clone3: its flags cannot be seen; without it the C library takes `clone`
        (Code.RETURN, 0, 0, Action.ERROR | ENOSYS),
    ]
    for numbers in FORBIDDEN.values():
        if (number := numbers[place]) is not None:
            program += [(Code.EQUAL, 0, 1, number), refuse]
    # clone makes threads, not processes
    program += [
        (Code.EQUAL, 0, 4, (56, 220)[place]),
        (Code.LOAD, 0, 0, At.FIRST),
        (Code.ANY_BIT, 0, 1, 0x10000),
        allow,
        refuse,
    ]
    for numbers in OF_ITSELF.values():
        program += [(Code.EQUAL, 0, 5, numbers[place]), (Code.LOAD, 0, 0, At.FIRST)]
        program += [(Code.EQUAL, 1, 0, pid), (Code.EQUAL, 0, 1, 0), allow, refuse]
    return [*program, allow]
