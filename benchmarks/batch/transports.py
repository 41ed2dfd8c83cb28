"""Batches over HTTP and gRPC with binary tensors, beside the same batches in process with one thread."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from rich.console import Console

from benchmarks import facts
from benchmarks.batch.running import draw_states
from benchmarks.clients import HttpClient, post
from benchmarks.latency.table import Grid, targets_grid
from benchmarks.latency.targets import Target
from benchmarks.workload import MODEL, Bed, Source, open_bed
from lipcore.data.samples import Array
from lipcore.files.persistence import load
from lipcore.posterior.threads import limit_threads
from service.api.oip.schema import HEADER

INPUTS = ("q", "dq", "ddq")
OUTPUTS = {"mean": ("tau_mean",), "with std": ("tau", "tau_std")}
MAX_BODY_BYTES = 64 * 2**20
MIN_SHARE = 0.25
"""Share of the throughput in process that a transport must reach."""
IN_PROCESS = "in process"

Ask = Callable[[Array], list[Array]]
"""Sends q, dq and ddq of a batch, (3, N, n), and returns the output tensors."""


@dataclass
class Results:
    """CPU time of client and service together, and elapsed time, best of all repetitions, µs a state.

    `times` has them by outputs, batch size and transport, `deviation` the largest difference from in process.
    """

    machine: dict[str, str]
    times: dict[tuple[str, int, str], tuple[float, float]] = field(default_factory=dict)
    deviation: float = 0.0

    def write(self, path: Path, targets: list[dict[str, Any]]) -> None:
        """Write all figures as JSON."""
        times = {", ".join(map(str, key)): value for key, value in self.times.items()}
        found = {"machine": self.machine, "times": times, "deviation": self.deviation, "targets": targets}
        path.write_text(json.dumps(found, indent=2) + "\n")


def run(folder: Path, sizes: Sequence[int], repetitions: int, console: Console) -> Results:
    """Measure the model in a folder."""
    model, results = load(folder), Results(facts.machine())
    states = draw_states(model, max(sizes))
    settings = {"LIPSERVE_MAX_REQUEST_BYTES": str(MAX_BODY_BYTES)}
    with TemporaryDirectory(prefix="lipserve-bench-") as home, ExitStack() as stack:
        bed = stack.enter_context(open_bed(Path(home), Source(folder=folder), console, settings))
        limit_threads(1)  # as in the service

        def predict(batch: Array) -> list[Array]:
            answer = model.predict(*batch)
            return [answer.tau, answer.tau_std]

        in_process: dict[str, Ask] = {"mean": lambda batch: [model.torque(*batch)], "with std": predict}
        for name, outputs in OUTPUTS.items():
            subjects = {IN_PROCESS: in_process[name], "HTTP": _http(bed, outputs, stack)}
            if bed.grpc is not None:
                subjects["gRPC"] = _grpc(bed.grpc, outputs, stack)
            for size in sizes:
                batch = np.ascontiguousarray(states[:, :size])
                expected = subjects[IN_PROCESS](batch)
                console.print(f"{name}: {size:,} states", highlight=False)
                for transport, ask in subjects.items():
                    for found, known in zip(ask(batch), expected, strict=True):
                        results.deviation = max(results.deviation, float(np.abs(found - known).max()))
                    pid = None if transport == IN_PROCESS else bed.pid
                    best = np.min([_time(ask, batch, pid) for _ in range(repetitions)], axis=0) / size
                    results.times[name, size, transport] = float(best[0]), float(best[1])
    return results


def grids(results: Results) -> list[Grid]:
    """Return all tables."""
    rows = []
    for (name, size, transport), (cpu, elapsed) in results.times.items():
        share = "" if transport == IN_PROCESS else f"{_share(results, name, size, transport):.2f}"
        rows.append((f"{name}, {transport}", f"{size:,}", f"{cpu:.2f}", f"{elapsed:.2f}", f"{1e6 / cpu:,.0f}", share))
    columns = ("", "states", "CPU, µs a state", "elapsed, µs a state", "states a second of one CPU", "of in process")
    return [
        Grid("machine", ("", ""), list(results.machine.items()), texts=True),
        Grid("binary batches in float64, CPU of client and service together", columns, rows),
        Grid("largest difference from in process", ("", ""), [("torque and std, N·m", f"{results.deviation:.1e}")]),
        targets_grid(targets(results), ""),
    ]


def targets(results: Results) -> list[Target]:
    """Return the targets."""
    return [
        Target(f"{name}, {size:,} states, {transport}", _share(results, name, size, transport), "", "≥", MIN_SHARE)
        for name, size, transport in results.times
        if transport != IN_PROCESS
    ]


def _share(results: Results, name: str, size: int, transport: str) -> float:
    """Return the throughput of a transport by CPU time, relative to in process."""
    return results.times[name, size, IN_PROCESS][0] / results.times[name, size, transport][0]


def _http(bed: Bed, outputs: Sequence[str], stack: ExitStack) -> Ask:
    client = stack.enter_context(HttpClient(bed.tcp))
    wanted = [{"name": each, "parameters": {"binary_data": True}} for each in outputs]

    def ask(batch: Array) -> list[Array]:
        shape, size = list(batch.shape[1:]), batch[0].nbytes
        inputs: list[dict[str, Any]] = [
            {"name": each, "shape": shape, "datatype": "FP64", "parameters": {"binary_data_size": size}}
            for each in INPUTS
        ]
        text = json.dumps({"inputs": inputs, "outputs": wanted}).encode()
        body = b"".join([text, batch.astype("<f8", copy=False).data])
        media = "application/octet-stream"
        head, answer = client.exchange(post(f"/v2/models/{MODEL}/infer", body, media, {HEADER: str(len(text))}))
        at = head.index(HEADER.lower().encode()) + len(HEADER) + 1
        offset = int(head[at:].split(b"\r\n", 1)[0])
        return list(np.frombuffer(answer, "<f8", offset=offset).reshape(-1, *shape))

    return ask


def _grpc(address: tuple[str, int], outputs: Sequence[str], stack: ExitStack) -> Ask:
    import grpc  # noqa: PLC0415 - of an extra, like the modules below

    from service.api.oip.rpc.definition import SERVICE  # noqa: PLC0415
    from service.api.oip.rpc.messages import InferRequest, InferResponse  # noqa: PLC0415

    unlimited = [(f"grpc.max_{each}_message_length", -1) for each in ("send", "receive")]
    channel = stack.enter_context(grpc.insecure_channel("{}:{}".format(*address), options=unlimited))
    infer = channel.unary_unary(f"/{SERVICE}/ModelInfer", InferRequest.SerializeToString, InferResponse.FromString)

    def ask(batch: Array) -> list[Array]:
        request = InferRequest(model_name=MODEL)
        for each, values in zip(INPUTS, batch, strict=True):
            request.inputs.add(name=each, datatype="FP64", shape=values.shape)
            request.raw_input_contents.append(values.astype("<f8", copy=False).tobytes())
        for each in outputs:
            request.outputs.add(name=each)
        return [np.frombuffer(each, "<f8").reshape(batch.shape[1:]) for each in infer(request).raw_output_contents]

    return ask


def _time(ask: Ask, batch: Array, service: int | None) -> tuple[float, float]:
    """Return the CPU time of this process and a service, and the elapsed time, µs."""
    cpu, elapsed = _cpu_s(service), time.perf_counter()
    ask(batch)
    elapsed = time.perf_counter() - elapsed
    return 1e6 * (_cpu_s(service) - cpu), 1e6 * elapsed


def _cpu_s(service: int | None) -> float:
    """Return the CPU time of this process, and of all processes of a service if it is given, s."""
    # the identifier that Linux's clock_getcpuclockid returns
    return time.process_time() + sum(time.clock_gettime((~pid << 3) | 2) for pid in _processes(service))


def _processes(service: int | None) -> list[int]:
    """Return the ids of the processes of a service."""
    if service is None:
        return []
    children = Path(f"/proc/{service}/task").glob("*/children")
    return [service, *(each for pids in children for pid in pids.read_text().split() for each in _processes(int(pid)))]
