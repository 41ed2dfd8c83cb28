"""Commands that load a service for long."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from benchmarks.options import JsonFile, Markdown, Robot, Seed, Strict, begin, report
from benchmarks.soak import hours as soak_hours
from benchmarks.soak import running as soak_running
from benchmarks.soak import table as soak_table


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
    console = begin()
    results = soak_running.run(options, console)
    found = soak_table.targets(results)
    report(soak_table.grids(results), [], found, console, markdown, strict, json_file, results)


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
    console = begin()
    results = soak_hours.run(options, console)
    found = soak_hours.targets(results)
    if plot is not None:
        soak_hours.draw(results, plot)
    report(soak_hours.grids(results), [], found, console, markdown, True, json_file, results)
