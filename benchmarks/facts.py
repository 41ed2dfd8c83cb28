"""Facts about the machine and the model, printed above the figures."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

_PACKAGES = ("lipserve", "numpy", "scipy", "numba", "uvicorn", "uvloop", "websockets", "pin", "gpytorch")
_CPU = Path("/proc/cpuinfo")


def machine() -> dict[str, str]:
    """Return processor, cores, present load and versions."""
    versions = [f"{name} {found}" for name in _PACKAGES if (found := _version(name))]
    return {
        "processor": f"{_processor()}, {os.cpu_count()} cores",
        "load before": ", ".join(f"{value:.2f}" for value in os.getloadavg()) + " (1, 5, 15 min)",
        "Python": f"{platform.python_version()} on {platform.system()} {platform.release()}",
        "packages": ", ".join(versions),
    }


def model(manifest: Mapping[str, Any], origin: str) -> dict[str, str]:
    """Return origin and size of the model, and its deviation from the exact posterior."""
    fit, entry = manifest["fit"], compact(manifest)
    size = f"{entry['inducing_outputs']:.0f} inducing outputs at {entry['inducing_samples']:.0f} samples"
    return {
        "model": origin,
        "estimator": f"{manifest['estimator']}, {len(manifest['joint_names'])} joints",
        "samples": f"{fit['samples_given']} given, {fit['samples_posterior']} in the posterior",
        "compact posterior": size,
        "deviation": f"mean {entry['mean_rms']:.2%} rms, {entry['mean_max']:.2%} max, of an exact standard "
        f"deviation; standard deviation {entry['std_max']:.2%} max (as fitted, tolerance {entry['tolerance']:.1%})",
    }


def compact(manifest: Mapping[str, Any]) -> dict[str, float]:
    """Return size of a manifest's compact posterior and its deviation from the exact one."""
    names = ("inducing_outputs", "inducing_samples", "mean_rms", "mean_max", "std_max", "tolerance")
    return {name: float(manifest["compact"][name]) for name in names}


def deviation(manifest: Mapping[str, Any]) -> float:
    """Return the largest deviation of mean or standard deviation from the exact posterior, in standard deviations."""
    entry = compact(manifest)
    return max(entry["mean_max"], entry["std_max"])


@contextmanager
def one_thread() -> Iterator[str]:
    """Limit this process's linear algebra to one thread, as in a control loop; yield a note about it."""
    with threadpool_limits(1):
        yield "1 thread"


def _processor() -> str:
    if _CPU.exists():
        for line in _CPU.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return ""
