"""Time to cancel a job that runs on a worker of the cluster."""

from __future__ import annotations

import time

import numpy as np
from rich.console import Console

from benchmarks.latency.table import Grid
from benchmarks.latency.targets import Target
from benchmarks.scale import streams
from benchmarks.scale.engines import Engines, eventually, ready
from benchmarks.scale.part import Part
from lipserve import Client
from lipserve.states import ACTIVE

NAME = "cancel"
ENDLESS = {"hyperparameter_samples": 200, "posterior_samples": 60, "max_iterations": 10_000, "starts": 1}
MAX_SECONDS = 2.0
SAMPLES = 400
_POLL_S = 0.02


def run(engines: Engines, trials: int, seed: int, console: Console) -> Part:
    """Cancel a job during its fit, `trials` times, and measure the time until its end."""
    service = engines.service(cluster=True)
    worker = engines.worker()
    found = []
    with ready(service) as client:
        engines.wait_workers(1)
        path = engines.folder / "cancelled.parquet"
        streams.write(path, streams.stream(SAMPLES, seed + 3, rate=10.0))
        dataset = client.upload(path, joint_names=streams.robot().joint_names).id
        for _ in range(trials):
            found.append(_cancel(client, dataset))
            console.print(f"cancelled after {found[-1]:.2f} s", highlight=False)
    service.stop()
    worker.terminate()
    worker.wait(30)
    rows = [("trials", str(trials)), ("s, median", f"{np.median(found):.2f}"), ("s, worst", f"{max(found):.2f}")]
    target = Target("a job on the cluster is cancelled, worst", max(found), "s", "≤", MAX_SECONDS)
    return Part(NAME, {"seconds": found}, [Grid("time from cancelling a job to its end", ("", ""), rows)], [target])


def _cancel(client: Client, dataset: str) -> float:
    name = client.train("cancelled", [dataset], "lip-chain", list(streams.robot().joint_types), ENDLESS).id
    eventually(lambda: client.job(name).progress.iteration > 0, "the first iteration of a job")
    began = time.monotonic()
    client.cancel(name)
    eventually(lambda: client.job(name).state not in ACTIVE, "the end of a cancelled job", poll=_POLL_S)
    return time.monotonic() - began
