"""`lipserve data`: upload recordings, list them, and read their reports."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape

from service.client import Client, ServiceUnreachableError
from service.datasets import report_tables
from service.datasets.asking import Reading
from service.datasets.media import SUFFIXES
from service.datasets.schema import Dataset
from service.settings import DEFAULT_URL

app = typer.Typer(no_args_is_help=True, pretty_exceptions_enable=False, help="Recordings and their reports.")
ERRORS = (ServiceUnreachableError,)
"""What a user is told without a traceback."""
PIPE_WIDTH = 160
"""Columns of a table that no terminal shows."""
PREPARATION = "Preparation"

Url = Annotated[str, typer.Option("--url", envvar="LIPSERVE_URL", help="Address of the service.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]


@app.command()
def add(
    files: Annotated[
        list[Path], typer.Argument(exists=True, dir_okay=False, help=f"Recordings: {', '.join(SUFFIXES)}.")
    ],
    name: Annotated[str | None, typer.Option(help="A name for people; the file's by default.")] = None,
    robot: Annotated[str | None, typer.Option(help="A profile such as panda, or the id of an uploaded URDF.")] = None,
    joint_names: Annotated[str | None, typer.Option(help="Of joints 1..n, separated by commas.")] = None,
    joints: Annotated[str | None, typer.Option(help="Those to keep, in this order.")] = None,
    drop_joints: Annotated[str | None, typer.Option("--drop", help="Joints to leave out.")] = None,
    effort: Annotated[str | None, typer.Option(help="What tau is: measured, commanded or current.")] = None,
    torque_constants: Annotated[str | None, typer.Option(help="N·m/A of each joint, for motor currents.")] = None,
    torque_convention: Annotated[str | None, typer.Option(help="gravity_included or gravity_compensated.")] = None,
    column: Annotated[
        list[str] | None,
        typer.Option(help="What the file calls a quantity: q={joint}/position, or names separated by commas; repeat."),
    ] = None,
    unit: Annotated[list[str] | None, typer.Option(help="Unit of a quantity: q=deg, t=ms; repeat.")] = None,
    topic: Annotated[str | None, typer.Option(help="Of a bag.")] = None,
    delimiter: Annotated[str | None, typer.Option(help="Of a CSV.")] = None,
    cutoff: Annotated[
        float | None, typer.Option(help="Of the low-pass, Hz; 4 by default.", rich_help_panel=PREPARATION)
    ] = None,
    filtering: Annotated[
        str | None, typer.Option(help="derived (default), always or never.", rich_help_panel=PREPARATION)
    ] = None,
    form: Annotated[
        str | None, typer.Option(help="acausal (default), or causal as on a live stream.", rich_help_panel=PREPARATION)
    ] = None,
    rate: Annotated[float | None, typer.Option(help="Of the samples, Hz.", rich_help_panel=PREPARATION)] = None,
    gap: Annotated[
        float | None,
        typer.Option(help="Steps that a gap is longer than; 1.5 by default.", rich_help_panel=PREPARATION),
    ] = None,
    trim: Annotated[
        float | None, typer.Option(help="Cut off at both ends of every part, s.", rich_help_panel=PREPARATION)
    ] = None,
    url: Url = DEFAULT_URL,
    as_json: Json = False,
) -> None:
    """Upload recordings, one data set each, and print their reports."""
    given = {
        "robot": robot,
        "joint_names": _names(joint_names),
        "joints": _names(joints),
        "drop_joints": _names(drop_joints),
        "effort": effort,
        "torque_constants": _names(torque_constants),
        "torque_convention": torque_convention,
        "columns": {key: _one_or_more(value) for key, value in _pairs("--column", column).items()} or None,
        "units": _pairs("--unit", unit) or None,
        "topic": topic,
        "delimiter": delimiter,
        "cutoff": cutoff,
        "filtering": filtering,
        "form": form,
        "rate": rate,
        "gap": gap,
        "trim": trim,
    }
    reading: Reading = {key: value for key, value in given.items() if value is not None}  # type: ignore[assignment]
    with Client(url) as client:
        for path in files:
            _print(client.upload(path, name, **reading), as_json)


@app.command("list")
def list_(url: Url = DEFAULT_URL, as_json: Json = False) -> None:
    """List data sets, newest first."""
    with Client(url) as client:
        found = client.datasets()
    if as_json:
        typer.echo(json.dumps([each.model_dump(mode="json") for each in found]))
        return
    for each in found:
        rate = "" if each.report.rate_hz is None else f" at {each.report.rate_hz:.4g} Hz"
        joints = f"{len(each.joint_names)} joints"
        said = f"{each.id}  {each.created_at[:19]}  {each.name}: {each.report.rows:,} samples{rate}, {joints}"
        _console().print(said, highlight=False, markup=False, soft_wrap=True)


@app.command()
def show(
    dataset: Annotated[str, typer.Argument(help="Id of a data set.")], url: Url = DEFAULT_URL, as_json: Json = False
) -> None:
    """Print the report of a data set."""
    with Client(url) as client:
        _print(client.dataset(dataset), as_json)


def _print(dataset: Dataset, as_json: bool) -> None:
    if as_json:
        typer.echo(dataset.model_dump_json())
        return
    console, report = _console(), dataset.report
    console.print(f"[bold]{dataset.id}[/bold]  {escape(dataset.name)}  torque: {dataset.torque_convention}")
    for said in report_tables.overview(report):
        console.print(f"  {escape(said)}", highlight=False, soft_wrap=True)
    for table in report_tables.tables(report, dataset.joint_names):
        console.print(table)
    if report.excitation is not None:
        console.print(f"  {escape(report.excitation.text)}", highlight=False, soft_wrap=True)
    for said in report.warnings:
        console.print(f"[yellow]warning:[/yellow] {escape(said)}", highlight=False, soft_wrap=True)
    for said in report.advice:
        console.print(f"[cyan]next:[/cyan] {escape(said)}", highlight=False, soft_wrap=True)


def _console() -> Console:
    return Console(width=None if sys.stdout.isatty() else PIPE_WIDTH)


def _names(text: str | None) -> list[str] | None:
    return None if text is None else [part.strip() for part in text.split(",")]


def _one_or_more(text: str) -> str | list[str]:
    names = [part.strip() for part in text.split(",")]
    return names[0] if len(names) == 1 else names


def _pairs(option: str, given: Sequence[str] | None) -> dict[str, str]:
    found = {}
    for text in given or ():
        name, equals, value = text.partition("=")
        if not equals or not value:
            raise ValueError(f"{option} is {text!r}, expected a quantity, = and what it is, as q=deg")
        found[name.strip()] = value.strip()
    return found
