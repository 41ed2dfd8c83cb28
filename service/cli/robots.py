"""`lipserve robots`: robot profiles and uploaded URDFs."""

from __future__ import annotations

from itertools import islice
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Table

from lipserve.address import DEFAULT_URL
from service.cli.connecting import connected
from service.cli.consoles import CommandError, echo, out, print_json, print_result
from service.cli.options import Json, Limit, Url, Yes, confirm, group, pairs
from service.foundation.text import counted

app = group("List and show robots; add and delete URDFs.")
Robot = Annotated[str, typer.Argument(help="Profile such as panda, or id of an uploaded URDF.")]
RobotId = Annotated[str, typer.Argument(help="Id of an uploaded URDF.")]


@app.command("list")
def list_(limit: Limit = 50, url: Url = DEFAULT_URL, as_json: Json = False) -> None:
    """List robots: uploaded URDFs, newest first, then profiles."""
    with connected(url) as client:
        uploaded, profiles = list(islice(client.robots(), limit)), client.profiles()
    if as_json:
        print_json({"uploaded": uploaded, "profiles": profiles})
        return
    table = Table("robot", "name", "joints")
    for each in uploaded:
        table.add_row(each.id, escape(each.name), str(len(each.joints)))
    for known in profiles:
        table.add_row(known.name, escape(known.title), str(len(known.joints)))
    out.print(table)


@app.command()
def show(robot: Robot, url: Url = DEFAULT_URL, as_json: Json = False) -> None:
    """Print the joints and limits of a robot; for a URDF also its upload time and hash."""
    with connected(url) as client:
        known = client.profile(robot)
        uploaded = client.robot(robot) if robot.startswith("urdf_") else None
    if as_json:
        print_json({"profile": known, "uploaded": uploaded})
        return
    echo(f"{known.name}: {known.title}, {counted(len(known.joints), 'joint')}")
    if uploaded is not None:
        echo(f"  uploaded {uploaded.created_at[:19].replace('T', ' ')}, sha256 {uploaded.sha256}")
    table = Table("joint", "type", "lower", "upper", "speed", "torque")
    for each in known.joints:
        limits = (each.lower, each.upper, each.max_speed, each.max_torque)
        table.add_row(escape(each.name), each.type, *("-" if limit is None else f"{limit:.3g}" for limit in limits))
    out.print(table)


@app.command()
def add(
    path: Annotated[
        Path,
        typer.Argument(
            help="A .urdf, .xacro, .sdf or MuJoCo .xml file, or the zip of its folder.", exists=True, dir_okay=False
        ),
    ],
    scale: Annotated[
        list[str] | None,
        typer.Option(help="Factor to m, kg or kg·m²: length=0.001 for mm, inertia=1e-9 for g·mm². Repeatable."),
    ] = None,
    xacro: Annotated[
        list[str] | None, typer.Option(help="Argument of a xacro, such as ur_type=ur5e. Repeatable.")
    ] = None,
    url: Url = DEFAULT_URL,
    as_json: Json = False,
) -> None:
    """Upload a robot for use with recordings and training."""
    if path.suffix not in (".urdf", ".xacro", ".sdf", ".xml", ".zip"):
        raise CommandError(f"{str(path)!r} is no .urdf, .xacro, .sdf or .zip file, or .xml in MuJoCo's format")
    factors = pairs("--scale", [part for each in scale or () for part in each.split(",")])
    with connected(url) as client:
        units = {name: float(text) for name, text in factors.items()}
        robot = client.upload_robot(path, scale=units or None, xacro=pairs("--xacro", xacro) or None)
    print_result(robot, as_json, f"{path.name} uploaded as {robot.id}: `lipserve train … --robot {robot.id}`")


@app.command()
def delete(robot: RobotId, yes: Yes = False, url: Url = DEFAULT_URL, as_json: Json = False) -> None:
    """Delete an uploaded URDF. Models trained with it keep a copy."""
    confirm(f"Delete {robot} permanently?", yes)
    with connected(url) as client:
        client.delete_robot(robot)
    print_result({"deleted": robot}, as_json, f"{robot} deleted")
