"""`lipserve demo`: the whole workflow against a real service process. `make demo` runs it."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Annotated, Self

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from lipcore.data.samples import Samples
from lipcore.robots.library import Robot, load_robot
from lipcore.robots.simulation import FAST_SPEED, Simulation, simulate
from lipserve import ApiError, Client, Evaluation, Prediction
from lipserve.asking import Reading
from lipserve.progress import follow
from service.cli.consoles import out
from service.cli.options import alone
from service.cli.plotting import draw_torque
from service.cli.simulate import write_recording
from service.contract.states import SUCCEEDED
from service.foundation.text import counted, percent

MODEL = "panda-demo"
START_SECONDS = 180.0


class DemoError(RuntimeError):
    """A step of the demo failed."""


class ServiceProcess:
    """Separate process that runs `lipserve serve`."""

    def __init__(self, port: int, env: dict[str, str] | None = None) -> None:
        self.port = port if port and _free(port) else free_port()
        self.url = f"http://127.0.0.1:{self.port}"
        command = [sys.executable, "-m", "service", "serve", "--host", "127.0.0.1", "--port", str(self.port)]
        quiet = {"LIPSERVE_LOG_LEVEL": "warning"}  # by default: info lines would mix with the demo's output
        self.process = subprocess.Popen(command, env={**quiet, **os.environ, **(env or {})})  # noqa: S603 - our own

    def wait_ready(self, client: Client) -> float:
        """Wait until the service is ready and return the seconds it took; raise DemoError if it exits or hangs."""
        began = time.monotonic()
        while not client.ready():
            if self.process.poll() is not None:
                raise DemoError(f"the service exited with code {self.process.returncode} before it was ready")
            if time.monotonic() - began > START_SECONDS:
                raise DemoError(f"the service was not ready after {START_SECONDS:g} s")
            time.sleep(0.1)
        return time.monotonic() - began

    def stop(self) -> None:
        """Terminate the service and wait for it to exit."""
        self.process.terminate()
        self.process.wait(30)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is not None and self.process.poll() is None:
            self.stop()


def run(port: int, once: bool, plot: Path | None, console: Console) -> None:
    """Serve, simulate, upload, train, evaluate and predict; keep the service running unless `once`."""
    began = time.monotonic()
    console.print("[bold]1. starting the service[/bold] (up to a minute on the first run)")
    with ServiceProcess(port) as service, Client(service.url) as client, tempfile.TemporaryDirectory() as folder:
        seconds = service.wait_ready(client)
        console.print(f"  ready after {seconds:.1f} s; dashboard: {service.url}")

        console.print("[bold]2. simulating a Panda (7 joints, 10 Hz, 50 s per stream) and uploading the streams[/bold]")
        robot = load_robot("panda")
        train, test = {}, {}
        # the paper's slow sinusoids, dominated by gravity, and the faster variant with visible inertia
        for name, speed in (("slow", 1.0), ("fast", FAST_SPEED)):
            train[name] = _upload(client, robot, Simulation(speed=speed), 1, Path(folder) / f"train-{name}.csv")
            test[name] = _upload(
                client, robot, Simulation(speed=speed, n_sinusoids=100), 2, Path(folder) / f"test-{name}.npz"
            )
            console.print(f"  {name}: training stream {train[name][0]}, test trajectory {test[name][0]}")

        console.print(f"[bold]3. training {MODEL}[/bold]")
        queued = client.train(MODEL, [dataset for dataset, _ in train.values()])
        job = follow(client, queued, console)
        if job.state != SUCCEEDED or job.version is None:
            raise DemoError(f"training job {job.state}: {job.error.message if job.error else ''}")
        version = client.version(MODEL, job.version)
        fit, process = version.fit, version.lineage["training_process"]
        console.print(
            f"  version {job.version} after {job.progress.elapsed_s:.0f} s: {fit['samples_posterior']} of "
            f"{counted(fit['samples_given'], 'sample')} kept, {counted(fit['iterations'], 'iteration')}, "
            f"peak memory of the training process {process['peak_memory_mb']} MB"
        )

        console.print("[bold]4. evaluating on the test trajectories[/bold]")
        for name, (dataset, samples) in test.items():
            console.print(_table(name, client.evaluate(MODEL, dataset), samples))

        console.print("[bold]5. predicting the torque at one motion[/bold]")
        samples, row = test["fast"][1], 250
        query = {key: getattr(samples, key)[row] for key in ("q", "dq", "ddq")}
        answer = client.predict(MODEL, **query)
        _show_query(query, answer, samples.tau[row], service.url, console)
        if plot is not None:
            part = samples.rows(slice(0, 150))  # fifteen seconds
            draw_torque(plot, part, client.predict(MODEL, part.q, part.dq, part.ddq))
            console.print(f"  plot written to {plot}")
        console.print(f"[bold]done in {time.monotonic() - began:.0f} s[/bold]")
        if once:
            service.stop()
            return
    console.print(f"Open the model's page: {service.url}/#/models/{MODEL}")
    console.print(f"The service keeps running (guide: {service.url}/guide, API: {service.url}/docs). Ctrl-C stops it.")
    try:
        service.process.wait()
    except KeyboardInterrupt:
        service.stop()


def _upload(client: Client, robot: Robot, stream: Simulation, seed: int, path: Path) -> tuple[str, Samples]:
    samples = simulate(robot, stream, seed)
    write_recording(path, samples)
    reading = Reading(joint_names=samples.joint_names) if path.suffix == ".csv" else Reading()
    return client.upload(path, **reading).id, samples


def _table(name: str, result: Evaluation, samples: Samples) -> Table:
    table = Table(title=f"{name} trajectory, {result.samples_used} test samples, model version {result.version}")
    table.add_column("joint")
    for heading in ("torque std N·m", "nMSE", "RMSE N·m", f"coverage of {percent(result.level)}", "interval N·m"):
        table.add_column(heading, justify="right")
    spread = samples.tau.std(axis=0)
    for j, joint in enumerate(result.joint_names):
        nmse = result.nmse[j]
        table.add_row(
            joint,
            f"{spread[j]:.3f}",
            "-" if np.isnan(nmse) else f"{nmse:.1e}",
            f"{result.rmse[j]:.4f}",
            percent(result.coverage[j], 1),
            f"{result.interval_width[j]:.3f}",
        )
    return table


def _show_query(
    query: dict[str, np.ndarray], answer: Prediction, measured: np.ndarray, url: str, console: Console
) -> None:
    rounded = {name: [round(float(v), 3) for v in values] for name, values in query.items()}
    console.print(f"  POST {url}/v1/models/{MODEL}/predict", rounded, highlight=False)
    table = Table(title=f"prediction of {answer.model} version {answer.version} revision {answer.revision}, N·m")
    table.add_column("joint")
    for heading in ("tau", "tau_std", "noise_std", "measured"):
        table.add_column(heading, justify="right")
    rows = zip(answer.joint_names, answer.tau, answer.tau_std, answer.noise_std, measured, strict=True)
    for joint, *figures in rows:
        table.add_row(joint, *(f"{figure:.4f}" for figure in figures))
    console.print(table)


def _free(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) != 0


def free_port() -> int:
    """Return a free TCP port."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


app = alone()
ERRORS = (ApiError, DemoError)


@app.command()
def demo(
    port: Annotated[int, typer.Option(help="Port of the service; 0 selects a free port.")] = 8000,
    once: Annotated[bool, typer.Option("--once", envvar="ONCE", help="Stop the service at the end.")] = False,
    plot: Annotated[Path | None, typer.Option(help="Also draw measured and predicted torque, .png or .svg.")] = None,
) -> None:
    """Run a demo: start a service, simulate a Panda, upload, train, evaluate on test trajectories, predict."""
    run(port, once, plot, out)
