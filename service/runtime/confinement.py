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
from errno import ENOSYS, EPERM
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

LINUX = sys.platform == "linux"
OPEN_FILES = 256
PACKAGES = ("lipcore", "lipserve", "service")


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
        _call("prctl", _SET_PDEATHSIG, 9, 0, 0, 0)
        with suppress(OSError):  # a sandbox of its own may have closed it
            Path("/proc/self/oom_score_adj").write_text("1000")
        _drop_capabilities()
        _call("prctl", _SET_NO_NEW_PRIVS, 1, 0, 0, 0)
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


_SET_PDEATHSIG, _GET_SECCOMP, _SET_SECCOMP, _SET_NO_NEW_PRIVS = 1, 21, 22, 38
_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446
_CAPABILITY_VERSION = 0x20080522


def _call(name: str, *given: Any) -> int:
    """Call a function of the C library; raise OSError."""
    result: int = getattr(ctypes.CDLL(None, use_errno=True), name)(*given)
    if result < 0:
        number = ctypes.get_errno()
        raise OSError(number, f"{name}: {os.strerror(number)}")
    return result


def _drop_capabilities() -> None:
    header, none = (ctypes.c_uint32 * 2)(_CAPABILITY_VERSION, 0), (ctypes.c_uint32 * 6)()
    _call("capset", header, none)


def _landlock_version() -> int:
    try:
        return _call("syscall", _CREATE_RULESET, None, ctypes.c_size_t(0), 1)
    except OSError:  # an older kernel, or one that was started without it
        return 0


READ = 1 << 2 | 1 << 3
"""Of Landlock's rights on files: to read a file, to list a folder."""
FILE = 1 << 1 | 1 << 2 | 1 << 14
"""To write, read, truncate: what can be done with a file that is none of its folder's business."""
WRITE = READ | FILE | 1 << 4 | 1 << 5 | 1 << 7 | 1 << 8
"""And to remove and make folders and plain files: no links, pipes, sockets or devices."""
_FILE_RIGHTS = {1: 13, 2: 14, 3: 15, 5: 16}
"""How many rights on files there are from a version on."""


class _Rule(ctypes.Structure):
    _pack_ = 1
    _fields_ = (("allowed", ctypes.c_uint64), ("parent", ctypes.c_int32))


def _keep_files(read: Iterable[Path], write: Iterable[Path]) -> None:
    """Keep some files and folders; all else, TCP and processes outside are out of reach."""
    version = _landlock_version()
    handled = (1 << max(count for since, count in _FILE_RIGHTS.items() if since <= version)) - 1
    # files; TCP, from version 4 on: to bind and connect; abstract sockets and signals, from version 6 on
    attributes = (ctypes.c_uint64 * 3)(handled, 3, 3)
    size = ctypes.c_size_t(8 * (3 if version >= 6 else 2 if version >= 4 else 1))
    rules = _call("syscall", _CREATE_RULESET, attributes, size, 0)
    for paths, rights in ((read, READ), (write, WRITE)):
        for path in paths:
            with suppress(FileNotFoundError):
                opened = os.open(path, os.O_PATH | os.O_CLOEXEC)
                allowed = rights & handled & (-1 if path.is_dir() else FILE)
                _call("syscall", _ADD_RULE, rules, 1, ctypes.byref(_Rule(allowed, opened)), 0)
                os.close(opened)
    _call("syscall", _RESTRICT_SELF, rules, 0)
    os.close(rules)


@cache
def own_files() -> list[Path]:
    """Modules, and the libraries and tables that they open. Not what else lies beside a package, as a home may."""
    modules = [Path(str(import_module(name).__file__)).parent for name in PACKAGES]
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
CLONE, CLONE3 = (56, 220), (435, 435)
_THREAD = 0x10000
"""Of the flags of `clone`: a thread, not a process."""
_LOAD, _EQUAL, _AT_LEAST, _ANY_BIT, _RETURN = 0x20, 0x15, 0x35, 0x45, 0x06
_ALLOW, _KILL, _ERROR = 0x7FFF0000, 0x80000000, 0x50000
_NUMBER, _MACHINE, _FIRST = 0, 4, 16
"""Where the number of a call, the machine and the lower half of the first argument lie."""
Instruction = tuple[int, int, int, int]


class _Instruction(ctypes.Structure):
    _fields_ = (("code", ctypes.c_uint16), ("yes", ctypes.c_uint8), ("no", ctypes.c_uint8), ("k", ctypes.c_uint32))


class _Program(ctypes.Structure):
    _fields_ = (("length", ctypes.c_uint16), ("instructions", ctypes.POINTER(_Instruction)))


def _architecture() -> tuple[int, int] | None:
    return _ARCHITECTURES.get(platform.machine()) if LINUX and sys.byteorder == "little" else None


def _has_filters() -> bool:
    return LINUX and ctypes.CDLL(None).prctl(_GET_SECCOMP, 0, 0, 0, 0) >= 0


def _filter_calls() -> None:
    machine, place = _ARCHITECTURES[platform.machine()]
    made = (_Instruction * len(program := calls(machine, place, os.getpid())))(
        *(_Instruction(*each) for each in program)
    )
    _call("prctl", _SET_SECCOMP, 2, ctypes.byref(_Program(len(made), made)), 0, 0)


def calls(machine: int, place: int, pid: int) -> Sequence[Instruction]:
    """The filter's program: (code, steps over where true, where false, constant) each."""
    refuse, allow = (_RETURN, 0, 0, _ERROR | EPERM), (_RETURN, 0, 0, _ALLOW)
    program = [
        (_LOAD, 0, 0, _MACHINE),
        (_EQUAL, 1, 0, machine),
        (_RETURN, 0, 0, _KILL),
        (_LOAD, 0, 0, _NUMBER),
        (_AT_LEAST, 0, 1, 0x40000000),  # the calls of x32, which are the same once more
        refuse,
        (_EQUAL, 0, 1, CLONE3[place]),  # its flags cannot be seen; without it the C library takes `clone`
        (_RETURN, 0, 0, _ERROR | ENOSYS),
    ]
    for numbers in FORBIDDEN.values():
        if (number := numbers[place]) is not None:
            program += [(_EQUAL, 0, 1, number), refuse]
    program += [(_EQUAL, 0, 4, CLONE[place]), (_LOAD, 0, 0, _FIRST), (_ANY_BIT, 0, 1, _THREAD), allow, refuse]
    for numbers in OF_ITSELF.values():
        program += [(_EQUAL, 0, 5, numbers[place]), (_LOAD, 0, 0, _FIRST)]
        program += [(_EQUAL, 1, 0, pid), (_EQUAL, 0, 1, 0), allow, refuse]
    return [*program, allow]
