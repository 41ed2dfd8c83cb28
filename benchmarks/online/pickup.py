"""The benchmark of payloads: every case over HTTP, a line as each ends, and what else could have been done."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from rich.console import Console

import lipcore
from benchmarks.online import quiet
from benchmarks.online.arms import KINDS, Arm, Case, Kind, cases
from benchmarks.online.bed import install, serving
from benchmarks.online.carried import AFTER, Answers, Figure, Outcome, carried
from benchmarks.online.rivals import Rival, rivals
from lipcore.model.torque_model import TorqueModel
from service.learning.schema import LearningOptions

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
    kinds: tuple[Kind, ...] = KINDS
    minutes: float = 3.0
    seed: int = 0

    def __post_init__(self) -> None:
        for name, given, known in (("--only", self.parts, PARTS), ("--kinds", self.kinds, KINDS)):
            if unknown := [each for each in given if each not in known]:
                raise ValueError(f"{name} has {unknown[0]!r}, expected names out of {', '.join(known)}")


@dataclass
class Carrying:
    """What was measured: cases, their rivals on one of them, and quiet streams."""

    outcomes: list[Outcome] = field(default_factory=list)
    rivals: list[Rival] = field(default_factory=list)
    quiet: list[quiet.Quiet] = field(default_factory=list)


def run(options: Options, console: Console) -> Carrying:
    """Measure arm by arm, the clean ones first; print a line for each case."""
    found = Carrying()
    for kind in options.kinds:
        for robot in options.robots:
            arm, began = Arm(robot, kind, options.seed), time.monotonic()
            model = arm.trained()
            console.print(f"{robot}, {kind}: trained in {time.monotonic() - began:.0f} s", highlight=False)
            if "payload" in options.parts:
                found.outcomes += _carried(arm, model, cases(robot, kind), console)
            if "rivals" in options.parts and (robot, kind) == (ROBOTS[0], KINDS[0]):
                case = next(each for each in cases(robot, kind) if (each.mass, each.place, each.speed) == RIVAL)
                found.rivals = rivals(arm, model, case, console)
            if "quiet" in options.parts:
                found.quiet += quiet.watched(arm, model, options.minutes, console)
    return found


def _carried(arm: Arm, model: TorqueModel, every: Sequence[Case], console: Console) -> list[Outcome]:
    """Each case on a copy of the model: what one has taught is unknown in the next."""
    found = []
    with tempfile.TemporaryDirectory(prefix="lipserve-bench-") as folder:
        lipcore.save(model, Path(folder) / "model")
        options = LearningOptions(auto_refresh=False, auto_promote=False)
        install(Path(folder) / "home", Path(folder) / "model", dict.fromkeys(map(name_of, every), options), model.n_joints)
        with serving(Path(folder) / "home") as bed:
            for case in every:
                found.append(carried(bed, name_of(case), arm, case))
                console.print("; ".join(line(found[-1])), highlight=False, soft_wrap=True)
    return found


def name_of(case: Case) -> str:
    """Of the model that a case is streamed to."""
    return f"case-{case.number}"


def line(out: Outcome) -> tuple[str, ...]:
    """One case as texts: which; when noticed and released; masses; nMSE and coverage; the first answer without it."""
    case = out.case
    masses = [_mass(case.mass, out.masses.get(after)) for after in AFTER]
    answers = [answers_text(each) for each in (out.before, *(out.answers.get(after) for after in AFTER))]
    again = "–" if out.first is None else f"{out.first.mean / out.free.mean:.2f}"
    odd = " early!" * out.early + "".join(f" {each}" for each in sorted(out.states - {"none", "payload"}))
    return (
        f"{case.robot} {case.kind} {case.mass:g} kg {case.place} {case.speed}",
        f"{_seconds(out.detected)}/{_seconds(out.released)}{odd}",
        *masses,
        answers_text(out.free),
        *answers,
        again,
        "–" if not out.acks else f"{1e3 * float(np.median(out.acks)):.0f} ms",
    )


def answers_text(answers: Answers | None) -> str:
    """Mean nMSE, pooled nMSE and lowest coverage."""
    return "–" if answers is None else f"{answers.mean:.1e} ({answers.pooled:.1e}) {100 * answers.lowest:.0f}%"


def _seconds(value: float | None) -> str:
    return "never" if value is None else f"{value:.1f}"


def _mass(truth: float, figure: Figure | None) -> str:
    """Mass with its 95 % half width, marked where it misses the truth."""
    if figure is None:
        return "–"
    return f"{figure.mean:.2f}±{1.96 * figure.std:.2f}" + ("" if figure.holds(truth) else "✗")
