"""`lipserve bench`: the command line of the benchmarks."""

from __future__ import annotations

import signal
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from service.bench import table
from service.bench.clients import BadAnswerError
from service.bench.running import KEYS, Options, run
from service.bench.targets import targets
from service.bench.workload import BenchError, Source, model_folder
from service.client import ApiError
from service.demo import DemoError
from service.errors import ServiceError
from service.stream.client import StreamError

app = typer.Typer(no_args_is_help=True, pretty_exceptions_enable=False)
ERRORS = (ApiError, BadAnswerError, BenchError, DemoError, ServiceError, StreamError)
"""What a user is told without a traceback."""

QUICK_RUNS, QUICK_QUERIES, QUICK_SECONDS = 3, 1000, 5.0
QUICK_FIT = {"hyperparameter_samples": 80, "max_iterations": 50, "starts": 1}
"""Of the model; all samples stand behind its posterior all the same."""


@app.callback()
def _bench() -> None:
    """Measure this machine."""  # with one command only, typer would drop its name otherwise


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
    json_file: Annotated[Path | None, typer.Option("--json", dir_okay=False, help="Also write every run here.")] = None,
    markdown: Annotated[Path | None, typer.Option(dir_okay=False, help="Also write the tables here.")] = None,
    strict: Annotated[bool, typer.Option("--strict", help="Exit with 1 where something promised was missed.")] = False,
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
        only=() if only is None else tuple(name.strip() for name in only.split(",")),
    )
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))  # ends the service that is measured, too
    console = Console(width=None if sys.stdout.isatty() else table.WIDTH)
    results = run(options, console)
    found = targets(results)
    table.show(results, console)
    if json_file is not None:
        results.write(json_file, [{**asdict(each), "met": each.met} for each in found])
    if markdown is not None:
        markdown.write_text(table.markdown(results))
    missed = [each for each in found if each.met is False]
    said = f"{len(missed)} of {sum(each.met is not None for each in found)} promises were missed"
    console.print(said if missed else "every promise that was measured was kept", highlight=False)
    if strict and missed:
        raise typer.Exit(1)
