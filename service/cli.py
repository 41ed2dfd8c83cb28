"""The command line: `lipserve`."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer
import uvicorn
from pydantic import ValidationError
from rich.console import Console
from rich.markup import escape

from lipcore.dynamics import COMPONENTS
from lipcore.estimators import DEFAULT_ESTIMATOR, ESTIMATORS
from lipcore.robots import ROBOTS, SimulationUnavailableError, load_robot
from lipcore.simulation import FAST, Payload, Stream, simulate
from service import __version__, recordings, sockets
from service.access import commands as keys
from service.app import create_app
from service.home import HomeError, check_home
from service.limits.connections import guarded
from service.observability import logs
from service.settings import DEFAULT_URL, Settings
from service.stream.protocol import StreamProtocol
from service.tables import evaluation_table, figures_table, prediction_tables
from service.training.states import SUCCEEDED

if TYPE_CHECKING:
    from service.client import ApiError, Client

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Learn a manipulator's inverse dynamics and serve torques with uncertainty.",
)
PIPE_WIDTH = 160
"""Columns of a table that no terminal shows: room for the inertia matrix of seven joints."""
out = Console(soft_wrap=True, width=None if sys.stdout.isatty() else PIPE_WIDTH)
err = Console(stderr=True, soft_wrap=True)

Url = Annotated[str, typer.Option("--url", envvar="LIPSERVE_URL", help="Address of the service.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")]
Files = Annotated[list[Path], typer.Argument(exists=True, dir_okay=False, help="Recordings, .csv or .npz.")]
_PASS_ON = {"allow_extra_args": True, "ignore_unknown_options": True}
"""Of commands whose own modules, loaded only for them, read their options."""


def main() -> None:
    """Run the command line; errors that a user can act on are printed without a traceback."""
    try:
        app()
    except (HomeError, SimulationUnavailableError, ValueError, OSError) as error:
        _fail(str(error))


@app.callback(invoke_without_command=True)
def _root(version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False) -> None:
    if version:
        out.print(__version__)
        raise typer.Exit


@app.command()
def serve(
    host: Annotated[str | None, typer.Option(help="Address to listen on (LIPSERVE_HOST).")] = None,
    port: Annotated[int | None, typer.Option(help="Port to listen on (LIPSERVE_PORT).")] = None,
    uds: Annotated[Path | None, typer.Option(help="Unix-domain socket to listen on too (LIPSERVE_UDS).")] = None,
) -> None:
    """Serve models and run training jobs."""
    given = {name: value for name, value in (("host", host), ("port", port), ("uds", uds)) if value is not None}
    try:
        settings = Settings(**given)  # type: ignore[arg-type]  # validated here
    except ValidationError as error:
        _fail("; ".join(f"{'.'.join(map(str, e['loc'])) or 'settings'}: {e['msg']}" for e in error.errors()))
    logs.configure(logs.LogOptions(settings.log_level, settings.log_format))
    check_home(settings)  # before the app opens it for good: what is wrong is said without a traceback
    served = create_app(settings)
    config = uvicorn.Config(
        served,
        host=settings.host,
        port=settings.port,
        log_config=None,  # as configured above
        access_log=False,  # the service's own says more
        loop="uvloop",
        http=guarded(settings),
        ws=StreamProtocol,
        ws_max_size=settings.max_stream_frame_bytes,
        ws_per_message_deflate=False,
        timeout_keep_alive=settings.keep_alive_s,
        timeout_graceful_shutdown=settings.drain_s,
        forwarded_allow_ips=settings.trusted_proxies,
    )
    sockets.serve(config, settings.uds, settings.uds_mode, served.state.stopping, settings.stop_notice_s)


@app.command("simulate")
def simulate_(
    robot: Annotated[str, typer.Argument(help=f"One of {', '.join(ROBOTS)}.")],
    output: Annotated[Path, typer.Argument(help="File to write, .csv or .npz.", dir_okay=False)],
    seed: Annotated[int, typer.Option(min=0, help="Equal seeds give equal streams.")] = 0,
    samples: Annotated[int, typer.Option(min=2)] = 500,
    rate: Annotated[float, typer.Option(help="Hz.")] = 10.0,
    sinusoids: Annotated[int, typer.Option(min=1, help="50 for training, 100 for testing in the paper.")] = 50,
    motion: Annotated[str, typer.Option(help="middle (±0.5 rad) or full.")] = "middle",
    fast: Annotated[bool, typer.Option(help="The faster-moving variant.")] = False,
    noise: Annotated[float, typer.Option(help="Std of the torque noise, N·m.")] = 0.01,
    viscous: Annotated[float, typer.Option(help="Viscous friction, N·m·s/rad.")] = 0.0,
    coulomb: Annotated[float, typer.Option(help="Coulomb friction, N·m.")] = 0.0,
    payload: Annotated[float, typer.Option(help="Payload, kg.")] = 0.0,
    payload_at: Annotated[float, typer.Option(help="When the payload is attached, s.")] = 0.0,
) -> None:
    """Simulate a robot's stream with Pinocchio and write it as a recording."""
    stream = Stream(
        n_samples=samples,
        rate=rate,
        n_sinusoids=sinusoids,
        motion=motion,  # type: ignore[arg-type]  # simulate checks it
        speed=FAST if fast else 1.0,
        noise=noise,
        viscous=viscous,
        coulomb=coulomb,
        payload=Payload(payload, payload_at) if payload else None,
    )
    data = simulate(load_robot(robot), stream, seed)
    recordings.write(output, data)
    out.print(f"{output}: {len(data)} samples of {', '.join(data.joint_names)}")


@app.command()
def train(
    files: Files,
    model: Annotated[str, typer.Option(help="Name of the model; a new version of it is made.")],
    url: Url = DEFAULT_URL,
    estimator: Annotated[
        str | None, typer.Option(help=f"One of {', '.join(ESTIMATORS)}; {DEFAULT_ESTIMATOR} by default.")
    ] = None,
    joint_types: Annotated[
        str | None, typer.Option(help="One a joint, separated by commas; all revolute by default.")
    ] = None,
    robot: Annotated[
        str | None, typer.Option(help="For rigid bodies: a profile such as panda, the id of a URDF, or a .urdf file.")
    ] = None,
    prior: Annotated[
        str | None,
        typer.Option(help="Of rigid bodies: around the parameters of the `urdf` (default) or around `zero`."),
    ] = None,
    hold_out: Annotated[
        float | None, typer.Option(help="Share of the samples to hold out and evaluate the model on, such as 0.3.")
    ] = None,
    hold_out_by: Annotated[
        str | None,
        typer.Option(help="What is held out: whole `episodes`, the `last` part (default), or some of ten `blocks`."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Upload recordings and train a model on them. Ctrl-C cancels the job."""
    from service.progress import follow  # noqa: PLC0415 - serving does without the client

    with _client(url) as client:
        datasets = [client.upload(path).id for path in files]
        types = None if joint_types is None else [kind.strip() for kind in joint_types.split(",")]
        if robot is not None and robot.endswith(".urdf"):
            robot = client.upload_robot(Path(robot)).id
        options = None if prior is None else {"prior": prior}
        asked = {name: value for name, value in (("share", hold_out), ("kind", hold_out_by)) if value is not None}
        job = client.train(model, datasets, estimator, types, options, robot=robot, holdout=asked or None)
        job = follow(client, job, err)
        made = client.version(model, job.version) if asked and job.version is not None else None
    if as_json:
        out.print_json(job.model_dump_json())
    if job.state != SUCCEEDED:
        _fail(f"job {job.id} has {job.state}" + (f": {job.error.message}" if job.error else ""))
    if not as_json:
        out.print(f"{model} version {job.version} is trained and answers")
        if made is not None:
            held = made.lineage["holdout"]
            out.print(figures_table(f"on {held['samples']} samples held out", made.joint_names, held))


@app.command()
def evaluate(
    model: Annotated[str, typer.Argument(help="Name of the model.")],
    dataset: Annotated[str, typer.Argument(help="Id of a data set.")],
    url: Url = DEFAULT_URL,
    version: Annotated[int | None, typer.Option(help="A version; the one that serves by default.")] = None,
    alias: Annotated[str | None, typer.Option(help="A version by its alias.")] = None,
    held_out: Annotated[
        bool, typer.Option("--held-out", help="Only on what the training of the version held out of it.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Compare a model with a data set, joint by joint."""
    with _client(url) as client:
        answer = client.evaluate(model, dataset, version, alias, "held_out" if held_out else "all")
    if as_json:
        out.print_json(answer.model_dump_json())
    else:
        out.print(evaluation_table(answer))


@app.command()
def predict(
    model: Annotated[str, typer.Argument(help="Name of the model.")],
    q: Annotated[str, typer.Option("--q", help="Positions, rad, separated by commas.")],
    dq: Annotated[str | None, typer.Option("--dq", help="Velocities, rad/s; zero by default.")] = None,
    ddq: Annotated[str | None, typer.Option("--ddq", help="Accelerations, rad/s²; zero by default.")] = None,
    components: Annotated[
        str | None, typer.Option(help=f"Parts of the dynamics, separated by commas: {', '.join(COMPONENTS)}.")
    ] = None,
    tau: Annotated[str | None, typer.Option("--tau", help="Torques, N·m, for forward_dynamics.")] = None,
    url: Url = DEFAULT_URL,
    as_json: Json = False,
) -> None:
    """Ask a model for the torque at one motion."""
    position = _numbers("--q", q)
    zeros = [0.0] * len(position)
    with _client(url) as client:
        answer = client.predict(
            model,
            position,
            zeros if dq is None else _numbers("--dq", dq),
            zeros if ddq is None else _numbers("--ddq", ddq),
            components=[] if components is None else [name.strip() for name in components.split(",")],
            tau=None if tau is None else _numbers("--tau", tau),
        )
    if as_json:
        out.print_json(answer.model_dump_json(exclude_none=True))
        return
    for table in prediction_tables(answer):
        out.print(table)


@app.command()
def demo(
    port: Annotated[int, typer.Option(help="Port of the service; 0 takes a free one.")] = 8000,
    once: Annotated[bool, typer.Option(envvar="ONCE", help="Stop the service at the end.")] = False,
    plot: Annotated[Path | None, typer.Option(help="Also draw measured and predicted torque, .png or .svg.")] = None,
) -> None:
    """Run the main job: serve, simulate a Panda, upload, train, evaluate on unseen trajectories, ask."""
    from service.client import ApiError  # noqa: PLC0415 - serving does without the demo
    from service.demo import DemoError, run  # noqa: PLC0415

    try:
        run(port, once, plot, out)
    except ApiError as error:
        _fail(_said(error))
    except DemoError as error:
        _fail(str(error))


@app.command(add_help_option=False, context_settings=_PASS_ON)
def reproduce(context: typer.Context) -> None:
    """Run the paper's experiment: every estimator on training × test sets of a simulated robot; tables and figures."""
    from service.reproduce import command  # noqa: PLC0415 - serving does without the experiment

    try:
        command.app(context.args, prog_name="lipserve reproduce")
    except command.ERRORS as error:
        _fail(str(error))


@app.command(add_help_option=False, context_settings=_PASS_ON)
def bench(context: typer.Context) -> None:
    """Measure latency, learning while serving, and what kills cost: `lipserve bench --help`."""
    from service.bench import command  # noqa: PLC0415 - the service does without it

    try:
        command.app(context.args, prog_name="lipserve bench")
    except command.ERRORS as error:
        _fail(str(error))


@app.command(add_help_option=False, context_settings=_PASS_ON)
def data(context: typer.Context) -> None:
    """Upload recordings, list them, read their reports: `lipserve data --help`."""
    from service.client import ApiError  # noqa: PLC0415 - serving does without httpx
    from service.datasets import command  # noqa: PLC0415

    try:
        command.app(context.args, prog_name="lipserve data")
    except ApiError as error:
        _fail(_said(error))
    except command.ERRORS as error:
        _fail(str(error))


@app.command(add_help_option=False, context_settings=_PASS_ON)
def excite(context: typer.Context) -> None:
    """Plan a motion within a robot's limits that tells most of what is not known: `lipserve excite --help`."""
    from service.excite import command  # noqa: PLC0415 - serving does without it

    try:
        command.app(context.args, prog_name="lipserve excite")
    except command.ERRORS as error:
        _fail(str(error))


@app.command()
def verify(as_json: Json = False) -> None:
    """Read everything that the home LIPSERVE_HOME stores and report what is damaged; also while the service runs."""
    from service import verification  # noqa: PLC0415 - serving does without it

    found = verification.verify(Settings())
    if as_json:
        out.print_json(json.dumps(found.shown()))
    else:
        for damage in found.damages:
            err.print(f"[red]damaged:[/red] {escape(str(damage))}", highlight=False, soft_wrap=True)
        counts = ", ".join(f"{count} {kind}" for kind, count in found.read.items())
        out.print(f"read {counts}: {len(found.damages) or 'nothing'} damaged")
    if found.damages:
        raise typer.Exit(1)


app.add_typer(keys.app, name="keys")


@contextmanager
def _client(url: str) -> Iterator[Client]:
    """A client of the service at `url`; what the service refuses is printed."""
    from service.client import ApiError, Client  # noqa: PLC0415 - serving does without httpx

    try:
        with Client(url) as client:
            yield client
    except ApiError as error:
        _fail(_said(error))


def _said(error: ApiError) -> str:
    return f"{error.message} ({error.code}, {error.status})"


def _numbers(name: str, text: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        _fail(f"{name} is {text!r}, expected numbers separated by commas")


def _fail(message: str) -> NoReturn:
    err.print(f"[red]error:[/red] {escape(message)}", highlight=False, soft_wrap=True)
    sys.exit(1)


if __name__ == "__main__":
    main()
