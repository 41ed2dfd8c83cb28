"""Real-time scheduling of one thread, as far as the system permits it (Linux only).

A thread with policy SCHED_FIFO runs before every thread of plain priority. Nothing here raises an error: a refusal is
reported with its reason and a remedy. Soft limits of the process are raised to its hard limits. Three rules protect
machine and process:

- The kernel keeps 5 % of the time for other threads (`sched_rt_runtime_us`). If this is off, a thread that has only
  one CPU stays at plain priority, because a loop without end would halt the machine.
- A finite RLIMIT_RTTIME kills a thread that never waits. A service that answers without a pause never waits. With
  such a limit, the thread stays at plain priority.
- Pages are locked only if the size is unlimited. Otherwise a later allocation would fail.
"""

from __future__ import annotations

import ctypes
import mmap
import os
import resource
import sys
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

PRIORITY = 10
"""Priority of SCHED_FIFO: below the interrupt threads of a PREEMPT_RT kernel (50) and below the usual 80 to 99 of a
robot's own controller, so that both interrupt the service."""
_RT_TIME = Path("/proc/sys/kernel/sched_rt_runtime_us"), Path("/proc/sys/kernel/sched_rt_period_us")
_ISOLATED = Path("/sys/devices/system/cpu/isolated")
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
_MLOCK_ONFAULT = 1


@dataclass(frozen=True)
class Refusal:
    """What the system refuses, why, and what to do."""

    what: Literal["policy", "pages"]
    reason: str
    remedy: str


@dataclass(frozen=True)
class RealTime:
    """What the system granted."""

    policy: Literal["fifo", "other"] = "other"
    """SCHED_FIFO, or the usual policy SCHED_OTHER."""
    priority: int = 0
    """Priority of SCHED_FIFO, 1 to 99; 0 for the usual policy."""
    pages_locked: bool = False
    """Whether pages of the process stay in memory."""
    cpus: tuple[int, ...] | None = None
    """Isolated CPU that the thread is pinned to; None if it may use all CPUs of the process."""
    refusals: tuple[Refusal, ...] = ()


_NO_LINUX = RealTime(refusals=(Refusal("policy", "the system is not Linux", "Run the service on Linux."),))


def enter_real_time(priority: int = PRIORITY, lock_pages: bool = True, inherit: bool = False) -> RealTime:
    """Give the calling thread real-time priority and lock the pages of its process, as far as that is permitted.

    Call it after the threads that help this one are started: a thread inherits a pinned CPU. Keep their work short:
    while one of them holds Python's lock, this thread waits for it at plain priority.

    Args:
        priority: Priority of SCHED_FIFO, 1 to 99. A lower one is used if the limit is lower.
        lock_pages: Whether to lock the pages of the process. A page is locked when it is first used: locking all at
            once would copy every page that the process shares with its parent, and fill the stacks of all threads.
        inherit: Whether threads and processes that this thread starts get its priority. By default they do not.

    Returns:
        What was granted. The thread is pinned only to an isolated CPU, and only if it may use other CPUs, too: without
        isolation, the scheduler finds a free CPU sooner.

    Example:
        >>> granted = enter_real_time()
        >>> granted.policy in ("fifo", "other")
        True
    """
    if not sys.platform.startswith("linux"):
        return _NO_LINUX
    granted = _become_fifo(priority, inherit)
    refusals = [granted] if isinstance(granted, Refusal) else []
    if lock_pages and (refusal := _lock_pages()) is not None:
        refusals.append(refusal)
    fifo = not isinstance(granted, Refusal)
    return RealTime(
        "fifo" if fifo else "other",
        granted if isinstance(granted, int) else 0,
        lock_pages and not any(each.what == "pages" for each in refusals),
        _pin() if fifo else None,
        tuple(refusals),
    )


def probe_real_time() -> RealTime:
    """Return what `enter_real_time` would grant: it is tried in a thread that ends. No page stays locked."""
    if not sys.platform.startswith("linux"):
        return _NO_LINUX
    tried: list[RealTime] = []
    thread = threading.Thread(target=lambda: tried.append(enter_real_time(lock_pages=False)), name="probe-real-time")
    thread.start()
    thread.join()
    granted, refusal = tried[0], _refused_lock()
    refusals = granted.refusals if refusal is None else (*granted.refusals, refusal)
    return RealTime(granted.policy, granted.priority, refusal is None, granted.cpus, refusals)


def _become_fifo(priority: int, inherit: bool) -> int | Refusal:
    """Return the granted priority."""
    if (refusal := _unsafe()) is not None:
        return refusal
    flags = os.SCHED_FIFO | (0 if inherit else os.SCHED_RESET_ON_FORK)
    limit = _raised(resource.RLIMIT_RTPRIO)
    permitted = priority if limit == resource.RLIM_INFINITY else min(priority, limit)
    for each in dict.fromkeys((priority, permitted)):  # with CAP_SYS_NICE, the limit does not count
        try:
            if each > 0:
                os.sched_setscheduler(0, flags, os.sched_param(each))
                return each
        except OSError:
            continue
    if permitted > 0:
        return Refusal(
            "policy",
            f"RLIMIT_RTPRIO is {limit}, but the control group or a sandbox forbids SCHED_FIFO",
            "Boot with `rt_group_sched=0`, or start Docker with `--cpu-rt-runtime=950000`; check the seccomp profile.",
        )
    return Refusal(
        "policy",
        "RLIMIT_RTPRIO is 0 and CAP_SYS_NICE is missing",
        "Docker: `--ulimit rtprio=99` or, for root, `--cap-add SYS_NICE`. systemd: `LimitRTPRIO=99`. "
        "Login: `@realtime - rtprio 99` in /etc/security/limits.conf.",
    )


def _unsafe() -> Refusal | None:
    """Return why a thread of SCHED_FIFO would endanger the machine or the process."""
    if (limit := _raised(resource.RLIMIT_RTTIME)) != resource.RLIM_INFINITY:
        reason = f"RLIMIT_RTTIME is {limit} µs: the kernel would kill a busy service"
        return Refusal("policy", reason, "Remove this limit (systemd: `LimitRTTIME=infinity`).")
    if len(os.sched_getaffinity(0)) > 1 or not is_real_time_unlimited():
        return None
    reason = "there is one CPU, and sched_rt_runtime_us leaves no time for other threads"
    return Refusal("policy", reason, "Allow two CPUs, or run `sysctl kernel.sched_rt_runtime_us=950000`.")


def is_real_time_unlimited() -> bool:
    """Return whether real-time threads may use all the time of a CPU."""
    try:
        runtime, period = (int(path.read_text()) for path in _RT_TIME)
    except (OSError, ValueError):
        return False  # the kernel's default
    return not 0 <= runtime < period


def _lock_pages() -> Refusal | None:
    """Lock the pages of the process, present and future ones."""
    if (refusal := _refused_lock()) is not None:
        return refusal
    library = ctypes.CDLL(None, use_errno=True)
    if library.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT) == 0:
        return None
    reason = f"mlockall failed: {os.strerror(ctypes.get_errno())}"
    return Refusal("pages", reason, "Check the seccomp profile of the container.")


def _refused_lock() -> Refusal | None:
    """Return why pages cannot be locked. Locks a page more than the limit for a moment: none of it is ever used."""
    limit = _raised(resource.RLIMIT_MEMLOCK)
    if limit == resource.RLIM_INFINITY or _can_lock(limit + mmap.PAGESIZE):
        return None
    return Refusal(
        "pages",
        f"RLIMIT_MEMLOCK is {limit // 1024} KiB and CAP_IPC_LOCK is missing",
        "Docker: `--ulimit memlock=-1` or, for root, `--cap-add IPC_LOCK`. systemd: `LimitMEMLOCK=infinity`. "
        "Login: `@realtime - memlock unlimited` in /etc/security/limits.conf.",
    )


def _can_lock(size: int) -> bool:
    library = ctypes.CDLL(None, use_errno=True)
    if not hasattr(library, "mlock2"):
        return False
    library.mlock2.argtypes = (ctypes.c_void_p, ctypes.c_size_t, ctypes.c_uint)
    try:
        with mmap.mmap(-1, size, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | getattr(mmap, "MAP_NORESERVE", 0)) as region:
            start = ctypes.c_char.from_buffer(region)
            refused = library.mlock2(ctypes.addressof(start), size, _MLOCK_ONFAULT)
            del start  # a region in use cannot be closed
    except (OSError, ValueError, OverflowError):
        return False
    return bool(refused == 0)


def _pin() -> tuple[int, ...] | None:
    """Pin the calling thread to the first isolated CPU that it may use; return it."""
    allowed = os.sched_getaffinity(0)
    isolated = sorted(allowed & read_cpus(_ISOLATED))
    if not isolated or len(allowed) == 1:
        return None
    os.sched_setaffinity(0, isolated[:1])
    return (isolated[0],)


def read_cpus(path: Path) -> set[int]:
    """Return the CPUs of a list such as `0-2,5`; no CPU if the file is missing."""
    try:
        text = path.read_text().strip()
        ranges = [each.partition("-") for each in text.split(",") if each]
        return {cpu for first, _, last in ranges for cpu in range(int(first), int(last or first) + 1)}
    except (OSError, ValueError):
        return set()


def _raised(kind: int) -> int:
    """Raise a limit of the process to its hard limit; return the limit."""
    soft, hard = resource.getrlimit(kind)
    try:
        if soft != hard:
            resource.setrlimit(kind, (hard, hard))
    except (OSError, ValueError):  # a sandbox forbids it
        return soft
    return hard
