"""The clock source, its resolution, and the synchronisation of the date."""

from __future__ import annotations

import ctypes
import time
from collections.abc import Iterator

from service.cli.doctor.findings import Finding, System

CLOCK, MEANWHILE = "Clock", "During the measurement"
SLOW_SOURCES = ("hpet", "acpi_pm", "pit", "jiffies", "refined-jiffies")
MAX_RESOLUTION_S = 1e-6
MAX_STEP_S = 0.01
_READINGS = 1000
_UNSYNCHRONISED = 0x40
"""Flag STA_UNSYNC of adjtimex."""


def clocks(system: System) -> Iterator[Finding]:
    """Yield what is known about the clocks."""
    source, name = system.text("sys/devices/system/clocksource/clocksource0/current_clocksource"), "clock source"
    value = f"{source or 'not readable'}, read in {_reading_ns():.0f} ns"
    if source is None:
        yield Finding(CLOCK, name, value, "unknown")
    elif source in SLOW_SOURCES:
        advice = "Each reading is a slow access to hardware. Boot with `clocksource=tsc tsc=reliable`."
        yield Finding(CLOCK, name, value, "warning", advice)
    else:
        yield Finding(CLOCK, name, value)
    resolution = time.get_clock_info("monotonic").resolution
    value, name = f"{resolution * 1e9:.0f} ns", "resolution"
    if resolution <= MAX_RESOLUTION_S:
        yield Finding(CLOCK, name, value)
    else:
        advice = "Sleeping threads wake with a timer tick. Boot with `highres=on`."
        yield Finding(CLOCK, name, value, "warning", advice)
    yield synchronisation(_adjustment())


class Adjustment(ctypes.Structure):
    """The begin of `struct timex` (Linux, see adjtimex). max_error: µs."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("frequency", ctypes.c_long),
        ("max_error", ctypes.c_long),
        ("estimated_error", ctypes.c_long),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_byte * 256),
    )
    max_error: int
    status: int


def _adjustment() -> Adjustment | None:
    """Return the kernel's state of synchronisation, None if it cannot be read."""
    try:
        adjtimex = ctypes.CDLL(None).adjtimex
    except (AttributeError, OSError):
        return None
    state = Adjustment()
    return state if adjtimex(ctypes.byref(state)) >= 0 else None


def synchronisation(state: Adjustment | None) -> Finding:
    """Return whether the date is synchronised with a time server."""
    if state is None:
        return Finding(CLOCK, "date", "not readable", "unknown")
    if not state.status & _UNSYNCHRONISED:
        return Finding(CLOCK, "date", f"synchronised, error at most {state.max_error / 1000:.3g} ms")
    advice = "Times of robot and service may differ, and the date may jump. Run chrony or systemd-timesyncd."
    return Finding(CLOCK, "date", "not synchronised", "warning", advice)


def date_offset() -> float:
    """Return the difference of the date and of the monotonic clock, s. It changes only if the date is set."""
    return time.time() - time.monotonic()


def step(seconds: float) -> Finding:
    """Return whether the date was set during the measurement. seconds: change of `date_offset`."""
    if abs(seconds) <= MAX_STEP_S:
        return Finding(MEANWHILE, "steps of the date", "none")
    advice = "Another program sets the date. Let chrony or systemd-timesyncd slew it instead."
    return Finding(MEANWHILE, "steps of the date", f"{seconds:+.3g} s", "warning", advice)


def _reading_ns() -> float:
    began = time.perf_counter_ns()
    for _ in range(_READINGS):
        time.perf_counter_ns()
    return (time.perf_counter_ns() - began) / _READINGS
