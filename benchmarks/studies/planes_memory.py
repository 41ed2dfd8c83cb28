"""Memory of a service of two planes beside one process: sums of PSS, time to be ready and to stop.

    python benchmarks/studies/planes_memory.py HOME [MODEL JOINTS]

HOME is copied; the model is panda-sim by default. PSS counts a shared page in equal parts, so that a sum over
processes counts it once.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import httpx

PORT = 8771
URL = f"http://127.0.0.1:{PORT}"
WAIT_S = 300.0
QUERIES = 300


def main() -> None:
    """Print a line for each kind of service."""
    home, model, joints = Path(sys.argv[1]), *(sys.argv[2:] or ("panda-sim", "7"))
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "home"
        shutil.copytree(home, copy)
        for planes in ("off", "on"):
            print(measure(copy, planes, model, int(joints)))


def measure(home: Path, planes: str, model: str, joints: int) -> str:
    """Start, query and stop a service; return its figures."""
    environment = {**os.environ, "LIPSERVE_HOME": str(home), "LIPSERVE_DATA_PLANE": planes}
    command = [sys.executable, "-m", "service", "serve", "--port", str(PORT)]
    began = time.monotonic()
    process = subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL)  # noqa: S603
    try:
        wait_until_ready(began)
        ready_s, cpu_s = time.monotonic() - began, sum(map(cpu_seconds, tree(process.pid)))
        time.sleep(3.0)  # the weigher starts after the service is ready
        fresh = pss_mb(process.pid)
        use(model, joints)
        used = pss_mb(process.pid)
        began = time.monotonic()
        process.terminate()
        process.wait(WAIT_S)
    finally:
        process.kill()
    return (
        f"data plane {planes}: ready after {ready_s:.1f} s ({cpu_s:.1f} s of CPU), "
        f"memory {fresh:.0f} MB fresh, {used:.0f} MB after requests, stopped after {time.monotonic() - began:.1f} s"
    )


def wait_until_ready(began: float) -> None:
    """Wait until the service is ready."""
    while time.monotonic() - began < WAIT_S:
        try:
            if httpx.get(f"{URL}/health/ready", timeout=WAIT_S).status_code == httpx.codes.OK:
                return
        except httpx.TransportError:
            time.sleep(0.02)
    raise TimeoutError("the service is not ready")


def use(model: str, joints: int) -> None:
    """Send queries and pages, as a robot and a dashboard do."""
    with httpx.Client(base_url=URL, timeout=WAIT_S) as client:
        query = {each: [0.1] * joints for each in ("q", "dq", "ddq")}
        for _ in range(QUERIES):
            client.post(f"/v1/models/{model}/predict", json=query).raise_for_status()
        batch = {each: [[0.1] * joints] * 500 for each in query}
        for _ in range(5):
            client.post(f"/v1/models/{model}/predict", json=batch | {"covariance": True}).raise_for_status()
        for path in ("/", "/v1/models", "/v1/datasets", "/v1/jobs", "/metrics", f"/v1/models/{model}", "/openapi.json"):
            client.get(path).raise_for_status()


def tree(pid: int) -> Iterator[int]:
    """Yield a process and its descendants."""
    yield pid
    for path in Path(f"/proc/{pid}/task").glob("*/children"):
        for child in path.read_text().split():
            yield from tree(int(child))


def pss_mb(pid: int) -> float:
    """Return the memory of a process and its descendants, MB."""
    kilobytes = 0
    for each in tree(pid):
        lines = Path(f"/proc/{each}/smaps_rollup").read_text().splitlines()
        kilobytes += sum(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
    return kilobytes / 1000


def cpu_seconds(pid: int) -> float:
    """Return the processor time of a process, s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    main()
