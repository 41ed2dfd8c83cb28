"""The benchmark of payloads: all cases over HTTP, other methods, and motion without payload."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

import lipcore
from benchmarks.online import quiet
from benchmarks.online.arms import KINDS, Arm, Case, cases
from benchmarks.online.bed import install, serving
from benchmarks.online.carried import Outcome, stream_case
from benchmarks.online.pickup_table import Carrying, case_row, rival_row
from benchmarks.online.rivals import rivals
from lipcore.model.torque_model import TorqueModel
from service.contract.observations import LearningOptions

PARTS = ("payload", "rivals", "quiet")
"""Names of the parts; they run only on request."""
ROBOTS = ("panda", "ur10", "xarm7")
RIVAL = 1.0, "centred", "fast"
"""Mass, place and speed of the case for other methods."""


@dataclass(frozen=True)
class Options:
    """Scope of the benchmark; minutes: motion without payload, of each arm."""

    parts: tuple[str, ...]
    robots: tuple[str, ...] = ROBOTS
    kinds: tuple[str, ...] = KINDS
    minutes: float = 3.0
    seed: int = 0

    def __post_init__(self) -> None:
        for name, given, known in (("--only", self.parts, PARTS), ("--kinds", self.kinds, KINDS)):
            if unknown := [each for each in given if each not in known]:
                raise ValueError(f"Unknown name {unknown[0]!r} in {name}. Names: {', '.join(known)}.")


def run(options: Options, console: Console) -> Carrying:
    """Measure arm by arm, clean ones first; print a line for each case."""
    found = Carrying()
    for kind in (each for each in KINDS if each in options.kinds):
        for robot in options.robots:
            arm, began = Arm(robot, kind, options.seed), time.monotonic()
            model = arm.trained()
            console.print(f"{robot}, {kind}: trained in {time.monotonic() - began:.0f} s", highlight=False)
            if "payload" in options.parts:
                found.outcomes += _stream_cases(arm, model, cases(robot, kind), console)
            if "rivals" in options.parts and (robot, kind) == (ROBOTS[0], KINDS[0]):
                case = next(each for each in cases(robot, kind) if (each.mass, each.place, each.speed) == RIVAL)
                found.rivals = rivals(arm, model, case)
                for each in found.rivals:
                    console.print("; ".join(rival_row(each)), highlight=False, soft_wrap=True)
            if "quiet" in options.parts:
                found.quiet += quiet.watched(arm, model, options.minutes, console)
    return found


def _stream_cases(arm: Arm, model: TorqueModel, every: Sequence[Case], console: Console) -> list[Outcome]:
    """Stream each case to its own copy of the model."""
    found = []
    with tempfile.TemporaryDirectory(prefix="lipserve-bench-") as folder:
        lipcore.save(model, Path(folder) / "model")
        options = LearningOptions(auto_refresh=False, auto_promote=False)
        install(
            Path(folder) / "home", Path(folder) / "model", dict.fromkeys(map(name_of, every), options), model.n_joints
        )
        with serving(Path(folder) / "home") as bed:
            for case in every:
                found.append(stream_case(bed, name_of(case), arm, case))
                console.print("; ".join(case_row(found[-1])), highlight=False, soft_wrap=True)
    return found


def name_of(case: Case) -> str:
    """Return the name of the model of a case."""
    return f"case-{case.number}"
