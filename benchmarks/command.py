"""The command line of the benchmarks."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from benchmarks.batch.command import batch
from benchmarks.clients import BadAnswerError
from benchmarks.exported import running as exported_running
from benchmarks.ingest import running as ingest_running
from benchmarks.ingest.recording import FORMATS
from benchmarks.latency import table
from benchmarks.latency.running import KEYS, Options, run
from benchmarks.latency.targets import targets
from benchmarks.online.command import durability, online
from benchmarks.options import QUICK_FIT, JsonFile, Markdown, Seed, Strict, begin, report, split_names
from benchmarks.real import report as real_report
from benchmarks.real import running as real_running
from benchmarks.real.cells import product_revision
from benchmarks.scale import running as scale_running
from benchmarks.scale.running import PARTS as SCALE_PARTS
from benchmarks.soak.command import load, soak
from benchmarks.workload import BenchError, Source, model_folder
from lipserve import ApiError, StreamError
from lipserve.wording import counted
from service.cli.demo import DemoError
from service.foundation.errors import ServiceError

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)
ERRORS = (ApiError, BadAnswerError, BenchError, DemoError, ServiceError, StreamError)
"""Errors printed without a traceback."""
QUICK_RUNS, QUICK_QUERIES, QUICK_SECONDS = 3, 1000, 5.0


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
        only=() if only is None else split_names(only),
    )
    console = begin()
    results = run(options, console)
    found = targets(results)
    report(table.grids(results), results.notes, found, console, markdown, strict, json_file, results)


for _command in (online, durability, load, soak, batch):
    app.command()(_command)


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
    options = ingest_running.Options(rows, joints, split_names(formats), seed=seed)
    console = begin()
    results = ingest_running.run(options, console)
    found = ingest_running.targets(results)
    report(ingest_running.grids(results), [], found, console, markdown, strict, json_file, results)


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
        chosen["only"] = split_names(only)
    options = scale_running.Options(**chosen)
    console = begin()
    results = scale_running.run(options, console)
    report(list(results.grids()), results.notes(), results.targets(), console, markdown, strict, json_file, results)


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
    console = begin()
    options = exported_running.Options(folder.absolute(), calls, flags=tuple(flags.split()), eigen=eigen, seed=seed)
    results = exported_running.run(options, console)
    found = exported_running.targets(results)
    report(exported_running.grids(results), [], found, console, markdown, strict, json_file, results)


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
    console = begin()
    known = revision or product_revision()
    options = real_running.Options(folder, out, known, only, jobs, compute=not tables)
    outcome = real_running.run(options, console)
    if page is not None:
        page.write_text(real_report.page(outcome, known))
    found = real_report.targets(outcome.results)
    report(real_report.grids(outcome), real_report.notes(outcome), found, console, None, strict)
    if outcome.failed:
        raise BenchError(f"{counted(len(outcome.failed), 'cell')} failed. Run the command again to retry.")
