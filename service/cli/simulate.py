"""Writing samples as the files that the service reads."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from lipcore.data.samples import Samples
from lipcore.robots.dirt import Dirt
from lipcore.robots.library import ROBOTS, SimulationUnavailableError, load_robot
from lipcore.robots.simulation import FAST, Payload, Stream, simulate
from service.cli.consoles import print_result
from service.cli.options import Json, alone

COLUMNS = {"q": "position", "dq": "velocity", "ddq": "acceleration", "tau": "torque"}
"""What stands behind a joint's name in the columns of a CSV."""


def write_recording(path: Path, samples: Samples) -> None:
    """Write samples as CSV or NPZ by the path's ending, with the names of the joints, so that an upload has them.

    Raise ValueError for another ending.
    """
    if path.suffix == ".npz":
        names = ("t", "episode", "q", "dq", "ddq", "tau")
        arrays = {name: getattr(samples, name) for name in names}
        np.savez(path, joint_names=np.array(samples.joint_names), **arrays)
    elif path.suffix == ".csv":
        header = ["t", "episode", *(f"{joint}/{word}" for word in COLUMNS.values() for joint in samples.joint_names)]
        table = np.column_stack([samples.t, samples.episode, *(getattr(samples, name) for name in COLUMNS)])
        formats = ["%.17g", "%d", *["%.17g"] * (4 * samples.n_joints)]
        np.savetxt(path, table, fmt=formats, delimiter=",", header=",".join(header), comments="")
    else:
        raise ValueError(f"file is {path.name!r}, expected the ending .csv or .npz")


app = alone()
ERRORS = (SimulationUnavailableError,)


@app.command("simulate")
def simulate_(
    robot: Annotated[str, typer.Argument(help=f"One of {', '.join(ROBOTS)}.", autocompletion=lambda: list(ROBOTS))],
    output: Annotated[Path, typer.Argument(help="File to write, .csv or .npz.", dir_okay=False)],
    seed: Annotated[int, typer.Option(min=0, help="Equal seeds give equal streams.")] = 0,
    samples: Annotated[int, typer.Option(min=2, help="How many.")] = 500,
    rate: Annotated[float, typer.Option(help="Hz.")] = 10.0,
    sinusoids: Annotated[int, typer.Option(min=1, help="50 for training, 100 for testing in the paper.")] = 50,
    motion: Annotated[str, typer.Option(help="middle (±0.5 rad) or full.")] = "middle",
    course: Annotated[str, typer.Option(help="sinusoids, periodic, or rests: from point to point.")] = "sinusoids",
    fast: Annotated[bool, typer.Option("--fast", help="The faster-moving variant.")] = False,
    noise: Annotated[float, typer.Option(help="Std of the torque noise, N·m.")] = 0.01,
    viscous: Annotated[float, typer.Option(help="Viscous friction, N·m·s/rad.")] = 0.0,
    coulomb: Annotated[float, typer.Option(help="Coulomb friction, N·m.")] = 0.0,
    payload: Annotated[float, typer.Option(help="Payload, kg.")] = 0.0,
    payload_at: Annotated[float, typer.Option(help="When the payload is attached, s.")] = 0.0,
    dirt: Annotated[
        float,
        typer.Option(min=0.0, help="Friction with memory, ripple, coloured noise, encoders: 1 is an industrial arm's."),
    ] = 0.0,
    as_json: Json = False,
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
        course=course,  # type: ignore[arg-type]  # as above
        dirt=Dirt().times(dirt) if dirt else None,
    )
    data = simulate(load_robot(robot), stream, seed)
    write_recording(output, data)
    document = {"file": output, "samples": len(data), "rate_hz": rate, "joint_names": data.joint_names}
    print_result(document, as_json, f"{output}: {len(data)} samples of {', '.join(data.joint_names)}")
