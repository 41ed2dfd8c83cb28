"""Memory, files and the disk of the home."""

from __future__ import annotations

import os
import re
import resource
import shutil
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from service.cli.doctor.findings import Finding, System
from service.foundation.settings import Settings

MEMORY, DISK = "Memory", "Disk"
GIB = 2**30
MIN_FREE_BYTES = GIB
"""Free memory and free disk below which there is a warning."""
MAX_SYNC_MS = 10.0
"""Median time to sync 4 KiB above which there is a warning. A hard disk takes about 10 ms."""
SYNCS, SYNC_S = 100, 1.0
"""Max number of syncs that are measured, and max time for them, s."""
KINDS_WITHOUT_LOCKS = ("nfs", "cifs", "smb", "9p", "fuse", "ceph", "glusterfs")


def memory(system: System, pages_locked: bool) -> Iterator[Finding]:
    """Yield memory and its limit, and swap. pages_locked: whether the service may lock its pages."""
    known = system.fields("proc/meminfo")
    sizes = {name: int(text.split()[0]) * 1024 for name, text in known.items() if text[:1].isdigit()}
    if not {"MemTotal", "MemAvailable"} <= sizes.keys():
        yield Finding(MEMORY, "memory", "not readable", "unknown")
    else:
        yield _free_memory(system, sizes["MemTotal"], sizes["MemAvailable"])
    swap = sizes.get("SwapTotal")
    if swap is None:
        yield Finding(MEMORY, "swap", "not readable", "unknown")
    elif not swap:
        yield Finding(MEMORY, "swap", "none")
    elif pages_locked:
        yield Finding(MEMORY, "swap", f"{_gib(swap)}; locked pages are not swapped")
    else:
        advice = "An answer that needs a swapped page waits for the disk. Permit locked pages, or run `swapoff -a`."
        yield Finding(MEMORY, "swap", _gib(swap), "warning", advice)


def _free_memory(system: System, total: int, available: int) -> Finding:
    limits = [(total, available, "")]
    for folder in system.control_groups("memory"):
        for limit, usage in (("max", "current"), ("limit_in_bytes", "usage_in_bytes")):
            most, used = (system.number(f"{folder}/memory.{each}") for each in (limit, usage))
            if most is not None and most < total:
                limits.append((most, most - (used or 0), ", limit of the control group"))
    most, free, whose = min(limits, key=lambda each: each[1])
    value = f"{_gib(free)} free of {_gib(most)}{whose}"
    if free >= MIN_FREE_BYTES:
        return Finding(MEMORY, "memory", value)
    advice = "A service that learns needs 1.5 GiB. Stop other programs or raise the limit (Docker: `--memory`)."
    return Finding(MEMORY, "memory", value, "warning", advice)


def open_files(connections: int) -> Finding:
    """Return the limit on open files. connections: max connections of a service."""
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY or soft >= connections + SPARE_FILES:
        return Finding(MEMORY, "open files", "not limited" if soft == resource.RLIM_INFINITY else str(soft))
    advice = f"{connections} connections (LIPSERVE_MAX_CONNECTIONS) need more. Run `ulimit -n 4096` before the service."
    return Finding(MEMORY, "open files", str(soft), "warning", advice)


SPARE_FILES = 256
"""Files that a service opens beside its connections."""


def disk(system: System, settings: Settings) -> Iterator[Finding]:
    """Yield kind, free space and speed of the disk of the home."""
    home = settings.home.absolute()
    folder = next(each for each in (home, *home.parents) if os.path.isdir(each))
    yield Finding(DISK, "home", f"{home}" + ("" if folder == home else " (does not exist yet)"))
    yield _kind(system, folder)
    free, least = shutil.disk_usage(folder).free, max(MIN_FREE_BYTES, settings.min_free_bytes)
    advice = "Delete data sets or versions, or use a larger disk: LIPSERVE_HOME."
    yield Finding(DISK, "free space", _gib(free), *(() if free >= least else ("warning", advice)))
    yield _sync(folder)


def _kind(system: System, folder: Path) -> Finding:
    kind = file_system_of(system, folder.resolve())
    if kind is None:
        return Finding(DISK, "file system", "not readable", "unknown")
    advice = ""
    if kind.startswith(KINDS_WITHOUT_LOCKS):
        advice = "SQLite needs the locks of a local file system. Put LIPSERVE_HOME on a local disk."
    elif kind in ("tmpfs", "ramfs"):
        advice = "This home is lost at the next start. Put LIPSERVE_HOME on a disk."
    elif kind == "overlay":
        advice = "This home is deleted with its container. Mount a volume (Docker: `-v lipserve:/data`)."
    return Finding(DISK, "file system", kind, "warning" if advice else "ok", advice)


def file_system_of(system: System, folder: Path) -> str | None:
    """Return the kind of the file system that holds a folder. folder: absolute, without links."""
    found: tuple[int, str] | None = None
    for line in (system.text("proc/self/mountinfo") or "").splitlines():
        place, _, rest = line.partition(" - ")
        fields = place.split()
        if len(fields) < 5 or not rest:
            continue
        mounted = Path(re.sub(r"\\([0-7]{3})", lambda match: chr(int(match[1], 8)), fields[4]))
        depth = len(mounted.parts)
        if folder.is_relative_to(mounted) and (found is None or depth >= found[0]):  # later mounts hide earlier ones
            found = depth, rest.split()[0]
    return None if found is None else found[1]


def _sync(folder: Path) -> Finding:
    try:
        times_ms = _sync_times(folder)
    except OSError as error:
        return Finding(DISK, "sync of 4 KiB", f"not measured: {error.strerror}", "unknown")
    median = times_ms[len(times_ms) // 2]
    value = f"p50 {median:.2f} ms, max {times_ms[-1]:.2f} ms ({len(times_ms)} times)"
    if median <= MAX_SYNC_MS:
        return Finding(DISK, "sync of 4 KiB", value)
    advice = "Each observation batch waits for this before it is acknowledged. Use a local SSD: LIPSERVE_HOME."
    return Finding(DISK, "sync of 4 KiB", value, "warning", advice)


def _sync_times(folder: Path) -> list[float]:
    """Return the sorted times to append 4 KiB to a file and to sync it, ms."""
    times, end = list[float](), time.monotonic() + SYNC_S
    with tempfile.NamedTemporaryFile(dir=folder, prefix=".doctor-", buffering=0) as file:
        while len(times) < SYNCS and (not times or time.monotonic() < end):
            began = time.perf_counter()
            file.write(bytes(4096))
            os.fsync(file.fileno())
            times.append(1e3 * (time.perf_counter() - began))
    return sorted(times)


def _gib(size: int) -> str:
    return f"{size / GIB:.3g} GiB"
