"""The benchmark of a model exported as C and compiled with this machine's `cc`."""

from __future__ import annotations

import json
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from benchmarks import facts
from benchmarks.latency.baselines import rnea
from benchmarks.latency.table import Grid, targets_grid
from benchmarks.latency.targets import Target
from benchmarks.timing import Timing, measure
from benchmarks.workload import BenchError, simulator
from lipcore.data.samples import Array
from lipcore.export.c_writer import SOURCE, c_files
from lipcore.export.origin import ModelOrigin
from lipcore.files.persistence import load
from lipcore.model.torque_model import TrainingRange
from lipcore.robots.library import Robot, pinocchio

HERE = Path(__file__).parent
SHIPPED = HERE.parents[1] / "models/panda-sim"
PINOCCHIO = ("BOOST_MPL_LIMIT_LIST_SIZE=30", "BOOST_MPL_CFG_NO_PREPROCESSED_HEADERS")
"""Macros that Pinocchio's own CMake files define."""


@dataclass(frozen=True)
class Options:
    """Scope of the benchmark.

    Attributes:
        folder: folder of the model.
        calls: calls of each function.
        queries: max number of instants of the motion; each is called at least once.
        flags: compiler flags of the model. Pinocchio is called with -O2, as its library is compiled.
        eigen: folder of Eigen's headers, to call Pinocchio from C++; None: from Python.
        seed: seed of the motion.
    """

    folder: Path
    calls: int = 1_000_000
    queries: int = 100_000
    flags: tuple[str, ...] = ("-O2",)
    eigen: Path | None = None
    seed: int = 0


@dataclass
class Results:
    """All figures: timings in µs by subject, sizes in bytes by file, relative deviations by quantity."""

    machine: dict[str, str]
    estimator: str = "rigid-body"
    timings: dict[str, Timing] = field(default_factory=dict)
    sizes: dict[str, int] = field(default_factory=dict)
    deviations: dict[str, float] = field(default_factory=dict)

    def write(self, path: Path, targets: list[dict[str, Any]]) -> None:
        """Write all figures as JSON."""
        path.write_text(json.dumps({**asdict(self), "targets": targets}, indent=2) + "\n")


def run(options: Options, console: Console) -> Results:
    """Run the benchmark; raise BenchError if a compiler or a program fails."""
    model = load(options.folder)
    results = Results(facts.machine(), model.estimator.name)
    options = replace(options, queries=min(options.queries, options.calls))
    motion = _motion(model.training_range, options)
    with tempfile.TemporaryDirectory(prefix="lipserve-bench-") as home:
        folder = Path(home)
        for name, text in c_files(model, ModelOrigin(options.folder.name, 1, 0, "")).items():
            (folder / name).write_text(text)
        motion.tofile(folder / "queries")
        command = ["cc", "-std=c99", *options.flags, f"-I{folder}", str(HERE / "timing.c"), str(folder / SOURCE)]
        run_command([*command, "-o", str(folder / "timing"), "-lm"], folder)
        run_command(["cc", "-std=c99", *options.flags, "-c", SOURCE, "-o", "model.o"], folder)
        results.sizes = {path.name: path.stat().st_size for path in sorted(folder.glob("*model.*"))}
        calls = str(options.calls)
        for subject in ("nothing", *(("state", "state_std") if model.remembers else ()), "mean", "std"):
            console.print(f"{subject}: {options.calls:,} calls", highlight=False)
            run_command([str(folder / "timing"), subject, calls, "queries", "times", "answers"], folder)
            results.timings[subject] = Timing.of(np.fromfile(folder / "times", np.int64))
        answers = np.fromfile(folder / "answers").reshape(-1, 2, model.n_joints)
        robot = simulator(options.folder)
        if robot is not None and options.eigen is not None:
            console.print("compiling Pinocchio in C++, half a minute", highlight=False)
            results.timings["Pinocchio's rnea, C++"] = _time_cpp(robot, options, motion, folder)
        elif robot is not None:
            times = measure(rnea(robot, motion[:1000]), options.calls // 10)
            results.timings["Pinocchio's rnea, called from Python"] = Timing.of(times)
    q, dq, ddq = (np.ascontiguousarray(part) for part in motion.transpose(1, 0, 2))
    tau, tau_std, *_ = model.evaluator.many(q, dq, ddq)  # C has no fallback
    results.deviations = {
        # a torque near zero has no relative precision
        "tau, relative to tau or tau_std": _relative(answers[:, 0], tau, tau_std),
        "tau_std": _relative(answers[:, 1], tau_std, 0.0),
    }
    return results


def grids(results: Results) -> list[Grid]:
    """Return all tables."""
    rows = [
        (name, *(f"{value:.2f}" for value in (each.p50, each.p99, each.p999, each.largest)), f"{each.count:,}")
        for name, each in results.timings.items()
    ]
    return [
        Grid("machine", ("", ""), list(results.machine.items()), texts=True),
        Grid("µs a call, time of the clock (nothing) included", ("", "p50", "p99", "p99.9", "largest", "calls"), rows),
        Grid("bytes", ("", ""), [(name, f"{size:,}") for name, size in results.sizes.items()]),
        Grid("largest relative deviation", ("", ""), [(k, f"{v:.1e}") for k, v in results.deviations.items()]),
        targets_grid(targets(results), ""),
    ]


def targets(results: Results) -> list[Target]:
    """Return the targets for an arm of seven joints; times have targets for `rigid-body` only."""
    mean, std = results.timings["mean"], results.timings["std"]
    tau, deviation = results.deviations.values()
    times = [
        Target("torque: p50", mean.p50, "µs", "≤", 2),
        Target("torque and its standard deviation: p50", std.p50, "µs", "≤", 10),
    ]
    return [
        *(times if results.estimator == "rigid-body" else []),
        Target("torque: largest relative deviation", tau, "", "≤", 1e-9),
        Target("standard deviation: the same", deviation, "", "≤", 1e-9),
    ]


def _motion(limits: TrainingRange, options: Options) -> Array:
    """Return q, dq and ddq of sinusoids through the training range at 1 kHz, (queries, 3, n)."""
    (lowest, highest), speed = (np.array(limits["q"][end]) for end in ("min", "max")), np.array(limits["dq"]["max"])
    size = 0.5 * (highest - lowest)
    turn = speed / size * np.random.default_rng(options.seed).uniform(0.5, 1.0, len(size))
    phase = 1e-3 * np.arange(options.queries)[:, None] * turn
    q = lowest + size * (1 + np.sin(phase))
    return np.stack([q, size * turn * np.cos(phase), -size * turn**2 * np.sin(phase)], axis=1)


def _time_cpp(robot: Robot, options: Options, motion: Array, folder: Path) -> Timing:
    assert options.eigen is not None
    compile_pinocchio(robot, options.eigen, ("-O2",), folder)
    np.array([np.concatenate([robot.configuration(q), dq, ddq]) for q, dq, ddq in motion]).tofile(folder / "motions")
    run_command([str(folder / "rnea"), "robot", str(options.calls), "motions", "times"], folder)
    return Timing.of(np.fromfile(folder / "times", np.int64))


def compile_pinocchio(robot: Robot, eigen: Path, flags: Sequence[str], folder: Path) -> None:
    """Write `rnea`, a program, or a library if `flags` say so, and `robot`, its model; raise BenchError."""
    prefix = Path(str(pinocchio().__file__)).parents[4]  # cmeel.prefix, with the wheel's headers
    robot.model.saveToText(str(folder / "robot"))
    defined = [f"-D{each}" for each in (*PINOCCHIO, "PINOCCHIO_ENABLE_TEMPLATE_INSTANTIATION")]
    command = ["c++", "-std=c++17", *flags, *defined, f"-I{eigen}", f"-I{prefix / 'include'}"]
    libraries = [f"-L{prefix / 'lib'}", f"-Wl,-rpath,{prefix / 'lib'}", "-lpinocchio_default", "-lboost_serialization"]
    run_command([*command, str(HERE / "rnea.cpp"), *libraries, "-o", "rnea"], folder)


def run_command(command: Sequence[str], folder: Path) -> None:
    """Run a command; raise BenchError with its error output if it fails."""
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)  # noqa: S603 - ours
    except FileNotFoundError:
        raise BenchError(f"{command[0]} is not installed. Install a C compiler of that name.") from None
    if done.returncode:
        raise BenchError(f"{' '.join(command)} failed with exit code {done.returncode}: {done.stderr[:2000]}")


def _relative(values: Array, expected: Array, min_unit: Array | float) -> float:
    return float((np.abs(values - expected) / np.maximum(np.abs(expected), min_unit)).max())
