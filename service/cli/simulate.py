"""`lipserve simulate`: write a simulated motion as a recording."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from lipcore.data.samples import Samples
from lipcore.robots.dirt import Dirt
from lipcore.robots.library import ROBOTS, load_robot
from lipcore.robots.simulation import FAST_SPEED, Payload, Simulation, simulate
from service.cli.consoles import print_result
from service.cli.options import (
    Along,
    Coulomb,
    DirtShare,
    DriveName,
    Fast,
    Json,
    Mass,
    MassAt,
    Noise,
    Range,
    Seed,
    Sinusoids,
    Viscous,
    alone,
    simulation,
)
from service.foundation.text import counted

COLUMNS = {"q": "position", "dq": "velocity", "ddq": "acceleration", "tau": "torque"}
"""Second part of a CSV column's name, after that of the joint."""


def write_recording(path: Path, samples: Samples) -> None:
    """Write samples with their joint names as CSV or NPZ, by the suffix; raise ValueError for other suffixes."""
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
        raise ValueError(f"the output file must end with .csv or .npz, got {path.name!r}")


def described(
    samples: int,
    rate: float,
    sinusoids: int,
    motion: str,
    course: str,
    fast: bool,
    noise: float,
    viscous: float,
    coulomb: float,
    payload: float,
    payload_at: float,
    dirt: float,
    drive: str,
) -> Simulation:
    """Return the simulation that the options describe; `simulate` checks it. Raise ValueError for other drives."""
    imperfect = Dirt(drive=drive)  # type: ignore[arg-type]  # it checks it
    return Simulation(
        n_samples=samples,
        rate=rate,
        n_sinusoids=sinusoids,
        motion=motion,  # type: ignore[arg-type]  # simulate checks it
        speed=FAST_SPEED if fast else 1.0,
        noise=noise,
        viscous=viscous,
        coulomb=coulomb,
        payload=Payload(payload, payload_at) if payload else None,
        course=course,  # type: ignore[arg-type]  # as above
        dirt=imperfect.scaled(dirt) if dirt else None,
    )


app = alone()


@app.command("simulate")
def simulate_(
    robot: Annotated[str, typer.Argument(help=f"One of {', '.join(ROBOTS)}.", autocompletion=lambda: list(ROBOTS))],
    output: Annotated[Path, typer.Argument(help="File to write, .csv or .npz.", dir_okay=False)],
    samples: Annotated[int, typer.Option(min=2, help="Number of samples.")] = 500,
    rate: Annotated[float, simulation("Sample rate, Hz.")] = 10.0,
    seed: Seed = 0,
    sinusoids: Sinusoids = 50,
    motion: Range = "middle",
    course: Along = "sinusoids",
    fast: Fast = False,
    noise: Noise = 0.01,
    viscous: Viscous = 0.0,
    coulomb: Coulomb = 0.0,
    payload: Mass = 0.0,
    payload_at: MassAt = 0.0,
    dirt: DirtShare = 0.0,
    drive: DriveName = "lugre",
    as_json: Json = False,
) -> None:
    """Simulate a robot with Pinocchio and write its motion as a recording."""
    stream = described(
        samples, rate, sinusoids, motion, course, fast, noise, viscous, coulomb, payload, payload_at, dirt, drive
    )
    data = simulate(load_robot(robot), stream, seed)
    write_recording(output, data)
    document = {"file": output, "samples": len(data), "rate_hz": rate, "joint_names": data.joint_names}
    print_result(document, as_json, f"{output}: {counted(len(data), 'sample')} of {', '.join(data.joint_names)}")
