"""`lipserve bench`: how long this machine takes to answer."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Annotated

import numpy as np
import typer
from rich.table import Table

from service.cli.connecting import connected
from service.cli.consoles import out, print_json
from service.cli.options import Json, Model, Url
from service.foundation.settings import DEFAULT_URL

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)
WARM_UP = 20
"""Queries of each way before those that are timed."""


@app.callback()
def _bench() -> None:
    """Measure this machine."""


@app.command()
def latency(
    model: Model,
    queries: Annotated[int, typer.Option(min=1, max=1_000_000, help="Of each way to ask.")] = 2000,
    url: Url = DEFAULT_URL,
    as_json: Json = False,
) -> None:
    """Time torque queries with tau_std, one after another, over a stream and over HTTP.

    Motions are drawn from the range that the model was trained on. Times include Python's client.
    """
    with connected(url) as client:
        version = client.version(model, client.model(model).serving_version)
        low, high = (
            np.array([version.training_range[name][side] for name in ("q", "dq", "ddq")]) for side in ("min", "max")
        )
        motions = np.random.default_rng(0).uniform(low, high, (queries + WARM_UP, *low.shape))
        with client.stream(model) as stream:
            times = {"stream": _timed(lambda k: stream.ask(*motions[k]), queries)}
        times["HTTP"] = _timed(lambda k: client.predict(model, *motions[k]), queries)
    figures = {
        name: dict(zip(("p50", "p99", "largest"), np.percentile(each, (50, 99, 100)).tolist(), strict=True))
        for name, each in times.items()
    }
    if as_json:
        print_json({"model": model, "version": version.version, "queries": queries, "milliseconds": figures})
        return
    table = Table("ms a query", "p50", "p99", "largest", title=f"{model} version {version.version}, {queries} queries")
    for name, each in figures.items():
        table.add_row(name, *(f"{value:.2f}" for value in each.values()))
    out.print(table)


def _timed(ask: Callable[[int], object], queries: int) -> list[float]:
    """Milliseconds of each query; ask: sends query number k and waits for its answer."""
    times = []
    for number in range(queries + WARM_UP):
        began = time.perf_counter()
        ask(number)
        times.append(1e3 * (time.perf_counter() - began))
    return times[WARM_UP:]
