"""The command line of the benchmarks."""

from __future__ import annotations

import json
import signal
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import typer
from rich.console import Console

from benchmarks import batch as batches
from benchmarks import facts
from benchmarks.clients import BadAnswerError
from benchmarks.exported import running as exported_running
from benchmarks.ingest import running as ingest_running
from benchmarks.ingest.recording import FORMATS
from benchmarks.latency import table
from benchmarks.latency.running import KEYS, Options, run
from benchmarks.latency.targets import Target, targets
from benchmarks.online import durability as durable
from benchmarks.online import pickup, pickup_table
from benchmarks.online import running as online_running
from benchmarks.online import table as online_table
from benchmarks.online.arms import KINDS
from benchmarks.online.running import PARTS
from benchmarks.online.scene import Scene
from benchmarks.online.targets import targets as online_targets
from benchmarks.real import report as real_report
from benchmarks.real import running as real_running
from benchmarks.real.cells import product_revision
from benchmarks.scale import running as scale_running
from benchmarks.scale.running import PARTS as SCALE_PARTS
from benchmarks.soak import hours as soak_hours
from benchmarks.soak import running as soak_running
from benchmarks.soak import table as soak_table
from benchmarks.workload import BenchError, Source, model_folder
from lipcore.robots.library import ROBOTS
from lipserve import ApiError, StreamError
from lipserve.wording import counted
from service.cli.demo import DemoError
from service.foundation.errors import ServiceError

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)
ERRORS = (ApiError, BadAnswerError, BenchError, DemoError, ServiceError, StreamError)
"""Errors printed without a traceback."""

QUICK_RUNS, QUICK_QUERIES, QUICK_SECONDS = 3, 1000, 5.0
QUICK_FIT = {"hyperparameter_samples": 80, "max_iterations": 50, "starts": 1}
"""Fit options of `--quick`; the posterior still uses all samples."""
QUICK_ONLINE: dict[str, Any] = {
    "idle_s": 4.0,
    "burst_s": 6.0,
    "after": (0.5, 3.0, 6.0),
    "sizes": (1_000, 4_000),
    "refit_every": 6.0,
}

Seed = Annotated[int, typer.Option(min=0, help="Seed of all random numbers.")]
Robot = Annotated[str, typer.Option(help=f"Robot: {', '.join(ROBOTS)}.")]
JsonFile = Annotated[Path | None, typer.Option("--json", dir_okay=False, help="Also write all figures to this file.")]
Markdown = Annotated[Path | None, typer.Option(dir_okay=False, help="Also write the tables to this file.")]
Strict = Annotated[bool, typer.Option("--strict", help="Exit with 1 if a target is missed.")]


@app.callback()
def _bench() -> None:
    """Measure this machine."""


@app.command()
def latency(
    model: Annotated[
        str | None, typer.Option(help="Measure the latest version of this model instead of training one.")
    ] = None,
    folder: Annotated[
        Path | None, typer.Option(exists=True, file_okay=False, help="Measure the saved model in this folder.")
    ] = None,
    runs: Annotated[int | None, typer.Option(min=1, help="Number of runs: 5, with --quick 3.")] = None,
    queries: Annotated[
        int | None, typer.Option(min=20, help="Queries a run: 4000, with --quick 1000; fewer for slow subjects.")
    ] = None,
    seconds: Annotated[
        float | None, typer.Option(min=0, help="Length of the 1 kHz loop, s: 60, with --quick 5; 0 omits it.")
    ] = None,
    training: Annotated[bool, typer.Option(help="Also measure while a training job runs.")] = True,
    motions: Annotated[
        bool, typer.Option("--motions", help="Also compare models of four kinds of motion; takes minutes.")
    ] = False,
    only: Annotated[str | None, typer.Option(help=f"Names separated by commas: {', '.join(KEYS)}.")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Measure less, in about two minutes.")] = False,
    json_file: JsonFile = None,
    markdown: Markdown = None,
    strict: Strict = False,
) -> None:
    """Time answers in process and over every transport, idle and while training, and those of baselines."""
    if model is not None and folder is not None:
        raise ValueError("--model and --folder exclude each other.")
    chosen = folder if model is None else model_folder(model)
    options = Options(
        source=Source(folder=chosen, fit=QUICK_FIT if quick else {}),
        runs=runs or (QUICK_RUNS if quick else 5),
        queries=queries or (QUICK_QUERIES if quick else 4000),
        seconds=seconds if seconds is not None else (QUICK_SECONDS if quick else 60.0),
        training=training,
        motions=motions,
        only=() if only is None else _names(only),
    )
    console = _begin()
    results = run(options, console)
    found = targets(results)
    if json_file is not None:
        results.write(json_file, _targets_json(found))
    _report(table.grids(results), results.notes, found, console, markdown, strict)


@app.command()
def online(
    robot: Robot = "panda",
    seed: Seed = 0,
    speed: Annotated[float, typer.Option(help="Multiplies the frequencies of the motion.")] = 5.0,
    payload: Annotated[float, typer.Option(min=0, help="Payload attached in the middle of the stream, kg.")] = 1.5,
    drift: Annotated[float, typer.Option(min=0, help="Relative growth of friction over the stream.")] = 0.3,
    forgetting: Annotated[float, typer.Option(min=1, help="Time constant of forgetting, s.")] = 30.0,
    estimator: Annotated[str, typer.Option(help="Estimator of the model.")] = "rigid-body",
    inducing: Annotated[
        int, typer.Option(min=1, help="Max inducing outputs, for estimators that have some; more make rows slower.")
    ] = 500,
    websocket: Annotated[
        bool, typer.Option("--websocket", help="Send observations as WebSocket frames, not as HTTP batches.")
    ] = False,
    only: Annotated[
        str | None,
        typer.Option(
            help=f"Names separated by commas: {', '.join(PARTS)}; or {', '.join(pickup.PARTS)}, which take hours."
        ),
    ] = None,
    arms: Annotated[str, typer.Option(help=f"Robots of {', '.join(pickup.PARTS)}, separated by commas.")] = ",".join(
        pickup.ROBOTS
    ),
    kinds: Annotated[
        str, typer.Option(help=f"Kinds of arm of {', '.join(pickup.PARTS)}, separated by commas.")
    ] = ",".join(KINDS),
    minutes: Annotated[float, typer.Option(min=0.1, help="Motion without payload of each of these arms, min.")] = 3.0,
    quick: Annotated[bool, typer.Option("--quick", help="Measure less, in about two minutes.")] = False,
    json_file: JsonFile = None,
    markdown: Markdown = None,
    strict: Strict = False,
) -> None:
    """Measure online learning in real time: throughput, latency, cost, and quality before and after a change."""
    if only is not None and set(_names(only)) & set(pickup.PARTS):
        payloads = pickup.Options(_names(only), _names(arms), _names(kinds), minutes, seed)
        _measure_payloads(payloads, json_file, markdown, strict)
        return
    short = QUICK_ONLINE if quick else {}
    seconds, change = (12.0, 6.0) if quick else (60.0, 30.0)
    options = online_running.Options(
        scene=Scene(robot, seconds, change, speed=speed, payload=payload, drift=drift, seed=seed),
        estimator=estimator,
        fit={**online_running.FIT, **(QUICK_FIT if quick else {}), "max_inducing_outputs": inducing},
        forgetting_s=forgetting,
        websocket=websocket,
        only=() if only is None else _names(only),
        **short,
    )
    console = _begin()
    results = online_running.run(options, console)
    found = online_targets(results)
    if json_file is not None:
        results.write(json_file, _targets_json(found))
    _report(online_table.grids(results), results.notes, found, console, markdown, strict)


def _measure_payloads(options: pickup.Options, json_file: Path | None, markdown: Path | None, strict: bool) -> None:
    """Measure how payloads are noticed and estimated; print and write the results."""
    console = _begin()
    with facts.one_thread():
        found = pickup.run(options, console)
    targeted = pickup_table.targets(found)
    if json_file is not None:
        found.write(json_file, _targets_json(targeted))
    _report(pickup_table.grids(found), pickup_table.NOTES, targeted, console, markdown, strict)


@app.command()
def durability(
    trials: Annotated[int, typer.Option(min=1, help="Number of kills, of service and learner in turn.")] = 100,
    seed: Seed = 0,
    json_file: JsonFile = None,
    markdown: Markdown = None,
    strict: Strict = False,
) -> None:
    """Kill the service or its learner while it learns; count lost and duplicate batches. 2 to 4 s a trial."""
    console = _begin()
    with TemporaryDirectory(prefix="lipserve-bench-") as folder:
        tally = durable.run(Path(folder), trials, seed, console)
    found = durable.targets(tally)
    if json_file is not None:
        json_file.write_text(json.dumps({**asdict(tally), "targets": _targets_json(found)}, indent=2) + "\n")
    _report(durable.grids(tally), [durable.NOTE], found, console, markdown, strict)


@app.command()
def load(
    connections: Annotated[int, typer.Option(min=4, help="Simultaneous connections.")] = 64,
    seconds: Annotated[float, typer.Option(min=1, help="Duration, s.")] = 120.0,
    pause: Annotated[float, typer.Option(min=0, help="Wait between an answer and the next request, s.")] = 0.02,
    robot: Robot = "panda",
    seed: Seed = 0,
    json_file: JsonFile = None,
    markdown: Markdown = None,
    strict: Strict = False,
) -> None:
    """Predict, stream, learn and upload at once; count errors, measure memory, and check that no write is lost."""
    options = soak_running.Options(connections, seconds, pause, robot, seed)
    console = _begin()
    results = soak_running.run(options, console)
    found = soak_table.targets(results)
    if json_file is not None:
        results.write(json_file, _targets_json(found))
    _report(soak_table.grids(results), [], found, console, markdown, strict)


@app.command()
def soak(
    hours: Annotated[
        float, typer.Option(min=0.05, max=24, help="Simulated hours of a busy arm, sent as fast as possible.")
    ] = 8.0,
    rate: Annotated[int, typer.Option(min=5, max=1000, help="Rate of the observations, Hz.")] = 100,
    minutes: Annotated[float | None, typer.Option(min=0.5, help="Stop after this time in any case, min.")] = None,
    seed: Seed = 0,
    plot: Annotated[
        Path | None, typer.Option(dir_okay=False, help="Also draw memory, disk, descriptors, threads: .png or .svg.")
    ] = None,
    json_file: JsonFile = None,
    markdown: Markdown = None,
) -> None:
    """Replay hours of a busy arm: all routes, streams, training, retraining and backups, with retention on.

    Exit with 1 if memory, descriptors, threads, processes or disk grow after the first tenth, or if a request fails.
    """
    options = soak_hours.Options(hours, rate, minutes, seed)
    console = _begin()
    results = soak_hours.run(options, console)
    found = soak_hours.targets(results)
    if json_file is not None:
        results.write(json_file, _targets_json(found))
    if plot is not None:
        soak_hours.draw(results, plot)
    _report(soak_hours.grids(results), [], found, console, markdown, strict=True)


@app.command()
def ingest(
    rows: Annotated[int, typer.Option(min=1000, help="Rows of the recording, at 1 kHz.")] = 1_000_000,
    joints: Annotated[int, typer.Option(min=1, max=32, help="Joints of the robot.")] = 7,
    formats: Annotated[str, typer.Option(help="File formats separated by commas.")] = ",".join(FORMATS),
    seed: Seed = 0,
    json_file: JsonFile = None,
    markdown: Markdown = None,
    strict: Strict = False,
) -> None:
    """Upload a long recording; measure time and memory until its report is ready."""
    options = ingest_running.Options(rows, joints, _names(formats), seed=seed)
    console = _begin()
    results = ingest_running.run(options, console)
    found = ingest_running.targets(results)
    if json_file is not None:
        results.write(json_file, _targets_json(found))
    _report(ingest_running.grids(results), [], found, console, markdown, strict)


@app.command()
def scale(
    sizes: Annotated[
        str | None, typer.Option(help="Samples of the training jobs, separated by commas: 200000,1000000 by default.")
    ] = None,
    only: Annotated[str | None, typer.Option(help=f"Names separated by commas: {', '.join(SCALE_PARTS)}.")] = None,
    seed: Seed = 0,
    quick: Annotated[bool, typer.Option("--quick", help="Measure less, in a few minutes.")] = False,
    json_file: JsonFile = None,
    markdown: Markdown = None,
    strict: Strict = False,
) -> None:
    """Start PostgreSQL, S3, Dask, several services and workers; measure scaling, replication, costs and faults."""
    chosen: dict[str, Any] = {**(scale_running.QUICK if quick else {}), "seed": seed}
    if sizes is not None:
        chosen["sizes"] = tuple(int(size) for size in sizes.split(","))
    if only is not None:
        chosen["only"] = _names(only)
    options = scale_running.Options(**chosen)
    console = _begin()
    results = scale_running.run(options, console)
    if json_file is not None:
        results.write(json_file)
    _report(list(results.grids()), results.notes(), results.targets(), console, markdown, strict)


@app.command()
def exported(
    folder: Annotated[
        Path, typer.Option(exists=True, file_okay=False, help="Folder of a saved `rigid-body` model.")
    ] = exported_running.SHIPPED,
    calls: Annotated[int, typer.Option(min=20, help="Calls of each function.")] = 1_000_000,
    flags: Annotated[str, typer.Option(help="Compiler flags, separated by spaces.")] = "-O2",
    eigen: Annotated[
        Path | None,
        typer.Option(exists=True, file_okay=False, help="Eigen's headers; Pinocchio is then called from C++."),
    ] = None,
    seed: Seed = 0,
    json_file: JsonFile = None,
    markdown: Markdown = None,
    strict: Strict = False,
) -> None:
    """Time an exported C model and Pinocchio, and compare the C model's numbers with the model's."""
    console = _begin()
    options = exported_running.Options(folder.absolute(), calls, flags=tuple(flags.split()), eigen=eigen, seed=seed)
    results = exported_running.run(options, console)
    found = exported_running.targets(results)
    if json_file is not None:
        results.write(json_file, _targets_json(found))
    _report(exported_running.grids(results), [], found, console, markdown, strict)


@app.command()
def batch(
    folder: Annotated[
        Path, typer.Option(exists=True, file_okay=False, help="Folder of a saved model.")
    ] = exported_running.SHIPPED,
    sizes: Annotated[str, typer.Option(help="States in a batch, separated by commas.")] = "1,100,10000,100000",
    repetitions: Annotated[int, typer.Option(min=1, help="Repetitions; the best counts.")] = 10,
    markdown: Markdown = None,
) -> None:
    """Time large batches in process, beside Pinocchio in a Python loop."""
    console = _begin()
    results = batches.run(folder, [int(each) for each in sizes.split(",")], repetitions, console)
    _report(batches.grids(results), [], [], console, markdown, False)


@app.command()
def real(
    folder: Annotated[Path, typer.Argument(exists=True, file_okay=False, help="Folder of the recordings.")],
    out: Annotated[
        Path, typer.Option(file_okay=False, help="Folder of the results. Existing results are not computed again.")
    ] = Path("build/real"),
    only: Annotated[str, typer.Option(help="Regular expression for names recording/split/(nothing|URDF)/method.")] = "",
    jobs: Annotated[int, typer.Option(min=1, help="Cells computed at a time. Timings are comparable only with 1.")] = 1,
    tables: Annotated[bool, typer.Option("--table", help="Only print the existing results.")] = False,
    revision: Annotated[
        str | None, typer.Option(help="Revision of LIPServe under which results are stored; by default git's.")
    ] = None,
    page: Annotated[
        Path | None, typer.Option(dir_okay=False, help="Also write the page of the documentation to this file.")
    ] = None,
    strict: Strict = False,
) -> None:
    """Train on recordings of real arms with default options, and compare with other methods. Hours; resumable."""
    console = _begin()
    known = revision or product_revision()
    options = real_running.Options(folder, out, known, only, jobs, compute=not tables)
    outcome = real_running.run(options, console)
    if page is not None:
        page.write_text(real_report.page(outcome, known))
    found = real_report.targets(outcome.results)
    _report(real_report.grids(outcome), real_report.notes(outcome), found, console, None, strict)
    if outcome.failed:
        raise BenchError(f"{counted(len(outcome.failed), 'cell')} failed. Run the command again to retry.")


def _begin() -> Console:
    """Return the console; let SIGTERM also stop the measured services."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    return Console(width=None if sys.stdout.isatty() else table.WIDTH)


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(","))


def _targets_json(found: Sequence[Target]) -> list[dict[str, Any]]:
    """Return the targets as JSON values."""
    return [{**asdict(each), "met": each.met} for each in found]


def _report(
    grids: Sequence[table.Grid],
    notes: Sequence[str],
    found: Sequence[Target],
    console: Console,
    markdown: Path | None,
    strict: bool,
) -> None:
    """Print the tables and the number of missed targets; with `strict`, exit with 1 if a target is missed."""
    table.show_grids(grids, notes, console)
    if markdown is not None:
        markdown.write_text(table.grids_markdown(grids, notes))
    missed = [each for each in found if each.met is False]
    summary = f"{len(missed)} of {sum(each.met is not None for each in found)} targets missed."
    console.print(summary if missed else "All measured targets met.", highlight=False)
    if strict and missed:
        raise typer.Exit(1)
