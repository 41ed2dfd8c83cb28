"""`lipserve train`."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from lipcore.vocabulary import CHOICES, DEFAULT_ESTIMATOR
from service.cli import connecting
from service.cli.connecting import connected, dataset_of, watch
from service.cli.consoles import INTERRUPTED, CommandError, note, out, print_json, say
from service.cli.models import print_selection
from service.cli.options import HELD_OUT_BY, Json, Url, alone, names, pairs
from service.foundation.settings import DEFAULT_URL

app = alone()


@app.command()
def train(
    data: Annotated[
        list[str],
        typer.Argument(
            help="Recordings, which are uploaded, and ids of data sets.", autocompletion=connecting.datasets
        ),
    ],
    model: Annotated[
        str,
        typer.Option(help="Name of the model; a new version of it is made.", autocompletion=connecting.models),
    ],
    url: Url = DEFAULT_URL,
    estimator: Annotated[
        str | None,
        typer.Option(
            help=f"One of {', '.join(CHOICES)}; {DEFAULT_ESTIMATOR} by default, which trains three and takes the one "
            "that predicts best what it has not seen.",
            autocompletion=lambda: list(CHOICES),
        ),
    ] = None,
    joint_types: Annotated[
        str | None, typer.Option(help="One a joint, separated by commas; all revolute by default.")
    ] = None,
    robot: Annotated[
        str | None, typer.Option(help="Of rigid bodies: a profile such as panda, the id of a URDF, or a .urdf file.")
    ] = None,
    prior: Annotated[
        str | None,
        typer.Option(help="Of rigid bodies: around the parameters of the `urdf` (default) or around `zero`."),
    ] = None,
    option: Annotated[
        list[str] | None,
        typer.Option(help="How to fit, as max_iterations=100: see `options` of POST /v1/jobs; repeat."),
    ] = None,
    hold_out: Annotated[
        float | None, typer.Option(help="Share of the samples to hold out and evaluate the model on, such as 0.3.")
    ] = None,
    hold_out_by: Annotated[
        str | None,
        typer.Option(
            help="What is held out: whole `episodes`, the `last` part (default), or some of ten `blocks`.",
            autocompletion=lambda: HELD_OUT_BY,
        ),
    ] = None,
    wait: Annotated[bool, typer.Option(help="Wait for the job's end; --no-wait leaves it to `lipserve jobs`.")] = True,
    as_json: Json = False,
) -> None:
    """Upload recordings and train a model on them. Ctrl-C cancels the job."""
    # the client takes long to import; help needs none
    from service.client.call import new_key  # noqa: PLC0415

    options: dict[str, Any] = {name: _value(text) for name, text in pairs("--option", option).items()}
    if prior is not None:
        options["prior"] = prior
    asked = {name: value for name, value in (("share", hold_out), ("kind", hold_out_by)) if value is not None}
    with connected(url) as client:
        datasets = [dataset_of(client, each) for each in data]
        if robot is not None and robot.endswith(".urdf"):
            robot = client.upload_robot(Path(robot)).id
        queue = partial(
            client.train,
            model,
            datasets,
            estimator,
            names(joint_types),
            options or None,
            robot=robot,
            holdout=asked or None,
            idempotency_key=new_key(),
        )
        try:
            job = queue()
        except KeyboardInterrupt:
            client.cancel(queue().id)  # the same job, whether the first request has arrived or not
            raise
        interrupted = False
        if wait:
            job, interrupted = watch(client, job, cancels=True)
        made = None if job.version is None else client.version(model, job.version)
    if as_json:
        print_json(job)
    if interrupted and job.version is None:
        note(f"{job.id} is cancelled")
        raise typer.Exit(INTERRUPTED)
    if wait and job.version is None:
        message = f"{job.id} has {job.state}" + (f": {job.error.message}" if job.error else "")
        raise CommandError(message, f"`lipserve jobs show {job.id}` tells its history")
    if as_json:
        return
    if not wait:
        say(f"{job.id} is queued: `lipserve jobs follow {job.id}`")
        return
    say(f"{model} version {job.version} is trained and answers")
    if made is not None and made.selection is not None:
        print_selection(made.selection)
    if made is not None and asked:
        from service.cli.tables import figures_table  # noqa: PLC0415 - as above

        held = made.lineage["holdout"]
        out.print(figures_table(f"on {held['samples']} samples held out", made.joint_names, held))


def _value(text: str) -> Any:
    """A number or a truth value where it is one."""
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return {"true": True, "false": False}.get(text.lower(), text)
