"""The command line of `python -m benchmarks.reproduce`."""

from __future__ import annotations

import os
import shlex
import sys
import time
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from benchmarks.reproduce import figures, report, table
from benchmarks.reproduce.experiment import YARDSTICK, Cell, Experiment
from benchmarks.reproduce.results import FILE, Results
from benchmarks.reproduce.running import ReproductionError, run
from lipcore.estimators.catalogue import ESTIMATORS
from lipcore.estimators.task import MIN_SAMPLES
from lipcore.robots.library import ROBOTS
from service.cli.consoles import print_json
from service.cli.options import Json

SIZES = (60, 120, 250)
QUICK_SIZES = (60, 120)
"""Further numbers of training samples; 250 take as long as 500, since hyperparameters are fitted on 150 of them."""
CURVE_SETS = 5
"""Training sets of the learning curve; `--quick` has one."""


app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
ERRORS = (ReproductionError,)
"""Errors printed without a traceback."""


@app.command()
def reproduce(
    robot: Annotated[str, typer.Option(help=f"Robot: {', '.join(ROBOTS)}.")] = "panda",
    out: Annotated[Path, typer.Option(help="Folder of the results. Existing results are not computed again.")] = Path(
        "reproduction"
    ),
    quick: Annotated[bool, typer.Option("--quick", help="3 × 4 sets: minutes instead of hours.")] = False,
    speed: Annotated[
        list[float] | None, typer.Option(help="Factor on the paper's frequencies, 1 by default; may be repeated.")
    ] = None,
    estimator: Annotated[list[str] | None, typer.Option(help="Estimator; may be repeated; all by default.")] = None,
    training_sets: Annotated[
        int | None, typer.Option(min=1, help="Number of training sets: 10, with --quick 3.")
    ] = None,
    test_sets: Annotated[int | None, typer.Option(min=1, help="Number of test sets: 16, with --quick 4.")] = None,
    samples: Annotated[int, typer.Option(min=2 * MIN_SAMPLES, help="Samples of each training and test set.")] = 500,
    size: Annotated[
        list[int] | None,
        typer.Option(help="Also train on this smaller number of samples; may be repeated; 0: no other number."),
    ] = None,
    test_stride: Annotated[
        int | None, typer.Option(min=1, help="Compare every n-th test sample: 2, with --quick 5.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the first training set.")] = 1,
    workers: Annotated[int | None, typer.Option(min=1, help="Number of processes; all cores by default.")] = None,
    as_json: Json = False,
) -> None:
    """Run the paper's experiment: all estimators on training × test sets of a simulated robot; tables and figures."""
    console, began = Console(soft_wrap=True, stderr=as_json), time.monotonic()
    figures.pyplot()
    experiment = Experiment(
        robot=robot,
        samples=samples,
        first_seed=seed,
        test_sets=test_sets or (4 if quick else 16),
        test_stride=test_stride or (5 if quick else 2),
    )
    speeds, estimators = list(dict.fromkeys(speed or [1.0])), list(dict.fromkeys(estimator or [*ESTIMATORS, YARDSTICK]))
    sizes = _sizes(size, QUICK_SIZES if quick else SIZES, samples)
    _check(experiment, speeds)
    joint_names = experiment.check(estimators).joint_names
    sets = training_sets or (3 if quick else 10)
    curve_sets = min(sets, 1 if quick else CURVE_SETS)
    cells = plan(experiment, speeds, estimators, sizes, sets, curve_sets)

    count = workers or os.cpu_count() or 1
    with Results(out, experiment) as results:
        missing = len(results.missing(cells))
        console.print(f"{len(cells)} trainings, {len(cells) - missing} of them in {out / FILE} already")
        try:
            run(experiment, cells, results, count, console)
        except KeyboardInterrupt:
            kept = len(cells) - len(results.missing(cells))
            console.print(f"Stopped: {kept} of {len(cells)} trainings are stored. Run the command again to resume.")
            raise typer.Exit(130) from None
        done, failed = results.of(cells), results.failed(cells)
    if not done:
        raise ReproductionError(f"All trainings failed, the first with {failed[0].error}")
    reported = report.Run(
        experiment=experiment,
        command=shlex.join(["python", "-m", "benchmarks.reproduce", *sys.argv[1:]]),
        joint_names=joint_names,
        speeds=tuple(speeds),
        estimators=tuple(estimators),
        sizes=tuple(sizes),
        training_sets=sets,
        curve_sets=curve_sets,
        results=done,
        failed=failed,
        rows=table.rows(done, joint_names),
        workers=count,
        seconds=time.monotonic() - began,
        computed=missing - len(failed),
    )
    report.write(reported, out)
    figures.draw(reported, out)
    if as_json:
        print_json({"folder": out, "trainings": len(done), "failed": len(failed), "seconds": reported.seconds})
    console.print(f"{out / 'results.md'}: tables and figures of {len(done)} trainings, after {reported.seconds:.0f} s")
    if failed:
        raise ReproductionError(f"{len(failed)} of {len(cells)} trainings failed, the first with {failed[0].error}")


def plan(
    experiment: Experiment, speeds: list[float], estimators: list[str], sizes: list[int], sets: int, curve_sets: int
) -> list[Cell]:
    """Return the cells: full sets seed by seed, then short trainings, which fill the cores at the end."""
    full = [
        Cell(estimator=name, speed=speed, samples=experiment.samples, seed=seed)
        for seed in experiment.training_seeds(sets)
        for speed in speeds
        for name in estimators
    ]
    fewer = [
        Cell(estimator=name, speed=speed, samples=size, seed=seed)
        for size in reversed(sizes)
        for seed in experiment.training_seeds(curve_sets)
        for speed in speeds
        for name in estimators
    ]
    return full + fewer


def _sizes(given: list[int] | None, default: tuple[int, ...], samples: int) -> list[int]:
    if given is None:
        return [size for size in default if size < samples]
    if given == [0]:
        return []
    for size in given:
        if not MIN_SAMPLES <= size < samples:
            raise ValueError(f"--size is {size}, expected from {MIN_SAMPLES} to less than --samples, {samples}")
    return sorted(set(given))


def _check(experiment: Experiment, speeds: list[float]) -> None:
    for speed in speeds:
        if not 0 < speed < float("inf"):
            raise ValueError(f"--speed is {speed:g}, expected a positive number")
    if experiment.samples // experiment.test_stride < MIN_SAMPLES:
        raise ValueError(
            f"--test-stride is {experiment.test_stride}, expected at most {experiment.samples // MIN_SAMPLES}: "
            f"at least {MIN_SAMPLES} samples of a test set are compared"
        )
