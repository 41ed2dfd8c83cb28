"""CPUs, their limits, frequencies and idle states, the kernel's preemption, and the priorities that are permitted."""

from __future__ import annotations

import gzip
import os
import re
import resource
import threading
from collections.abc import Iterator
from contextlib import suppress

from service.cli.doctor.findings import Finding, System
from service.foundation.text import counted, percent
from service.runtime.realtime import RealTime

CPU, PRIORITY, MEANWHILE = "Processor", "Priority", "During the measurement"
MAX_IDLE_EXIT_US = 100
"""Max time to leave an idle state, a tenth of the period at 1 kHz."""


def processor(system: System) -> Iterator[Finding]:
    """Yield what limits the processor."""
    yield cpus(system)
    yield quota(system)
    yield isolated(system)
    yield preemption(system)
    yield governor(system)
    yield idle_states(system)


def cpus(system: System) -> Finding:
    """Return the number of CPUs that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        usable = len(os.sched_getaffinity(0))
        listed = system.fields("proc/self/status").get("Cpus_allowed_list")
        value = f"{usable} of {os.cpu_count()}" + (f" (CPU {listed})" if listed else "")
    else:
        usable = os.cpu_count() or 1
        value = str(usable)
    if usable > 1:
        return Finding(CPU, "CPUs", value)
    advice = "Allow at least two CPUs (Docker: `--cpuset-cpus`): learning and training otherwise share the loop's CPU."
    return Finding(CPU, "CPUs", value, "warning", advice)


def quota(system: System) -> Finding:
    """Return the CPU quota of the container or control group."""
    found = []
    for folder in system.control_groups("cpu"):
        limit = (system.text(f"{folder}/cpu.max") or "").split()
        if not limit:
            limit = [system.text(f"{folder}/cpu.cfs_{each}_us") or "" for each in ("quota", "period")]
        if len(limit) == 2 and all(re.fullmatch(r"\d+", each) for each in limit):  # else `max` or -1
            found.append((int(limit[0]) / int(limit[1]), int(limit[1])))
        elif limit[0]:
            found.append((float("inf"), 0))
    if not found:
        return Finding(CPU, "CPU quota", "not readable", "unknown")
    share, period_us = min(found)
    if period_us == 0:
        return Finding(CPU, "CPU quota", "none")
    advice = (
        f"A process that has used its quota is stopped for up to {period_us / 1000:.0f} ms. Remove `--cpus` (Docker), "
        "the CPU limit (Kubernetes) or `CPUQuota` (systemd), and reserve CPUs instead (`--cpuset-cpus`)."
    )
    return Finding(CPU, "CPU quota", f"{share:.3g} CPUs, each {period_us / 1000:.0f} ms", "warning", advice)


def isolated(system: System) -> Finding:
    """Return the CPUs that the scheduler leaves to pinned threads."""
    listed = system.text("sys/devices/system/cpu/isolated")
    if listed is None:
        return Finding(CPU, "isolated CPUs", "not readable", "unknown")
    return Finding(CPU, "isolated CPUs", listed or "none")


def preemption(system: System) -> Finding:
    """Return the kernel's preemption model."""
    version = system.text("proc/version")
    if version is None:
        return Finding(CPU, "preemption", "not readable", "unknown")
    if "PREEMPT_RT" in version or system.text("sys/kernel/realtime") == "1":
        return Finding(CPU, "preemption", "PREEMPT_RT")
    dynamic = "PREEMPT_DYNAMIC" in version
    model = _preemption_model(system, version)
    if model is None:
        return Finding(CPU, "preemption", "not readable" + (" (PREEMPT_DYNAMIC)" if dynamic else ""), "unknown")
    if model in ("full", "lazy"):
        return Finding(CPU, "preemption", model)
    remedy = "Boot with `preempt=full`" if dynamic else "Use a kernel with CONFIG_PREEMPT"
    advice = f"A system call of another process can delay the loop. {remedy}; best is a kernel with PREEMPT_RT."
    return Finding(CPU, "preemption", model, "warning", advice)


def _preemption_model(system: System, version: str) -> str | None:
    """Return `none`, `voluntary`, `full` or `lazy`, None if it cannot be read."""
    chosen = re.search(r"\((\w+)\)", system.text("sys/kernel/debug/sched/preempt") or "")
    chosen = chosen or re.search(r"\bpreempt=(none|voluntary|full|lazy)\b", system.text("proc/cmdline") or "")
    if chosen:
        return chosen[1]
    built = re.search(r"^CONFIG_PREEMPT(_NONE|_VOLUNTARY|_LAZY|)=y$", _kernel_config(system, version), re.MULTILINE)
    return None if built is None else (built[1][1:].lower() or "full")


def _kernel_config(system: System, version: str) -> str:
    try:
        return gzip.decompress((system.root / "proc/config.gz").read_bytes()).decode(errors="replace")
    except (OSError, EOFError):
        release = re.match(r"Linux version (\S+)", version)
        return (system.text(f"boot/config-{release[1]}") if release else None) or ""


def governor(system: System) -> Finding:
    """Return what chooses the frequency of the CPUs."""
    chosen = sorted(set(system.texts("sys/devices/system/cpu/cpu[0-9]*/cpufreq/scaling_governor")))
    if not chosen:
        return Finding(CPU, "frequency", "not readable; in a virtual machine, the host chooses", "unknown")
    turbo = {"0": "turbo on", "1": "turbo off"}.get(system.text("sys/devices/system/cpu/intel_pstate/no_turbo") or "")
    boost = {"1": "turbo on", "0": "turbo off"}.get(system.text("sys/devices/system/cpu/cpufreq/boost") or "")
    value = ", ".join([f"governor {' and '.join(chosen)}", *filter(None, [turbo or boost])])
    if chosen == ["performance"]:
        return Finding(CPU, "frequency", value)
    advice = "The CPU is slow after each pause of the loop. Run `cpupower frequency-set -g performance`."
    return Finding(CPU, "frequency", value, "warning", advice)


def idle_states(system: System) -> Finding:
    """Return the deepest idle state that the first CPU may enter."""
    names, exits, disabled = (
        system.texts(f"sys/devices/system/cpu/cpu0/cpuidle/state*/{each}") for each in ("name", "latency", "disable")
    )
    states = [
        (int(us), name) for name, us, off in zip(names, exits, disabled, strict=False) if off == "0" and us.isdigit()
    ]
    if not states:
        return Finding(CPU, "idle states", "not readable", "unknown")
    slowest, name = max(states)
    value = f"deepest {name}, left in {slowest} µs"
    if slowest <= MAX_IDLE_EXIT_US:
        return Finding(CPU, "idle states", value)
    advice = f"Run `cpupower idle-set -D {MAX_IDLE_EXIT_US}`, or boot with `intel_idle.max_cstate=1`."
    return Finding(CPU, "idle states", value, "warning", advice)


def priorities(system: System, granted: RealTime) -> Iterator[Finding]:
    """Yield which priorities and locks the system permits. granted: what a thread would get."""
    refused = {each.what: each for each in granted.refusals}
    if (policy := refused.get("policy")) is None:
        pinned = f", pinned to CPU {min(granted.cpus)}" if granted.cpus else ""
        yield Finding(PRIORITY, "SCHED_FIFO", f"permitted, priority {granted.priority}{pinned}")
    else:
        yield Finding(PRIORITY, "SCHED_FIFO", f"refused: {policy.reason}", "warning", policy.remedy)
    pages = refused.get("pages")
    if granted.pages_locked:
        yield Finding(PRIORITY, "locked pages", "permitted")
    elif pages is None:
        yield Finding(PRIORITY, "locked pages", "not known", "unknown")
    else:
        yield Finding(PRIORITY, "locked pages", f"refused: {pages.reason}", "warning", pages.remedy)
    yield real_time_share(system)
    yield niceness()


def real_time_share(system: System) -> Finding:
    """Return the share of time that the kernel gives to real-time threads."""
    runtime, period = (system.number(f"proc/sys/kernel/sched_rt_{each}_us") for each in ("runtime", "period"))
    if runtime is None or not period:
        return Finding(PRIORITY, "real-time share", "not readable", "unknown")
    if runtime < 0 or runtime >= period:
        return Finding(PRIORITY, "real-time share", "100 %: a thread without end can halt a CPU")
    return Finding(PRIORITY, "real-time share", f"{percent(runtime / period)} of each {period / 1e6:g} s")


def niceness() -> Finding:
    """Return the niceness of this process and the lowest that it may get."""
    nice = os.getpriority(os.PRIO_PROCESS, 0)
    lowest = _lowest_niceness(nice)
    value = f"{nice}" + (f", may be lowered to {lowest}" if lowest < nice else ", may not be lowered")
    if nice <= 0:
        return Finding(PRIORITY, "niceness", value)
    advice = "Every other process runs before the service. Start it without `nice`."
    return Finding(PRIORITY, "niceness", value, "warning", advice)


def _lowest_niceness(nice: int) -> int:
    """Return the lowest niceness that is permitted. It is tried in a thread that ends: on Linux, each has its own."""
    if not hasattr(resource, "RLIMIT_NICE"):
        return nice
    limit = resource.getrlimit(resource.RLIMIT_NICE)[0]
    permitted = [nice]

    def lower() -> None:
        for each in (-20, 20 - limit):
            with suppress(OSError):
                os.setpriority(os.PRIO_PROCESS, 0, each)
                permitted.append(each)

    thread = threading.Thread(target=lower)
    thread.start()
    thread.join()
    return min(permitted)


def load(before: list[int], after: list[int]) -> Iterator[Finding]:
    """Yield how busy the CPUs were between two readings of `cpu_times`."""
    spent = [late - early for early, late in zip(before, after, strict=False)]
    if sum(spent) <= 0 or len(spent) < 8:
        yield Finding(MEANWHILE, "load", "not readable", "unknown")
        return
    busy, stolen = 1 - (spent[3] + spent[4]) / sum(spent), spent[7] / sum(spent)
    value = f"{percent(busy)} of {counted(os.cpu_count() or 1, 'CPU')}"
    if busy < BUSY_SHARE:
        yield Finding(MEANWHILE, "load", value)
    else:
        advice = "Other work was running. Stop it, or give it other CPUs (`taskset`), and measure again."
        yield Finding(MEANWHILE, "load", value, "warning", advice)
    if stolen > STOLEN_SHARE:
        advice = "The host ran other virtual machines meanwhile. Reserve CPUs for this one, or use a real machine."
        yield Finding(MEANWHILE, "stolen time", percent(stolen, 1), "warning", advice)


BUSY_SHARE, STOLEN_SHARE = 0.7, 0.002
"""Shares of the CPUs' time that other work, and the host of a virtual machine, may take without a warning."""


def cpu_times(system: System) -> list[int]:
    """Return the times of all CPUs in ticks: user, nice, system, idle, waiting, interrupts (2), stolen; or none."""
    first = (system.text("proc/stat") or "").partition("\n")[0].split()
    return [int(each) for each in first[1:9]] if first[:1] == ["cpu"] else []
