"""The report of a run: a Markdown page with every table, and the CSV files beside it."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import numpy as np

from benchmarks.reproduce import table
from benchmarks.reproduce.experiment import YARDSTICK, CellResult, Experiment
from benchmarks.reproduce.table import Row, Summary
from lipcore.data.samples import Array
from lipcore.robots.simulation import FUNDAMENTAL_RAD_S, MIDDLE_AMPLITUDE

_PACKAGES = ("lipserve", "numpy", "scipy", "torch", "numba", "pin", "example-robot-data", "matplotlib")


@dataclass(frozen=True)
class Run:
    """Content of the report.

    Results and rows are of all cells without error; this run computed `computed` of them in `seconds`.
    """

    experiment: Experiment
    command: str
    joint_names: tuple[str, ...]
    speeds: tuple[float, ...]
    estimators: tuple[str, ...]
    sizes: tuple[int, ...]
    training_sets: int
    curve_sets: int
    results: Sequence[CellResult]
    failed: Sequence[CellResult]
    rows: Sequence[Row]
    workers: int
    seconds: float
    computed: int

    def main(self, **equal: object) -> list[Row]:
        """Return the rows of training sets of full size."""
        return table.select(self.rows, samples=self.experiment.samples, **equal)

    def noise_share(self, speed: float) -> Array:
        """Return variance of the noise / variance of the torque, mean over test sets, (n,)."""
        std = [table.column(self.main(speed=speed, joint=joint), "torque_std") for joint in self.joint_names]
        return np.array([np.mean(self.experiment.noise**2 / each**2) if len(each) else np.nan for each in std])


def write(run: Run, folder: Path) -> None:
    """Write results.csv, summary.csv and results.md."""
    summary = table.summarise(run.rows)
    table.write_csv(folder / "results.csv", run.rows, Row)
    table.write_csv(folder / "summary.csv", summary, Summary)
    (folder / "results.md").write_text(markdown(run, summary))


def markdown(run: Run, summary: Sequence[Summary]) -> str:
    """Return the page: description of the run, tables for each speed, figures."""
    parts = [_introduction(run)]
    for speed in run.speeds:
        at = [each for each in summary if each.speed == speed]
        parts += [f"## Speed {speed:g}", *_tables(run, at, speed)]
    parts += ["## Figures", *_figures(), "## Cost", _cost(run), "## How it was made", _versions(run)]
    return "\n\n".join(parts) + "\n"


def _introduction(run: Run) -> str:
    e = run.experiment
    parts = [
        f"# The paper's experiment on simulated robots: {e.robot}",
        f"```sh\n{run.command}\n```",
        f"{run.training_sets} training sets × {e.test_sets} test sets of {e.samples} samples at {e.rate:g} Hz. Joints "
        f"move ±{MIDDLE_AMPLITUDE:g} rad in random sums of sinusoids: {e.training_sinusoids} multiples of "
        f"{FUNDAMENTAL_RAD_S:g} rad/s times the speed for training, {e.test_sinusoids} for testing. Torques are "
        f"measured with noise of {e.noise:g} N·m and have no friction. One model is trained on each training set; "
        f"every {_th(e.test_stride)}sample of each test set is compared.",
        "nMSE is the mean squared error against the simulator's torque without noise, divided by that torque's "
        "variance (`nmse_noisy` in the CSV is against the measured one). Coverage is the share of *measured* torques "
        "inside the interval, noise included. Medians, means and lowest values are over training sets × test sets.",
    ]
    if any(name.startswith("rigid-body") for name in run.estimators):
        parts.append(
            f"`rigid-body` learns geometry, masses and friction of the arm from torque alone. `{YARDSTICK}` is a "
            "reference: it knows the true geometry, and the scale of each body's mass. (The search for a geometry also "
            "tries those of installed URDFs, which include the robot's own; `python benchmarks/studies/learnt_arm.py "
            "rows` does not.)"
        )
    if run.failed:
        parts.append(
            "**Failed trainings, missing below:**\n\n" + "\n".join(f"- {_failure(each)}" for each in run.failed)
        )
    return "\n\n".join(parts)


def _failure(result: CellResult) -> str:
    return f"{result.cell}: {result.error}"


def _tables(run: Run, summary: Sequence[Summary], speed: float) -> list[str]:
    full = [each for each in summary if each.samples == run.experiment.samples]
    share = " | ".join(_power(value) for value in run.noise_share(speed))
    error = _by_joint(run, full, lambda each: _power(each.nmse_median), lambda each: each.nmse_median)
    parts = [
        "Median nMSE, the best of each joint in bold:",
        f"{error}\n| *noise variance / torque variance* | {share} |",
        "Mean (lowest) coverage of the 95 % interval, in %:",
        _by_joint(run, full, lambda each: f"{100 * each.coverage_95_mean:.0f} ({100 * each.coverage_95_lowest:.0f})"),
        "Mean width of the 95 % interval, N·m:",
        _by_joint(run, full, lambda each: f"{each.width_95_mean:.3g}"),
        "Mean coverage over all joints, in %:",
        _levels(run, speed),
    ]
    for size in run.sizes:
        fewer = [each for each in summary if each.samples == size]
        heading = f"Median nMSE after training on {size} samples ({_sets(run.curve_sets)}):"
        parts += [heading, _by_joint(run, fewer, lambda each: _power(each.nmse_median), lambda each: each.nmse_median)]
    return parts


def _by_joint(
    run: Run,
    summary: Sequence[Summary],
    text: Callable[[Summary], str],
    bold: Callable[[Summary], float] | None = None,
) -> str:
    """Return a table of estimators × joints; the smallest value of `bold` of each joint is in bold."""
    found = {(each.estimator, each.joint): each for each in summary}
    best = {
        joint: min((bold(each) for each in summary if each.joint == joint), default=None) if bold else None
        for joint in run.joint_names
    }
    body = []
    for estimator in run.estimators:
        cells = []
        for joint in run.joint_names:
            each = found.get((estimator, joint))
            shown = "–" if each is None else text(each)
            cells.append(f"**{shown}**" if each is not None and bold and bold(each) == best[joint] else shown)
        body.append([f"`{estimator}`", *cells])
    return _table(["", *run.joint_names], body)


def _levels(run: Run, speed: float) -> str:
    body = []
    for estimator in run.estimators:
        found = run.main(speed=speed, estimator=estimator)
        means = (f"{100 * table.column(found, f'coverage_{level}').mean():.1f}" for level in (50, 80, 95, 99))
        body.append([f"`{estimator}`", *(means if found else "–" * 4)])
    return _table(["interval", "50 %", "80 %", "95 %", "99 %"], body)


def _figures() -> list[str]:
    return [
        "![nMSE by joint and estimator](figure1.png)",
        "![nMSE against the number of training samples](samples.png)",
        "![Observed against nominal coverage](reliability.png)",
    ]


def _cost(run: Run) -> str:
    e, body = run.experiment, []
    for estimator in run.estimators:
        found = [each for each in run.results if each.cell.estimator == estimator and each.cell.samples == e.samples]
        if not found:
            body.append([f"`{estimator}`", *"–" * 5])
            continue
        fit = [each.fit_s for each in found]
        body.append(
            [
                f"`{estimator}`",
                f"{np.median(fit):.1f}",
                f"{max(fit):.1f}",
                f"{np.median([each.iterations for each in found]):.0f}",
                f"{max(each.peak_mb or 0 for each in found)}",
                f"{np.median([each.predict_ms for each in found]):.2f}",
            ]
        )
    heading = ["", "fit, median s", "fit, longest s", "iterations", "peak memory MB", "ms a query"]
    text = f"Training on {e.samples} samples, {run.workers} processes at a time with one thread each:"
    return f"{text}\n\n{_table(heading, body)}"


def _versions(run: Run) -> str:
    o = run.experiment.options
    everything = sum(each.total_s for each in run.results)
    trained = f"{len(run.results)} trainings with {everything:.0f} s of work"
    lines = [
        f"{run.seconds:.0f} s of wall time for {run.computed} trainings in this run, of {trained} in all, "
        f"{run.workers} workers on {os.cpu_count()} cores ({platform.machine()})",
        f"Python {platform.python_version()}, " + ", ".join(f"{name} {_version(name)}" for name in _PACKAGES),
        f"lipcore source {run.experiment.code}, settings {run.experiment.hash}",
        f"hyperparameters fitted on {o.hyperparameter_samples} samples with at most {o.max_iterations} iterations, "
        f"posterior on {o.posterior_samples}",
        f"training seeds {_range(run.experiment.training_seeds(run.training_sets))}, "
        f"test seeds {_range(run.experiment.test_seeds())}",
    ]
    if run.sizes:
        lines.append(
            "fewer samples are spread evenly over the same streams and cover the same region; the figure compares "
            f"{_sets(run.curve_sets)} at every size"
        )
    return "\n".join(f"- {line}" for line in lines)


def _table(heading: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    lines = [heading, ["---", *["---:"] * (len(heading) - 1)], *body]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _power(value: float) -> str:
    return "–" if np.isnan(value) else f"{value:.1e}".replace("e-0", "e-").replace("e+0", "e+")


def _sets(count: int) -> str:
    return f"the first {count} training sets" if count > 1 else "the first training set"


def _th(stride: int) -> str:
    return "" if stride == 1 else {2: "second ", 3: "third "}.get(stride, f"{stride}th ")


def _range(seeds: Sequence[int]) -> str:
    return f"{seeds[0]}–{seeds[-1]}" if len(seeds) > 1 else f"{seeds[0]}"


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "(not installed)"
