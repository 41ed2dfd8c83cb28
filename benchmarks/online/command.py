"""Commands that measure online learning."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import typer

from benchmarks import facts
from benchmarks.online import durability as durable
from benchmarks.online import pickup, pickup_table
from benchmarks.online import running as online_running
from benchmarks.online import table as online_table
from benchmarks.online.arms import KINDS
from benchmarks.online.running import PARTS
from benchmarks.online.scene import Scene
from benchmarks.online.targets import targets as online_targets
from benchmarks.options import (
    QUICK_FIT,
    JsonFile,
    Markdown,
    Robot,
    Seed,
    Strict,
    begin,
    report,
    split_names,
)

QUICK_ONLINE: dict[str, Any] = {
    "idle_s": 4.0,
    "burst_s": 6.0,
    "after": (0.5, 3.0, 6.0),
    "sizes": (1_000, 4_000),
    "refit_every": 6.0,
}


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
    if only is not None and set(split_names(only)) & set(pickup.PARTS):
        payloads = pickup.Options(split_names(only), split_names(arms), split_names(kinds), minutes, seed)
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
        only=() if only is None else split_names(only),
        **short,
    )
    console = begin()
    results = online_running.run(options, console)
    found = online_targets(results)
    report(online_table.grids(results), results.notes, found, console, markdown, strict, json_file, results)


def _measure_payloads(options: pickup.Options, json_file: Path | None, markdown: Path | None, strict: bool) -> None:
    """Measure how payloads are noticed and estimated; print and write the results."""
    console = begin()
    with facts.one_thread():
        found = pickup.run(options, console)
    targeted = pickup_table.targets(found)
    report(pickup_table.grids(found), pickup_table.NOTES, targeted, console, markdown, strict, json_file, found)


def durability(
    trials: Annotated[int, typer.Option(min=1, help="Number of kills, of service and learner in turn.")] = 100,
    seed: Seed = 0,
    json_file: JsonFile = None,
    markdown: Markdown = None,
    strict: Strict = False,
) -> None:
    """Kill the service or its learner while it learns; count lost and duplicate batches. 2 to 4 s a trial."""
    console = begin()
    with TemporaryDirectory(prefix="lipserve-bench-") as folder:
        tally = durable.run(Path(folder), trials, seed, console)
    found = durable.targets(tally)
    report(durable.grids(tally), [durable.NOTE], found, console, markdown, strict, json_file, tally)
