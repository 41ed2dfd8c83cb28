"""`lipserve predict` and `lipserve evaluate`."""

from __future__ import annotations

from typing import Annotated

import typer

from lipcore.vocabulary import COMPONENTS
from service.cli.connecting import connected, dataset_of
from service.cli.consoles import out, print_json
from service.cli.options import Alias, Data, Json, Model, Url, Version, names, numbers
from service.foundation.settings import DEFAULT_URL

predict_app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


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
        )
    if as_json:
        print_json(answer)
        return
    from service.cli.tables import prediction_tables  # noqa: PLC0415 - takes long to import; help needs none

    for table in prediction_tables(answer):
        out.print(table)


evaluate_app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@evaluate_app.command()
def evaluate(
    model: Model,
    data: Data,
    url: Url = DEFAULT_URL,
    version: Version = None,
    alias: Alias = None,
    held_out: Annotated[
        bool, typer.Option("--held-out", help="Only on what the training of the version held out of it.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Compare a model with a recording, joint by joint. On what it was trained on, the figures flatter."""
    with connected(url) as client:
        dataset = dataset_of(client, data)
        answer = client.evaluate(model, dataset, version, alias, "held_out" if held_out else "all")
    if as_json:
        print_json(answer)
        return
    from service.cli.tables import evaluation_table  # noqa: PLC0415 - takes long to import; help needs none

    out.print(evaluation_table(answer))
