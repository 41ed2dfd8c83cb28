"""The benchmark of payloads: every case over HTTP, a line as each ends, and what else could have been done."""

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
from benchmarks.online.carried import Outcome, carried
from benchmarks.online.pickup_table import Carrying, case_row, rival_row
from benchmarks.online.rivals import rivals
from lipcore.model.torque_model import TorqueModel
from service.contract.observations import LearningOptions

PARTS = ("payload", "rivals", "quiet")
"""What can be measured, by name; only where it is asked for."""
ROBOTS = ("panda", "ur10", "xarm7")
RIVAL = 1.0, "centred", "fast"
"""Mass, place and speed of the case that the rivals are tried on."""


@dataclass(frozen=True)
class Options:
    """How much is measured. parts: of PARTS; minutes: of quiet motion, of each arm."""

    parts: tuple[str, ...]
    robots: tuple[str, ...] = ROBOTS
    kinds: tuple[str, ...] = KINDS
    minutes: float = 3.0
    seed: int = 0

    def __post_init__(self) -> None:
        for name, given, known in (("--only", self.parts, PARTS), ("--kinds", self.kinds, KINDS)):
            if unknown := [each for each in given if each not in known]:
                raise ValueError(f"{name} has {unknown[0]!r}, expected names out of {', '.join(known)}")


def run(options: Options, console: Console) -> Carrying:
    """Measure arm by arm, the clean ones first; print a line for each case."""
    found = Carrying()
    for kind in (each for each in KINDS if each in options.kinds):
        for robot in options.robots:
            arm, began = Arm(robot, kind, options.seed), time.monotonic()
            model = arm.trained()
            console.print(f"{robot}, {kind}: trained in {time.monotonic() - began:.0f} s", highlight=False)
            if "payload" in options.parts:
                found.outcomes += _carried(arm, model, cases(robot, kind), console)
            if "rivals" in options.parts and (robot, kind) == (ROBOTS[0], KINDS[0]):
                case = next(each for each in cases(robot, kind) if (each.mass, each.place, each.speed) == RIVAL)
                found.rivals = rivals(arm, model, case)
                for each in found.rivals:
                    console.print("; ".join(rival_row(each)), highlight=False, soft_wrap=True)
            if "quiet" in options.parts:
                found.quiet += quiet.watched(arm, model, options.minutes, console)
    return found


def _carried(arm: Arm, model: TorqueModel, every: Sequence[Case], console: Console) -> list[Outcome]:
    """Each case on a copy of the model: what one has taught is unknown in the next."""
    found = []
    with tempfile.TemporaryDirectory(prefix="lipserve-bench-") as folder:
        lipcore.save(model, Path(folder) / "model")
        options = LearningOptions(auto_refresh=False, auto_promote=False)
        install(
            Path(folder) / "home", Path(folder) / "model", dict.fromkeys(map(name_of, every), options), model.n_joints
        )
        with serving(Path(folder) / "home") as bed:
            for case in every:
                found.append(carried(bed, name_of(case), arm, case))
                console.print("; ".join(case_row(found[-1])), highlight=False, soft_wrap=True)
    return found


def name_of(case: Case) -> str:
    """Of the model that a case is streamed to."""
    return f"case-{case.number}"
