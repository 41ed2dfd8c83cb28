"""`lipserve predict`, `lipserve evaluate` and `lipserve bench`."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from lipcore.vocabulary import COMPONENTS
from lipserve.address import DEFAULT_URL
from lipserve.call import given
from service.cli.connecting import connected, dataset_of
from service.cli.consoles import CommandError, out, print_json, print_warnings
from service.cli.options import Data, Json, ModelVersion, Url, alone, group, names, numbers
from service.cli.versions import print_verdict
from service.foundation.text import counted

if TYPE_CHECKING:
    from lipcore.data.samples import Array
    from lipserve import Client

predict_app = alone()


@predict_app.command()
def predict(
    model: ModelVersion,
    q: Annotated[str, typer.Option("--q", help="Positions, rad, separated by commas.")],
    dq: Annotated[str | None, typer.Option("--dq", help="Velocities, rad/s. Default: zero.")] = None,
    ddq: Annotated[str | None, typer.Option("--ddq", help="Accelerations, rad/s². Default: zero.")] = None,
    components: Annotated[
        str | None,
        typer.Option(
            help=f"Components to return too, separated by commas: {', '.join(COMPONENTS)}.",
            autocompletion=lambda: COMPONENTS,
        ),
    ] = None,
    tau: Annotated[str | None, typer.Option("--tau", help="Torques, N·m, for forward_dynamics.")] = None,
    payload: Annotated[
        str | None,
        typer.Option(help="Payload mass,x,y,z: mass, kg, and centre of mass in the frame of the last link, m."),
    ] = None,
    payload_inertia: Annotated[
        str | None,
        typer.Option(help="Payload inertia xx,xy,xz,yy,yz,zz about its centre of mass, kg·m². Default: a point mass."),
    ] = None,
    min_revision: Annotated[
        int | None,
        typer.Option(min=0, help="Min revision of the answer, to include acknowledged observations."),
    ] = None,
    url: Url = DEFAULT_URL,
    as_json: Json = False,
) -> None:
    """Predict the torque at one motion.

    tau_std is the standard deviation of the model's torque, noise_std that of a measurement around it. A prediction
    interval for measurements needs both.
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
            components=names(components) or [],
            tau=torque,
            min_revision=min_revision,
            payload=body,
        )
    if as_json:
        print_json(answer)
        return
    from service.cli.tables import prediction_tables  # noqa: PLC0415 - slow import, not needed for help

    for table in prediction_tables(answer):
        out.print(table)


def _body(payload: str | None, inertia: str | None) -> dict[str, Any] | None:
    """Return the payload that the options describe; raise CommandError for a wrong number of values."""
    if payload is None:
        if inertia is not None:
            raise CommandError("--payload-inertia requires --payload")
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
        raise CommandError(f"{option} must have the form {expected}, got {text!r}")
    return given


evaluate_app = alone()


@evaluate_app.command()
def evaluate(
    model: ModelVersion,
    data: Data,
    url: Url = DEFAULT_URL,
    robot: Annotated[
        str | None,
        typer.Option(help="Robot of a recording to upload: profile such as panda, or id of an uploaded URDF."),
    ] = None,
    held_out: Annotated[
        bool, typer.Option("--held-out", help="Evaluate only on the part that the version's training held out.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Evaluate a model on a recording, joint by joint. On training data, the figures are too optimistic."""
    with connected(url) as client:
        dataset = dataset_of(client, data, **given(robot=robot))
        answer = client.evaluate(model, dataset, part="held_out" if held_out else "all")
    if as_json:
        print_json(answer)
        return
    print_verdict(answer.title, answer.verdict)
    print_warnings(answer.warnings)


bench_app = group("Measure the latency of a service from this machine.")
bench_app.callback()(lambda: None)  # makes it a group although it has one command
WARM_UP = 20
"""Number of queries before the timed ones, for each transport."""


@bench_app.command()
def latency(
    model: ModelVersion,
    queries: Annotated[int, typer.Option(min=1, max=1_000_000, help="Number of queries for each transport.")] = 2000,
    url: Url = DEFAULT_URL,
    as_json: Json = False,
) -> None:
    """Measure the latency of sequential torque queries with tau_std, over a stream and over HTTP.

    Motions are random, within the training range of the model. Times include the Python client.
    """
    import numpy as np  # noqa: PLC0415 - slow import, not needed for help

    with connected(url) as client:
        version, motions = random_motions(client, model, queries + WARM_UP)
        with client.stream(model) as stream:
            times = {"stream": _timed(lambda k: stream.predict(*motions[k]), queries)}
        times["HTTP"] = _timed(lambda k: client.predict(model, *motions[k]), queries)
    figures = {
        name: dict(zip(("p50", "p99", "largest"), np.percentile(each, (50, 99, 100)).tolist(), strict=True))
        for name, each in times.items()
    }
    if as_json:
        print_json({"model": model, "version": version, "queries": queries, "milliseconds": figures})
        return
    table = Table(
        "ms per query",
        "p50",
        "p99",
        "largest",
        title=f"{model} version {version}, {counted(queries, 'query', 'queries')}",
    )
    for name, each in figures.items():
        table.add_row(name, *(f"{value:.2f}" for value in each.values()))
    out.print(table)


def random_motions(client: Client, model: str, count: int) -> tuple[int, Array]:
    """Return the serving version, and motions (count, 3, n) within its training range: q, dq and ddq."""
    import numpy as np  # noqa: PLC0415 - as above

    served = client.model(model)
    version = client.version(model, served.serving_version or served.latest_version)
    low, high = (
        np.array([version.training_range[name][side] for name in ("q", "dq", "ddq")]) for side in ("min", "max")
    )
    return version.version, np.random.default_rng(0).uniform(low, high, (count, *low.shape))


def _timed(ask: Callable[[int], object], queries: int) -> list[float]:
    """Return the time of each query, ms. ask: sends query k and waits for its answer."""
    times = []
    for number in range(queries + WARM_UP):
        began = time.perf_counter()
        ask(number)
        times.append(1e3 * (time.perf_counter() - began))
    return times[WARM_UP:]
