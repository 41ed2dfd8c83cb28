"""`lipserve payload`: what arms carry, as far as their streams tell; declared, or said to be gone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import typer
from msgspec.structs import replace
from rich.markup import escape
from rich.table import Table

from lipserve.address import DEFAULT_URL
from service.cli.connecting import connected
from service.cli.consoles import CommandError, echo, out, print_json
from service.cli.options import Json, Model, Url, alone, numbers
from service.foundation.text import counted

if TYPE_CHECKING:
    from lipserve.records.payloads import PayloadBody, Payloads, StreamPayload, Vector

app = alone()
STATES = {
    "none": "nothing new",
    "payload": "payload",
    "contact": "contact",
    "friction": "friction has changed",
}


@app.command()
def payload(
    model: Model,
    mass: Annotated[float | None, typer.Option(help="Declare a payload: its mass, kg.")] = None,
    com: Annotated[
        str | None,
        typer.Option(help="Its centre of mass in the frame of the last link, m, separated by commas: 0,0,0.12."),
    ] = None,
    inertia: Annotated[
        str | None,
        typer.Option(help="Its inertia about that, kg·m²: ixx,ixy,ixz,iyy,iyz,izz; that of a point by default."),
    ] = None,
    remove: Annotated[bool, typer.Option("--remove", help="Say that nothing is carried any more.")] = False,
    stream: Annotated[str | None, typer.Option(help="Only this robot, by its stream_id.")] = None,
    url: Url = DEFAULT_URL,
    as_json: Json = False,
) -> None:
    """Print what the arms of a model carry, stream by stream; with --mass and --com declare it. No safety function."""
    declared = [name for name, value in (("--mass", mass), ("--com", com), ("--inertia", inertia)) if value is not None]
    if remove and declared:
        raise CommandError(f"--remove and {declared[0]} are given, expected one of them")
    with connected(url) as client:
        if remove:
            known = client.remove_payload(model, stream)
        elif mass is not None and com is not None:
            tensor = None if inertia is None else _matrix(numbers("--inertia", inertia))
            known = client.declare_payload(model, mass, numbers("--com", com), tensor, stream)
        elif declared:
            raise CommandError(f"{declared[0]} is given, expected --mass and --com together")
        else:
            known = client.payload(model)
    streams = [each for each in known.streams if stream in (None, each.stream_id)]
    if as_json:
        print_json(replace(known, streams=streams))
        return
    _print(known, streams)


def _matrix(values: Sequence[float]) -> list[list[float]]:
    """The symmetric matrix of ixx, ixy, ixz, iyy, iyz, izz; raise CommandError."""
    if len(values) != 6:
        raise CommandError(f"--inertia has {len(values)} numbers, expected 6: ixx,ixy,ixz,iyy,iyz,izz")
    xx, xy, xz, yy, yz, zz = values
    return [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]


def _print(known: Payloads, streams: Sequence[StreamPayload]) -> None:
    if known.reason is not None:
        echo(f"payloads of {known.model} are not watched: {known.reason}")
    if known.default is not None:
        echo(f"declared for all of {known.model}: {_mass(known.default)} at {_vector(known.default.com)} m")
    if len(streams) == 1:
        _print_stream(streams[0])
    elif streams:
        table = Table("stream", "state", "carries", "centre of mass m", "since", "rows", title=f"{known.model} carries")
        for each in streams:
            place = "-" if each.payload is None else _vector(each.payload.com)
            cells = [STATES[each.state], _mass(each.payload), place, _since(each), f"{each.rows:,}"]
            table.add_row(escape(each.stream_id), *cells)
        out.print(table)
    elif known.reason is None and known.default is None:
        echo(f"no stream has told yet what an arm of {known.model} carries")
    if any(each.payload is not None for each in streams):
        frame = "as it was learnt" if known.frame == "learnt" else "as the URDF has it"
        echo(f"centres of mass: in the frame of the link behind {known.link}, {frame}")
        if known.frame == "learnt":
            echo("check the estimate: an arm learnt from torque alone knows kilograms only as well as its lengths")


def _print_stream(stream: StreamPayload) -> None:
    echo(f"stream {stream.stream_id} carries {_mass(stream.payload)}{', declared' if stream.declared else ''}")
    echo(f"  state           {STATES[stream.state]}")
    if stream.payload is not None:
        echo(f"  centre of mass  {_vector(stream.payload.com)} m")
        if stream.payload.com_tip is not None:
            echo(f"  at the tip      {_vector(stream.payload.com_tip)} m")
    echo(f"  since           {_since(stream)}")
    if stream.payload is not None:
        echo(f"  seen on         {counted(stream.rows, 'row')}")


def _mass(body: PayloadBody | None) -> str:
    return "nothing" if body is None else f"{body.mass.mean:.2f} ± {body.mass.std:.2f} kg"


def _vector(vector: Vector) -> str:
    """Three numbers with what is not known of each."""
    pairs = zip(vector.mean, vector.std, strict=True)
    return ", ".join(f"{round(mean, 3) + 0.0:.3f} ± {std:.3f}" for mean, std in pairs)


def _since(stream: StreamPayload) -> str:
    return "-" if stream.since is None else stream.since[:19].replace("T", " ")
