"""Two real recordings from upload to held-out evaluation, through a service of its own.

    python benchmarks/studies/recordings.py FOLDER

FOLDER holds `panda_exciting_trajectory.db3` (a Franka Panda, rosbag2 at 30 Hz without acceleration; BSD-3-Clause,
github unisa-acg/inverse-dynamics-solver) and `schunk_liu_althoff.npz` (a Schunk arm, 100 episodes at 250 Hz; CC0-1.0,
Liu & Althoff, IROS 2018). Prints the reports, then nMSE and coverage of the part that was held out: the last 30 % of
the Panda's trajectory; of the Schunk 30 of 100 episodes chosen at random, and the last 30, which are other kinds of
motion.
"""

import sys
import tempfile
from pathlib import Path
from typing import Any

from rich.console import Console

from service.cli import tables
from service.cli.demo import ServiceProcess
from service.client import Client
from service.datasets.asking import Reading
from service.datasets.schema import Dataset
from service.foundation.states import SUCCEEDED

WIDTH = 160
RATE = 50.0
"""Of the Schunk's samples: 4 Hz of signal need no more than that."""
PANDA = "panda_exciting_trajectory.db3", Reading(robot="panda")
SCHUNK = "schunk_liu_althoff.npz", Reading(rate=RATE)


def tell(dataset: Dataset, console: Console) -> None:
    """Print the report of a data set."""
    console.print(f"\n[bold]{dataset.name}[/bold]")
    for said in tables.overview(dataset.report):
        console.print(f"  {said}", highlight=False, markup=False, soft_wrap=True)
    for table in tables.report_tables(dataset.report, dataset.joint_names):
        console.print(table)
    if dataset.report.excitation is not None:
        console.print(f"  {dataset.report.excitation.text}", highlight=False, markup=False, soft_wrap=True)
    for said in (*dataset.report.warnings, *dataset.report.advice):
        console.print(f"  - {said}", highlight=False, markup=False, soft_wrap=True)


def judge(client: Client, model: str, dataset: Dataset, holdout: dict[str, Any], console: Console) -> None:
    """Train with part of a data set held out, and print how well that is answered."""
    job = client.wait(client.train(model, [dataset.id], "lip-chain", holdout=holdout).id)
    if job.state != SUCCEEDED:
        raise RuntimeError(f"job {job.id} has {job.state}: {job.error}")
    found = client.evaluate(model, dataset.id, part="held_out")
    console.print(f"\n{model}: {holdout}, {found.samples} samples held out, {found.samples_used} compared")
    console.print("nMSE      " + "  ".join(f"{value:.1e}" for value in found.nmse), highlight=False)
    console.print("coverage  " + "  ".join(f"{value:7.3f}" for value in found.coverage), highlight=False)


def main() -> None:
    """Upload, report, train, evaluate."""
    folder, console = Path(sys.argv[1]), Console(width=WIDTH)
    with tempfile.TemporaryDirectory() as home:
        service = ServiceProcess(0, {"LIPSERVE_HOME": home})
        try:
            with Client(service.url) as client:
                service.wait_ready(client)
                panda = client.upload(folder / PANDA[0], **PANDA[1])
                tell(panda, console)
                schunk = client.upload(folder / SCHUNK[0], **SCHUNK[1])
                tell(schunk, console)
                judge(client, "panda", panda, {"kind": "last", "share": 0.3}, console)
                judge(client, "schunk-episodes", schunk, {"kind": "episodes", "share": 0.3}, console)
                judge(client, "schunk-last", schunk, {"kind": "last", "share": 0.3}, console)
        finally:
            service.stop()


if __name__ == "__main__":
    main()
