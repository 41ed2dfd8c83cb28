"""`lipserve data`: add, list, show and delete data sets."""

from __future__ import annotations

from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from lipserve.address import DEFAULT_URL
from lipserve.asking import Reading
from service.cli import connecting
from service.cli.connecting import advised, connected, robot_of, upload
from service.cli.consoles import CommandError, echo, out, print_json, print_result
from service.cli.options import DatasetId, Json, Limit, Url, Yes, confirm, group, names, pairs
from service.cli.wording import in_shell
from service.contract.media_types import SUFFIXES
from service.foundation.text import counted

if TYPE_CHECKING:
    from lipserve.records.datasets import Dataset

app = group("Add, list, show and delete data sets (recordings).")


def _preparation(help_: str) -> Any:
    return typer.Option(help=help_, rich_help_panel="Preparation")


@app.command()
def add(
    files: Annotated[
        list[str],
        typer.Argument(help=f"Recordings to upload ({', '.join(SUFFIXES)}), or ids of data sets to read again."),
    ],
    name: Annotated[str | None, typer.Option(help="Name of the data set. Default: the file's name.")] = None,
    robot: Annotated[str | None, typer.Option(help="Profile such as panda, id of a URDF, or a .urdf file.")] = None,
    joint_names: Annotated[str | None, typer.Option(help="Names of joints 1 to n, separated by commas.")] = None,
    joints: Annotated[str | None, typer.Option(help="Joints to keep, in this order.")] = None,
    drop_joints: Annotated[str | None, typer.Option("--drop", help="Joints to drop. They must not move.")] = None,
    effort: Annotated[str | None, typer.Option(help="Meaning of tau: measured, commanded or current.")] = None,
    torque_constants: Annotated[
        str | None, typer.Option(help="Torque constant of each joint, N·m/A, for motor currents.")
    ] = None,
    torque_factors: Annotated[
        str | None, typer.Option(help="Factor on each joint's torque: -1 reverses its sign.")
    ] = None,
    torque_convention: Annotated[str | None, typer.Option(help="gravity_included or gravity_compensated.")] = None,
    column: Annotated[
        list[str] | None,
        typer.Option(
            help="Columns of a quantity: a pattern, e.g. q={joint}/position, or names separated by commas. Repeatable."
        ),
    ] = None,
    unit: Annotated[list[str] | None, typer.Option(help="Unit of a quantity, e.g. q=deg or t=ms. Repeatable.")] = None,
    topic: Annotated[str | None, typer.Option(help="Topics of a bag, HDF5 group or sheet to read.")] = None,
    delimiter: Annotated[str | None, typer.Option(help="Delimiter of a CSV file.")] = None,
    column_names: Annotated[
        str | None,
        typer.Option("--columns", help="Names of all columns, for text without a header: t,q1..q7,tau1..tau7."),
    ] = None,
    dt: Annotated[float | None, typer.Option(help="Time step, s, for files without times.")] = None,
    poses: Annotated[
        bool, typer.Option("--poses", help="Every row is a held pose: no times or velocities are needed.")
    ] = False,
    join: Annotated[
        bool,
        typer.Option(
            "--join",
            help="Join the files into one recording: tables side by side, such as positions.txt and torques.txt.",
        ),
    ] = False,
    cutoff: Annotated[float | None, _preparation("Cutoff of the low-pass filter, Hz. Default: 4.")] = None,
    filtering: Annotated[
        str | None, _preparation("When to low-pass filter: derived (default), always or never.")
    ] = None,
    form: Annotated[str | None, _preparation("Filter type: acausal (default), or causal as on a live stream.")] = None,
    rate: Annotated[float | None, _preparation("Rate of the samples, Hz.")] = None,
    gap: Annotated[
        float | None, _preparation("A pause longer than this many median time steps is a gap. Default: 1.5.")
    ] = None,
    trim: Annotated[float | None, _preparation("Time to cut off at both ends of every part, s.")] = None,
    url: Url = DEFAULT_URL,
    as_json: Json = False,
) -> None:
    """Upload recordings, one data set each (with --join: one for all), and print their reports.

    Given the id of a data set, its file is read again with these options and those of before. The old data set is
    deleted unless a job used it.
    """
    given = {
        "robot": robot,
        "joint_names": names(joint_names),
        "joints": names(joints),
        "drop_joints": names(drop_joints),
        "effort": effort,
        "torque_constants": names(torque_constants),
        "torque_factors": names(torque_factors),
        "torque_convention": torque_convention,
        "columns": {key: _one_or_more(value) for key, value in pairs("--column", column).items()} or None,
        "units": pairs("--unit", unit) or None,
        "topic": topic,
        "delimiter": delimiter,
        "column_names": names(column_names),
        "dt": dt,
        "poses": poses or None,
        "cutoff": cutoff,
        "filtering": filtering,
        "form": form,
        "rate": rate,
        "gap": gap,
        "trim": trim,
    }
    reading: Reading = {key: value for key, value in given.items() if value is not None}  # type: ignore[assignment]
    again = [each for each in files if each.startswith("ds_")]
    paths = [Path(each) for each in files if each not in again]
    for path in paths:
        if not path.is_file():
            raise CommandError(f"The file {path} does not exist.")
    if again and (join or name is not None):
        raise CommandError(f"{again[0]} is a data set: --join and --name are options of files")
    parts = [paths] if join else [[each] for each in paths]
    hint = "if the files are parts of one recording, add --join" if len(parts) > 1 else None
    with connected(url) as client, advised(hint):
        if robot is not None:
            reading["robot"] = robot_of(client, robot)
        made = [client.read_again(each, **reading) for each in again]
        made += [upload(client, part, name, **reading) for part in parts]
    if as_json:
        print_json(made if len(made) > 1 else made[0])
        return
    for dataset in made:
        _print(dataset)


@app.command("list")
def list_(limit: Limit = 50, url: Url = DEFAULT_URL, as_json: Json = False) -> None:
    """List data sets, newest first."""
    with connected(url) as client:
        datasets = list(islice(client.datasets(), limit))
    if as_json:
        print_json(datasets)
        return
    if not datasets:
        echo("no data sets yet: `lipserve data add FILE` uploads a recording")
    for each in datasets:
        rate = "" if each.report.rate_hz is None else f" at {each.report.rate_hz:.4g} Hz"
        joints = counted(len(each.joint_names), "joint")
        echo(f"{each.id}  {each.created_at[:19]}  {each.name}: {counted(each.report.rows, 'sample')}{rate}, {joints}")


@app.command()
def show(dataset: DatasetId, url: Url = DEFAULT_URL, as_json: Json = False) -> None:
    """Print the report of a data set."""
    with connected(url) as client:
        record = client.dataset(dataset)
    if as_json:
        print_json(record)
    else:
        _print(record)


@app.command()
def delete(
    datasets: Annotated[list[str], typer.Argument(help="Ids of data sets.", autocompletion=connecting.datasets)],
    yes: Yes = False,
    url: Url = DEFAULT_URL,
    as_json: Json = False,
) -> None:
    """Delete data sets permanently. Versions trained on them stay."""
    confirm(f"Delete {', '.join(datasets)} permanently?", yes)
    with connected(url) as client:
        for each in datasets:
            client.delete_dataset(each)
    print_result({"deleted": datasets}, as_json, f"{', '.join(datasets)} deleted")


def _print(dataset: Dataset) -> None:
    from service.cli import tables  # noqa: PLC0415 - slow import, not needed for help

    report = dataset.report
    out.print(f"[bold]{dataset.id}[/bold]  {escape(dataset.name)}  torque: {dataset.torque_convention}")
    for line in tables.overview(report):
        echo(f"  {in_shell(line)}")
    for table in tables.report_tables(report, dataset.joint_names):
        out.print(table)
    echo(f"  {report.excitation.text}")
    best = dataset.learnability
    echo(f"a model of it can be {best.label} at best: {in_shell(best.reason)} {best.action}")
    for line in report.warnings:
        out.print(f"[yellow]warning:[/yellow] {escape(in_shell(line))}", highlight=False)
    for remedy in report.remedies if report.upload_options is not None else []:
        if remedy.options is not None:
            options = in_shell(" ".join(f"{name}={value}" for name, value in remedy.options.items()))
            echo(f"read again: lipserve data add {dataset.id} {options}")
    for line in report.advice:
        out.print(f"[cyan]next:[/cyan] {escape(in_shell(line))}", highlight=False)


def _one_or_more(text: str) -> str | list[str]:
    parts = [part.strip() for part in text.split(",")]
    return parts[0] if len(parts) == 1 else parts
