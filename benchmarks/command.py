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
from benchmarks.online.promises import targets as online_targets
from benchmarks.online.running import PARTS
from benchmarks.online.scene import Scene
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
"""What a user is told without a traceback."""

QUICK_RUNS, QUICK_QUERIES, QUICK_SECONDS = 3, 1000, 5.0
QUICK_FIT = {"hyperparameter_samples": 80, "max_iterations": 50, "starts": 1}
"""Of the model; all samples stand behind its posterior all the same."""
QUICK_ONLINE: dict[str, Any] = {
    "idle_s": 4.0,
    "burst_s": 6.0,
    "after": (0.5, 3.0, 6.0),
    "sizes": (1_000, 4_000),
    "refit_every": 6.0,
}

Seed = Annotated[int, typer.Option(min=0, help="Of all that is random.")]
Robot = Annotated[str, typer.Option(help=f"One of {', '.join(ROBOTS)}.")]
JsonFile = Annotated[Path | None, typer.Option("--json", dir_okay=False, help="Also write all figures here.")]
Markdown = Annotated[Path | None, typer.Option(dir_okay=False, help="Also write the tables here.")]
Strict = Annotated[bool, typer.Option("--strict", help="Exit with 1 where something promised was missed.")]


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
    runs: Annotated[int | None, typer.Option(min=1, help="5 by default, 3 with --quick.")] = None,
    queries: Annotated[
        int | None, typer.Option(min=20, help="Of a run: 4000 by default, 1000 with --quick; fewer for what is slow.")
    ] = None,
    seconds: Annotated[
        float | None, typer.Option(min=0, help="Of the 1 kHz loop: 60 by default, 5 with --quick; 0 leaves it out.")
    ] = None,
    training: Annotated[bool, typer.Option(help="Also measure while a training job runs.")] = True,
    motions: Annotated[bool, typer.Option("--motions", help="Also train on four kinds of motion: minutes.")] = False,
    only: Annotated[str | None, typer.Option(help=f"Names separated by commas: {', '.join(KEYS)}.")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="A first look in about two minutes.")] = False,
    json_file: JsonFile = None,
    markdown: Markdown = None,
    strict: Strict = False,
) -> None:
    """Time answers in process and over every transport, idle and while training, next to baselines."""
    if model is not None and folder is not None:
        raise ValueError("--model and --folder name two models, expected one of them")
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
        results.write(json_file, _judged(found))
    _tell(table.grids(results), results.notes, found, console, markdown, strict)


@app.command()
def online(
    robot: Robot = "panda",
    seed: Seed = 0,
    speed: Annotated[float, typer.Option(help="Multiplies the frequencies of the motion.")] = 5.0,
    payload: Annotated[float, typer.Option(min=0, help="kg, attached in the middle of the stream.")] = 1.5,
    drift: Annotated[float, typer.Option(min=0, help="Share by which friction grows over the stream.")] = 0.3,
    forgetting: Annotated[float, typer.Option(min=1, help="Time constant of forgetting, s.")] = 30.0,
    estimator: Annotated[str, typer.Option(help="Of the model: by default the learnt arm.")] = "rigid-body",
    inducing: Annotated[
        int, typer.Option(min=1, help="Most inducing outputs of an estimator that has some: what a sample costs.")
    ] = 500,
    websocket: Annotated[bool, typer.Option("--websocket", help="Stream in frames, not in batches over HTTP.")] = False,
    only: Annotated[
        str | None,
        typer.Option(help=f"Names separated by commas: {', '.join(PARTS)}; or {', '.join(pickup.PARTS)}: hours."),
    ] = None,
    arms: Annotated[str, typer.Option(help="Robots that take something up, with commas.")] = ",".join(pickup.ROBOTS),
    kinds: Annotated[str, typer.Option(help="What these are, and how they are learnt.")] = ",".join(KINDS),
    minutes: Annotated[float, typer.Option(min=0.1, help="Of quiet motion of each of these.")] = 3.0,
    quick: Annotated[bool, typer.Option("--quick", help="A first look in about two minutes.")] = False,
    json_file: JsonFile = None,
    markdown: Markdown = None,
    strict: Strict = False,
) -> None:
    """Teach a served model in real time while it answers: throughput, latency, cost, and quality over a change."""
    if only is not None and set(_names(only)) & set(pickup.PARTS):
        carrying = pickup.Options(_names(only), _names(arms), _names(kinds), minutes, seed)
        _carrying(carrying, json_file, markdown, strict)
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
        results.write(json_file, _judged(found))
    _tell(online_table.grids(results), results.notes, found, console, markdown, strict)


def _carrying(options: pickup.Options, json_file: Path | None, markdown: Path | None, strict: bool) -> None:
    """Measure what arms carry; print and write it."""
    console = _begin()
    with facts.one_thread():
        found = pickup.run(options, console)
    promised = pickup_table.targets(found)
    if json_file is not None:
        found.write(json_file, _judged(promised))
    _tell(pickup_table.grids(found), pickup_table.NOTES, promised, console, markdown, strict)


@app.command()
def durability(
    trials: Annotated[int, typer.Option(min=1, help="Kills: of the service and of its learner in turn.")] = 100,
    seed: Seed = 0,
    json_file: JsonFile = None,
    markdown: Markdown = None,
    strict: Strict = False,
) -> None:
    """Kill the service, or its learner, while batches come; count what is lost or learnt twice. 2 to 4 s a trial."""
    console = _begin()
    with TemporaryDirectory(prefix="lipserve-bench-") as folder:
        tally = durable.run(Path(folder), trials, seed, console)
    found = durable.targets(tally)
    if json_file is not None:
        json_file.write_text(json.dumps({**asdict(tally), "targets": _judged(found)}, indent=2) + "\n")
    _tell(durable.grids(tally), [durable.SAID], found, console, markdown, strict)


@app.command()
def load(
    connections: Annotated[int, typer.Option(min=4, help="At the same time.")] = 64,
    seconds: Annotated[float, typer.Option(min=1, help="How long.")] = 120.0,
    pause: Annotated[float, typer.Option(min=0, help="s between an answer and the next question.")] = 0.02,
    robot: Robot = "panda",
    seed: Seed = 0,
    json_file: JsonFile = None,
    markdown: Markdown = None,
    strict: Strict = False,
) -> None:
    """Predict, stream, teach and upload at once; then count errors, memory, and whether every write is there."""
    options = soak_running.Options(connections, seconds, pause, robot, seed)
    console = _begin()
    results = soak_running.run(options, console)
    found = soak_table.targets(results)
    if json_file is not None:
        results.write(json_file, _judged(found))
    _tell(soak_table.grids(results), [], found, console, markdown, strict)


@app.command()
def soak(
    hours: Annotated[float, typer.Option(min=0.05, max=24, help="Of a busy arm, sent as fast as it goes.")] = 8.0,
    rate: Annotated[int, typer.Option(min=5, max=1000, help="At which it is observed, Hz.")] = 100,
    minutes: Annotated[
        float | None, typer.Option(min=0.5, help="End it after so long, however far it has come.")
    ] = None,
    seed: Seed = 0,
    plot: Annotated[Path | None, typer.Option(dir_okay=False, help="Also draw what was held, .png or .svg.")] = None,
    json_file: JsonFile = None,
    markdown: Markdown = None,
) -> None:
    """Do all that a busy arm does in hours: every route, streams, training, refreshes, backups, with retention on.

    Exit with 1 where memory, descriptors, threads, processes or disk grow after the first tenth, or anything fails.
    """
    options = soak_hours.Options(hours, rate, minutes, seed)
    console = _begin()
    results = soak_hours.run(options, console)
    found = soak_hours.targets(results)
    if json_file is not None:
        results.write(json_file, _judged(found))
    if plot is not None:
        soak_hours.draw(results, plot)
    _tell(soak_hours.grids(results), [], found, console, markdown, strict=True)


@app.command()
def ingest(
    rows: Annotated[int, typer.Option(min=1000, help="Of the recording, at 1 kHz.")] = 1_000_000,
    joints: Annotated[int, typer.Option(min=1, max=32, help="Of the robot.")] = 7,
    formats: Annotated[str, typer.Option(help="Names separated by commas.")] = ",".join(FORMATS),
    seed: Seed = 0,
    json_file: JsonFile = None,
    markdown: Markdown = None,
    strict: Strict = False,
) -> None:
    """Upload a long recording; time and memory until its report is there."""
    options = ingest_running.Options(rows, joints, _names(formats), seed=seed)
    console = _begin()
    results = ingest_running.run(options, console)
    found = ingest_running.targets(results)
    if json_file is not None:
        results.write(json_file, _judged(found))
    _tell(ingest_running.grids(results), [], found, console, markdown, strict)


@app.command()
def scale(
    sizes: Annotated[
        str | None, typer.Option(help="Samples of the training jobs, with commas: 200000,1000000 by default.")
    ] = None,
    only: Annotated[str | None, typer.Option(help=f"Names separated by commas: {', '.join(SCALE_PARTS)}.")] = None,
    seed: Seed = 0,
    quick: Annotated[bool, typer.Option("--quick", help="A first look in a few minutes.")] = False,
    json_file: JsonFile = None,
    markdown: Markdown = None,
    strict: Strict = False,
) -> None:
    """Several services and workers, with PostgreSQL, S3 and Dask started here: scaling, following, costs, faults."""
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
    _tell(list(results.grids()), results.notes(), results.targets(), console, markdown, strict)


@app.command()
def exported(
    folder: Annotated[
        Path, typer.Option(exists=True, file_okay=False, help="Of a saved model of rigid bodies.")
    ] = exported_running.SHIPPED,
    calls: Annotated[int, typer.Option(min=20, help="Of each function.")] = 1_000_000,
    flags: Annotated[str, typer.Option(help="Of cc, with spaces.")] = "-O2",
    eigen: Annotated[
        Path | None,
        typer.Option(exists=True, file_okay=False, help="Headers of Eigen: times Pinocchio in C++, not from Python."),
    ] = None,
    seed: Seed = 0,
    json_file: JsonFile = None,
    markdown: Markdown = None,
    strict: Strict = False,
) -> None:
    """Time a model as C beside Pinocchio, and compare its numbers with the model's on random states."""
    console = _begin()
    options = exported_running.Options(folder.absolute(), calls, flags=tuple(flags.split()), eigen=eigen, seed=seed)
    results = exported_running.run(options, console)
    found = exported_running.targets(results)
    if json_file is not None:
        results.write(json_file, _judged(found))
    _tell(exported_running.grids(results), [], found, console, markdown, strict)


@app.command()
def real(
    folder: Annotated[Path, typer.Argument(exists=True, file_okay=False, help="Of the recordings.")],
    out: Annotated[
        Path, typer.Option(file_okay=False, help="Folder of the results. What is there is not computed again.")
    ] = Path("build/real"),
    only: Annotated[str, typer.Option(help="Pattern that recording/split/told/method must contain.")] = "",
    jobs: Annotated[int, typer.Option(min=1, help="Cells computed at a time. Compare seconds with 1.")] = 1,
    tables: Annotated[bool, typer.Option("--table", help="Compute nothing: print the results that there are.")] = False,
    revision: Annotated[
        str | None, typer.Option(help="Of the product, by which its results are kept. By default from git.")
    ] = None,
    page: Annotated[Path | None, typer.Option(dir_okay=False, help="Also write the documentation's page here.")] = None,
    strict: Strict = False,
) -> None:
    """Train on recordings of real arms with default options, beside what others try first: hours, resumable."""
    console = _begin()
    known = revision or product_revision()
    options = real_running.Options(folder, out, known, only, jobs, compute=not tables)
    outcome = real_running.run(options, console)
    if page is not None:
        page.write_text(real_report.page(outcome, known))
    found = real_report.targets(outcome.results)
    _tell(real_report.grids(outcome), real_report.notes(outcome), found, console, None, strict)
    if outcome.failed:
        raise BenchError(f"{counted(len(outcome.failed), 'cell')} failed. The same command computes what is missing.")


def _begin() -> Console:
    """Let a request to end also end the services that are measured; return where to print."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    return Console(width=None if sys.stdout.isatty() else table.WIDTH)


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(","))


def _judged(found: Sequence[Target]) -> list[dict[str, Any]]:
    """What was promised and measured, as JSON values."""
    return [{**asdict(each), "met": each.met} for each in found]


def _tell(
    grids: Sequence[table.Grid],
    notes: Sequence[str],
    found: Sequence[Target],
    console: Console,
    markdown: Path | None,
    strict: bool,
) -> None:
    """Print the tables and whether all promises were kept; exit with 1 where one was missed and `strict` is set."""
    table.show_grids(grids, notes, console)
    if markdown is not None:
        markdown.write_text(table.grids_markdown(grids, notes))
    missed = [each for each in found if each.met is False]
    said = f"{len(missed)} of {sum(each.met is not None for each in found)} promises were missed"
    console.print(said if missed else "every promise that was measured was kept", highlight=False)
    if strict and missed:
        raise typer.Exit(1)
