"""`lipserve payload`: show, declare and remove payloads."""

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
    "none": "no change",
    "payload": "payload",
    "contact": "contact",
    "friction": "friction changed",
}


@app.command()
def payload(
    model: Model,
    mass: Annotated[float | None, typer.Option(help="Mass of the payload to declare, kg.")] = None,
    com: Annotated[
        str | None,
        typer.Option(help="Its centre of mass x,y,z in the frame of the last link, m, e.g. 0,0,0.12."),
    ] = None,
    inertia: Annotated[
        str | None,
        typer.Option(
            help="Its inertia ixx,ixy,ixz,iyy,iyz,izz about the centre of mass, kg·m². Default: a point mass."
        ),
    ] = None,
    remove: Annotated[bool, typer.Option("--remove", help="Remove the payload.")] = False,
    stream: Annotated[
        str | None, typer.Option(help="stream_id of one robot. Default: all streams of the model.")
    ] = None,
    url: Url = DEFAULT_URL,
    as_json: Json = False,
) -> None:
    """Print the payloads of a model, stream by stream; declare one with --mass and --com.

    This is not a safety function.
    """
    declared = [name for name, value in (("--mass", mass), ("--com", com), ("--inertia", inertia)) if value is not None]
    if remove and declared:
        raise CommandError(f"give either --remove or {declared[0]}, not both")
    with connected(url) as client:
        if remove:
            known = client.remove_payload(model, stream)
        elif mass is not None and com is not None:
            tensor = None if inertia is None else _matrix(numbers("--inertia", inertia))
            known = client.declare_payload(model, mass, numbers("--com", com), tensor, stream)
        elif declared:
            raise CommandError("--mass and --com must be given together")
        else:
            known = client.payload(model)
    streams = [each for each in known.streams if stream in (None, each.stream_id)]
    if as_json:
        print_json(replace(known, streams=streams))
        return
    _print(known, streams)


def _matrix(values: Sequence[float]) -> list[list[float]]:
    """Return the symmetric matrix of ixx, ixy, ixz, iyy, iyz, izz; raise CommandError."""
    if len(values) != 6:
        raise CommandError(f"--inertia must be six numbers, ixx,ixy,ixz,iyy,iyz,izz; got {len(values)}")
    xx, xy, xz, yy, yz, zz = values
    return [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]


def _print(known: Payloads, streams: Sequence[StreamPayload]) -> None:
    if known.reason is not None:
        echo(f"payloads of {known.model} are not estimated: {known.reason}")
    if known.default is not None:
        echo(f"declared for all streams of {known.model}: {_mass(known.default)} at {_vector(known.default.com)} m")
    if len(streams) == 1:
        _print_stream(streams[0])
    elif streams:
        table = Table(
            "stream", "state", "payload", "centre of mass m", "since", "rows", title=f"{known.model} payloads"
        )
        for each in streams:
            place = "-" if each.payload is None else _vector(each.payload.com)
            cells = [STATES[each.state], _mass(each.payload), place, _since(each), f"{each.rows:,}"]
            table.add_row(escape(each.stream_id), *cells)
        out.print(table)
    elif known.reason is None and known.default is None:
        echo(f"no payload estimates of {known.model} yet")
    if any(each.payload is not None for each in streams):
        frame = "as estimated" if known.frame == "learnt" else "as in the URDF"
        echo(f"centres of mass are in the frame of the link after joint {known.link}, {frame}")
        if known.frame == "learnt":
            echo("check the mass: the geometry is estimated from torque, so kilograms are only as accurate as lengths")


def _print_stream(stream: StreamPayload) -> None:
    echo(f"stream {stream.stream_id}: payload {_mass(stream.payload)}{', declared' if stream.declared else ''}")
    echo(f"  state           {STATES[stream.state]}")
    if stream.payload is not None:
        echo(f"  centre of mass  {_vector(stream.payload.com)} m")
        if stream.payload.com_tip is not None:
            echo(f"  at the tip      {_vector(stream.payload.com_tip)} m")
    echo(f"  since           {_since(stream)}")
    if stream.payload is not None:
        echo(f"  estimated from  {counted(stream.rows, 'row')}")


def _mass(body: PayloadBody | None) -> str:
    return "none" if body is None else f"{body.mass.mean:.2f} ± {body.mass.std:.2f} kg"


def _vector(vector: Vector) -> str:
    """Format three numbers with their standard deviations."""
    pairs = zip(vector.mean, vector.std, strict=True)
    return ", ".join(f"{round(mean, 3) + 0.0:.3f} ± {std:.3f}" for mean, std in pairs)


def _since(stream: StreamPayload) -> str:
    return "-" if stream.since is None else stream.since[:19].replace("T", " ")
