"""The command that measures batches."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from benchmarks.batch import running as batch_running
from benchmarks.batch import transports as batch_transports
from benchmarks.exported import running as exported_running
from benchmarks.options import JsonFile, Markdown, Strict, begin, report

SIZES, TRANSPORT_SIZES = "1,10,100,1000,10000,100000,1000000", "10000,100000"


def batch(
    folder: Annotated[
        Path, typer.Option(exists=True, file_okay=False, help="Folder of a saved model.")
    ] = exported_running.SHIPPED,
    sizes: Annotated[
        str | None,
        typer.Option(help=f"States in a batch, separated by commas: {SIZES}, with --transports {TRANSPORT_SIZES}."),
    ] = None,
    repetitions: Annotated[int, typer.Option(min=1, help="Repetitions; the best counts.")] = 10,
    eigen: Annotated[
        Path | None,
        typer.Option(
            exists=True, file_okay=False, help="Eigen's headers, for Pinocchio in C++. CasADi's package has some."
        ),
    ] = None,
    device: Annotated[str | None, typer.Option(help="Device of PyTorch that is measured too, such as cuda.")] = None,
    transports: Annotated[
        bool, typer.Option("--transports", help="Measure binary batches over HTTP and gRPC against in process instead.")
    ] = False,
    json_file: JsonFile = None,
    markdown: Markdown = None,
    strict: Strict = False,
) -> None:
    """Time batches in process, beside Pinocchio, CasADi and frax, as far as they are installed."""
    console, text = begin(), sizes or (TRANSPORT_SIZES if transports else SIZES)
    counts = tuple(int(each) for each in text.split(","))
    results: batch_running.Results | batch_transports.Results
    if transports:
        results = batch_transports.run(folder, counts, repetitions, console)
        found, grids, notes = batch_transports.targets(results), batch_transports.grids(results), []
    else:
        options = batch_running.Options(folder, counts, repetitions, eigen, device)
        results = batch_running.run(options, console)
        found, grids, notes = batch_running.targets(results), batch_running.grids(results), results.notes
    report(grids, notes, found, console, markdown, strict, json_file, results)
