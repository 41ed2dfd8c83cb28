"""`lipserve predict`, `lipserve evaluate`, and `lipserve bench`: how long this machine takes to answer."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Annotated, Any

import typer
from rich.table import Table

from lipcore.vocabulary import COMPONENTS
from lipserve.address import DEFAULT_URL
from lipserve.call import given
from service.cli.connecting import connected, dataset_of
from service.cli.consoles import CommandError, out, print_json, print_warnings
from service.cli.options import Alias, Data, Json, Model, Url, Version, alone, group, names, numbers
from service.foundation.text import counted

predict_app = alone()


@predict_app.command()
def predict(
    model: Model,
    q: Annotated[str, typer.Option("--q", help="Positions, rad, separated by commas.")],
    dq: Annotated[str | None, typer.Option("--dq", help="Velocities, rad/s; zero by default.")] = None,
    ddq: Annotated[str | None, typer.Option("--ddq", help="Accelerations, rad/s²; zero by default.")] = None,
    components: Annotated[
        str | None,
        typer.Option(
            help=f"Parts of the dynamics, separated by commas: {', '.join(COMPONENTS)}.",
            autocompletion=lambda: COMPONENTS,
        ),
    ] = None,
    tau: Annotated[str | None, typer.Option("--tau", help="Torques, N·m, for forward_dynamics.")] = None,
    payload: Annotated[
        str | None,
        typer.Option(
            help="What the arm carries: kg, and x,y,z of its centre of mass in the frame of the last link, m."
        ),
    ] = None,
    payload_inertia: Annotated[
        str | None,
        typer.Option(help="Its inertia xx,xy,xz,yy,yz,zz about that centre, kg·m²; that of a point by default."),
    ] = None,
    version: Version = None,
    alias: Alias = None,
    min_revision: Annotated[
        int | None, typer.Option(min=0, help="Answer with this revision or a later one: what was taught is in it.")
    ] = None,
    url: Url = DEFAULT_URL,
    as_json: Json = False,
) -> None:
    """Ask a model for the torque at one motion.

    tau_std is how well the model knows the torque, noise_std what a measurement scatters around it: an interval that
    shall hold measurements needs both.
    """
    position = numbers("--q", q)
    zeros = [0.0] * len(position)
    velocity = zeros if dq is None else numbers("--dq", dq)
    acceleration = zeros if ddq is None else numbers("--ddq", ddq)
    torque = None if tau is None else numbers("--tau", tau)
    body = _body(payload, payload_inertia)
    with connected(url) as client:
        answer = client.predict(
            model,
            position,
            velocity,
            acceleration,
            version=version,
            alias=alias,
            components=names(components) or [],
            tau=torque,
            min_revision=min_revision,
            payload=body,
        )
    if as_json:
        print_json(answer)
        return
    from service.cli.tables import prediction_tables  # noqa: PLC0415 - takes long to import; help needs none

    for table in prediction_tables(answer):
        out.print(table)


def _body(payload: str | None, inertia: str | None) -> dict[str, Any] | None:
    """A payload of the numbers that options give; raise CommandError where they are not as many as they should be."""
    if payload is None:
        if inertia is not None:
            raise CommandError("--payload-inertia is given, expected --payload beside it")
        return None
    mass, *com = _as_many("--payload", payload, "mass,x,y,z")
    body: dict[str, Any] = {"mass": mass, "com": com}
    if inertia is not None:
        xx, xy, xz, yy, yz, zz = _as_many("--payload-inertia", inertia, "xx,xy,xz,yy,yz,zz")
        body["inertia"] = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]
    return body


def _as_many(option: str, text: str, expected: str) -> list[float]:
    given = numbers(option, text)
    if len(given) != len(expected.split(",")):
        raise CommandError(f"{option} is {text!r}, expected {expected}")
    return given


evaluate_app = alone()


@evaluate_app.command()
def evaluate(
    model: Model,
    data: Data,
    url: Url = DEFAULT_URL,
    version: Version = None,
    alias: Alias = None,
    robot: Annotated[
        str | None, typer.Option(help="Of a recording: a profile such as panda, or the id of an uploaded URDF.")
    ] = None,
    held_out: Annotated[
        bool, typer.Option("--held-out", help="Only on what the training of the version held out of it.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Compare a model with a recording, joint by joint. On what it was trained on, the figures flatter."""
    with connected(url) as client:
        dataset = dataset_of(client, data, **given(robot=robot))
        answer = client.evaluate(model, dataset, version, alias, "held_out" if held_out else "all")
    if as_json:
        print_json(answer)
        return
    from service.cli.tables import evaluation_table  # noqa: PLC0415 - takes long to import; help needs none

    out.print(evaluation_table(answer))
    print_warnings(answer.warnings)


bench_app = group("Measure this machine.")
bench_app.callback()(lambda: None)  # a group, of its one command
WARM_UP = 20
"""Queries of each way before those that are timed."""


@bench_app.command()
def latency(
    model: Model,
    queries: Annotated[int, typer.Option(min=1, max=1_000_000, help="Of each way to ask.")] = 2000,
    url: Url = DEFAULT_URL,
    as_json: Json = False,
) -> None:
    """Time torque queries with tau_std, one after another, over a stream and over HTTP.

    Motions are drawn from the range that the model was trained on. Times include Python's client.
    """
    import numpy as np  # noqa: PLC0415 - takes long to import; help needs none

    with connected(url) as client:
        served = client.model(model)
        version = client.version(model, served.serving_version or served.latest_version)
        low, high = (
            np.array([version.training_range[name][side] for name in ("q", "dq", "ddq")]) for side in ("min", "max")
        )
        motions = np.random.default_rng(0).uniform(low, high, (queries + WARM_UP, *low.shape))
        with client.stream(model) as stream:
            times = {"stream": _timed(lambda k: stream.predict(*motions[k]), queries)}
        times["HTTP"] = _timed(lambda k: client.predict(model, *motions[k]), queries)
    figures = {
        name: dict(zip(("p50", "p99", "largest"), np.percentile(each, (50, 99, 100)).tolist(), strict=True))
        for name, each in times.items()
    }
    if as_json:
        print_json({"model": model, "version": version.version, "queries": queries, "milliseconds": figures})
        return
    table = Table(
        "ms a query",
        "p50",
        "p99",
        "largest",
        title=f"{model} version {version.version}, {counted(queries, 'query', 'queries')}",
    )
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
