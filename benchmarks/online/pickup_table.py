"""Results, targets and tables of the benchmark of payloads."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.latency.table import NOTHING, Grid
from benchmarks.latency.targets import Target
from benchmarks.online.arms import KINDS, SPEEDS
from benchmarks.online.carried import AFTER, Answers, Figure, Outcome
from benchmarks.online.quiet import Quiet
from benchmarks.online.rivals import Rival
from lipcore.data.metrics import quantile

MIN_DETECTION_S = 0.1
"""Time of the first batch after the pick-up."""
NOTES = (
    "Streams have 100 Hz, in batches of 10 rows over HTTP, each after a query. The pick-up is at the start of a batch; "
    "0.1 s is the min time to detection. Every case has a fresh copy of the model.",
    "Torques are predicted by the default model on another motion of 20 s: mean nMSE over joints, in brackets all "
    "squared errors over all variances, and the lowest coverage of a joint's 95 % interval. Clean: nMSE against torque "
    "without noise, coverage of noisy torque; dirty: both of measured torque.",
    "Mass: with the half width of its 95 % interval; ✗ if it misses the truth.",
    "Other methods run on the Panda with 1 kg, centred, fast, clean. Refit and least squares know the time of the "
    "pick-up and are ready without delay; least squares knows the true URDF; the adapting service is queried after it "
    "has learnt all rows.",
    "Without payload: `PayloadTracker` in process, with the model as trained. Contacts: forces of 10 to 40 N on random "
    "links, for 0.2 s every 2 s.",
)


@dataclass
class Carrying:
    """Results: cases, other methods on one of them, and streams without payload."""

    outcomes: list[Outcome] = field(default_factory=list)
    rivals: list[Rival] = field(default_factory=list)
    quiet: list[Quiet] = field(default_factory=list)

    def write(self, path: Path, targets: list[dict[str, Any]]) -> None:
        """Write the results and the targets as JSON."""
        path.write_text(json.dumps({**asdict(self), "targets": targets}, indent=2) + "\n")


def grids(found: Carrying) -> list[Grid]:
    """Return all tables with rows."""
    ways = ("free", "before", *(f"{after:g} s" for after in AFTER))
    columns = ("", "detected/released s", *(f"kg {after:g} s" for after in AFTER), *ways, "after/before", "ack")
    every = [
        Grid("payloads, case by case", columns, [case_row(out) for out in found.outcomes]),
        Grid("payloads: median | worst", ("", "cases", *_SUMMARY), summary(found.outcomes)),
        Grid("other methods", ("", *(f"{after:g} s" for after in AFTER)), [rival_row(each) for each in found.rivals]),
        Grid(
            "motion without payload",
            ("", "minutes", "false payloads", "contacts", "false in contacts", "longest s", "failures"),
            _quiet(found),
        ),
    ]
    return [grid for grid in every if grid.rows]


def targets(found: Carrying) -> list[Target]:
    """Return all targets."""
    noticed = sum(each.noticed for each in found.quiet) if found.quiet else None
    early = sum(out.early for out in found.outcomes) if found.outcomes else None
    return [
        Target("payloads detected in motion without payload", noticed, "", "≤", 0),
        Target("payloads detected before the pick-up", early, "", "≤", 0),
    ]


def case_row(out: Outcome) -> tuple[str, ...]:
    """Return the row of a case: name, times, masses, answers, nMSE after release over before, time of a batch."""
    case = out.case
    odd = " early!" * out.early + "".join(f" {each}" for each in out.states if each not in ("none", "payload"))
    again = NOTHING if out.first is None else f"{out.first.mean / out.free.mean:.2f}"
    return (
        f"{case.robot} {case.kind} {case.mass:g} kg {case.place} {case.speed}",
        f"{_seconds(out.detected)}/{_seconds(out.released)}{odd}",
        *(_mass(case.mass, out.masses.get(after)) for after in AFTER),
        *(answers_text(each) for each in (out.free, out.before, *(out.answers.get(after) for after in AFTER))),
        again,
        f"{1e3 * float(np.median(out.acks)):.0f} ms" if out.acks else NOTHING,
    )


_SUMMARY = (
    "detected s",
    "in 0.1 s",
    *(f"mass error {after:g} s" for after in AFTER),
    "mass inside",
    "free",
    "before",
    *(f"nMSE {after:g} s" for after in AFTER),
    *(f"pooled {after:g} s" for after in AFTER),
    *(f"lowest % {after:g} s" for after in AFTER),
    "after/before",
)


def summary(outcomes: Sequence[Outcome]) -> list[tuple[str, ...]]:
    """Return a row of medians and worst values for each kind of arm and of motion."""
    rows = []
    for kind in KINDS:
        for speed in SPEEDS:
            chosen = [out for out in outcomes if (out.case.kind, out.case.speed) == (kind, speed)]
            if chosen:
                rows.append((f"{kind}, {speed}", str(len(chosen)), *_summed(chosen)))
    return rows


def _summed(outcomes: Sequence[Outcome]) -> list[str]:
    """Return the cells of _SUMMARY; `mass inside` counts all reported intervals."""
    noticed = [np.inf if out.detected is None else out.detected for out in outcomes]
    reported = [(out.case.mass, out.masses[after]) for out in outcomes for after in AFTER if out.masses.get(after)]
    inside = [figure.contains(mass) for mass, figure in reported if figure is not None]
    cells = [_both(noticed, "{:.1f}"), f"{100 * np.mean(np.array(noticed) <= MIN_DETECTION_S + 1e-9):.0f}%"]
    for after in AFTER:
        figures = [(out.masses.get(after), out.case.mass) for out in outcomes]
        cells.append(_both([abs(each.mean / mass - 1) for each, mass in figures if each is not None], "{:.0%}"))
    cells.append(f"{sum(inside)}/{len(inside)}")
    for found in ([out.free for out in outcomes], [out.before for out in outcomes]):
        cells += [_both([each.mean for each in found], "{:.1e}")]
    answers = [[out.answers[after] for out in outcomes] for after in AFTER]
    cells += [_both([each.mean for each in found], "{:.1e}") for found in answers]
    cells += [_both([each.pooled for each in found], "{:.1e}") for found in answers]
    cells += [_both([-each.lowest for each in found], "{:.0%}").replace("-", "") for found in answers]
    return [*cells, _both([out.first.mean / out.free.mean for out in outcomes if out.first is not None], "{:.2f}")]


def answers_text(answers: Answers | None) -> str:
    """Return mean nMSE, pooled nMSE and lowest coverage."""
    return NOTHING if answers is None else f"{answers.mean:.1e} ({answers.pooled:.1e}) {100 * answers.lowest:.0f}%"


def _both(values: Sequence[float], form: str) -> str:
    """Return median and maximum."""
    return f"{form.format(np.median(values))} | {form.format(max(values))}" if values else NOTHING


def rival_row(rival: Rival) -> tuple[str, ...]:
    """Return the row of another method: its answers, or the reasons why there are none."""
    cells = [rival.answers.get(after) for after in AFTER]
    return rival.label, *(each if isinstance(each, str) else answers_text(each) for each in cells)


def _quiet(found: Carrying) -> list[tuple[str, ...]]:
    rows = []
    for each in found.quiet:
        counts = each.minutes, each.noticed, each.contacts, each.taken, each.held_s, each.failures
        rows.append((f"{each.robot} {each.kind} {each.speed}", *(f"{count:g}" for count in counts)))
    return rows


def _seconds(value: float | None) -> str:
    return "never" if value is None else f"{value:.1f}"


def _mass(truth: float, figure: Figure | None) -> str:
    """Return mass with its 95 % half width, marked if it misses the truth."""
    if figure is None:
        return NOTHING
    return f"{figure.mean:.2f}±{quantile(0.95) * figure.std:.2f}" + ("" if figure.contains(truth) else "✗")
