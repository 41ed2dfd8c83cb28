"""Tables and targets of the results, and the page of the documentation."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from benchmarks.latency import table
from benchmarks.latency.table import NOTHING, Grid
from benchmarks.latency.targets import Target
from benchmarks.real.cells import OWN, PRODUCT, Knowledge, Result
from benchmarks.real.running import ALONE, PEERS, WITH_BODY, Outcome
from benchmarks.real.splits import EARLY, GUARD_S, MAX_TEST_ROWS, SECONDS

TEN_S = 9.4
"""Min duration of ten seconds of training; preparation cuts half a second off a recording."""
LIMITS: Mapping[tuple[str, str], tuple[str, Mapping[Knowledge, float]]] = {
    ("panda-9s", EARLY): ("panda-9s, its last 30 %", {"nothing": 2e-2, "URDF": 1.3e-2}),
    ("panda-9s", "other"): ("panda-9s, other motion", {"nothing": 1.6e-2, "URDF": 1.3e-2}),
    ("kuka", "other"): ("kuka, other motion", {"nothing": 1.4e-1}),
}
"""Max mean nMSE on some splits."""
MIN_COVERAGE = 0.85
"""Min coverage of a joint's 95 % interval."""
MAX_OF_MEAN = 1.05
"""Max error / error of the recording's mean."""
KNOWLEDGE_TITLES: Mapping[Knowledge, str] = {"nothing": "no URDF", "URDF": "URDF"}
"""Names in the tables of what a method knows."""

EITHER: tuple[Knowledge, ...] = ("nothing", "URDF")
WITHOUT_URDF: tuple[Knowledge, ...] = ("nothing",)
Split = tuple[str, str]
"""Names of recording and split."""
Column = tuple[str, Knowledge]
COLUMNS: Sequence[Column] = (
    *((method, knowledge) for method in OWN for knowledge in EITHER),
    *((method, "nothing") for method in ALONE),
    *((method, "URDF") for method in WITH_BODY),
)
"""Methods and what they know."""


class Summary:
    """Results by recording and split."""

    def __init__(self, results: Iterable[Result]) -> None:
        self.results = list(results)
        self.rows: dict[Split, dict[Column, Result]] = {}
        for result in self.results:
            row = self.rows.setdefault((result.cell.recording, result.cell.split), {})
            row[result.cell.method, result.cell.knowledge] = result

    def product(self) -> list[Result]:
        """Return the results of LIPServe."""
        return [each for each in self.results if each.cell.method == PRODUCT]

    def ratio(self, result: Result, knowledge: tuple[Knowledge, ...] = EITHER) -> float | None:
        """Return the error / error of the best other method with this knowledge; None without any."""
        row = self.rows[result.cell.recording, result.cell.split]
        rivals = [each.error for (method, known), each in row.items() if method not in OWN and known in knowledge]
        return result.error / min(rivals) if rivals else None


def targets(results: Iterable[Result]) -> list[Target]:
    """Return all targets."""
    summary = Summary(results)
    everything = summary.product()
    ratios: defaultdict[tuple[Knowledge, bool], list[float]] = defaultdict(list)
    for each in everything:
        if (ratio := summary.ratio(each)) is not None:
            ratios[each.cell.knowledge, each.train_s >= TEN_S].append(ratio)
    long, of_mean = ratios["URDF", True], "error / error of the recording's mean"
    found = [
        Target("no URDF, at least 10 s: largest error / best other", _max(ratios["nothing", True]), "×", "≤", 2.0),
        Target("URDF, at least 10 s: largest error / best other", _max(long), "×", "≤", 1.15),
        Target("URDF, at least 10 s: median error / best other", _median(long), "×", "≤", 1.0),
        Target("no URDF, less than 10 s: largest error / best other", _max(ratios["nothing", False]), "×", "≤", 5),
        Target(f"largest {of_mean}", _max([each.of_mean for each in everything]), "×", "≤", MAX_OF_MEAN),
        Target(f"worst joint: {of_mean}", _max([each.worst for each in everything]), "×", "≤", MAX_OF_MEAN),
    ]
    for split, (name, limits) in LIMITS.items():
        for knowledge, limit in limits.items():
            result = summary.rows.get(split, {}).get((PRODUCT, knowledge))
            error = None if result is None else result.error
            found.append(Target(f"{name}, {KNOWLEDGE_TITLES[knowledge]}", error, "nMSE", "≤", limit))
    covered = [100.0 * (each >= MIN_COVERAGE) for result in everything for each in result.coverage]
    widths = [each for result in everything for each in result.width]
    return [
        *found,
        Target("joints with a coverage of 85 to 100 %", float(np.mean(covered)) if covered else None, "%", "≥", 90),
        Target("median width / need", _median(widths), "×", "≤", 2.0),
    ]


def _max(values: Sequence[float]) -> float | None:
    return max(values) if values else None


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if values else None


def grids(outcome: Outcome) -> list[Grid]:
    """Return all tables, the targets last."""
    summary = Summary(outcome.results)
    found = [
        errors(summary),
        details(summary),
        methods(summary),
        peers(summary),
        table.targets_grid(targets(outcome.results), ""),
    ]
    return [grid for grid in found if grid.rows]


def errors(summary: Summary) -> Grid:
    """Return the mean nMSE of each method on each split."""
    rows = []
    for (recording, split), row in summary.rows.items():
        learnt = next(iter(row.values())).train_s
        cells = (row.get(column) for column in COLUMNS)
        figures = (NOTHING if each is None else _power(each.error) for each in cells)
        rows.append((f"{recording}, {split}", f"{learnt:.1f}", *figures))
    heads = (f"{method}, {KNOWLEDGE_TITLES[knowledge]}" if method in OWN else method for method, knowledge in COLUMNS)
    title = "nMSE, mean over the joints; least squares and the methods after it know the URDF"
    return Grid(title, ("recording, test", "training s", *heads), rows)


def details(summary: Summary) -> Grid:
    """Return the figures of LIPServe on each split."""
    rows = []
    for each in summary.product():
        rows.append(
            (
                f"{each.cell.recording}, {each.cell.split}, {KNOWLEDGE_TITLES[each.cell.knowledge]}",
                " ".join(map(_power, each.nmse)),
                " ".join(f"{100 * value:.0f}" for value in each.coverage),
                f"{np.median(each.width):.1f}",
                f"{each.worst:.2g}",
                _times(summary.ratio(each)),
                _times(summary.ratio(each, WITHOUT_URDF)),
                f"{each.seconds:.0f}",
                each.estimator,
            )
        )
    heads = (
        *("recording, test", "nMSE, joint by joint", "coverage of 95 %, %", "width / need"),
        *("worst joint / mean", "× best other", "× best other, no URDF", "s", "estimator"),
    )
    return Grid(f"{PRODUCT}, default options", heads, rows, texts=True)


def methods(summary: Summary) -> Grid:
    """Return intervals and times of each method, and the number of splits on which its error is the smallest."""
    best = [min(row, key=lambda column: row[column].error) for row in summary.rows.values()]
    rows = []
    for column in COLUMNS:
        results = [row[column] for row in summary.rows.values() if column in row]
        if not results:
            continue
        covered = np.mean([value >= MIN_COVERAGE for each in results for value in each.coverage])
        width = np.median([value for each in results for value in each.width])
        times = [each.seconds for each in results]
        figures = (f"{100 * covered:.0f}", f"{width:.1f}", f"{np.median(times):.1f}", f"{max(times):.1f}")
        rows.append(
            (f"{column[0]}, {KNOWLEDGE_TITLES[column[1]]}", *figures, f"{best.count(column)} of {len(results)}")
        )
    heads = ("method", "joints covered 85 to 100 %, %", "median width / need", "median s", "max s", "smallest error")
    return Grid("intervals, times, and number of splits with the smallest error", heads, rows)


def peers(summary: Summary) -> Grid:
    """Return what each method needs to be told, what its user writes, and the uncertainty that it states."""
    rows = []
    for method, peer in PEERS.items():
        results = [row[method, "URDF"] for row in summary.rows.values() if (method, "URDF") in row]
        if not results:
            continue
        stated = [each.intervals for each in results if each.intervals is not None]
        infinite = NOTHING
        if stated:
            infinite = f"{sum(each.infinite for each in stated)} of {sum(each.parameters for each in stated)}"
        rows.append((method, peer.needs, peer.friction, str(peer.lines), peer.parameters, infinite, peer.torque))
    heads = ("method", "needs", "friction", "lines of code", "parameters", "infinite", "torque")
    return Grid(
        "what a method needs besides q, dq and torque, and the uncertainty that it states", heads, rows, texts=True
    )


def notes(outcome: Outcome) -> list[str]:
    """Return remarks on the tables."""
    lines = [
        f"Tests begin {GUARD_S:g} s after the training samples and have at most {MAX_TEST_ROWS} rows. {EARLY}: the "
        f"first 60 % is for training, the last 30 % for the test. {SECONDS}: random single seconds, a fifth of the "
        "recording, are the test. other: another motion.",
        "Width / need: mean half width of the 95 % interval over 1.96 RMSE. Worst joint / mean: largest error of a "
        "joint over the error of the training samples' mean.",
        "Other methods choose their constants on the last quarter of the training samples.",
        "LIPServe read, filtered and differentiated the recordings for all methods: lines of code are without that. "
        "Infinite: parameters with an infinite interval, over all splits. mujoco.sysid, forward: residual of simulated "
        "motion; its accuracy depends on the length of the simulated windows.",
    ]
    if outcome.absent:
        lines.append(f"Not installed: {', '.join(outcome.absent)}.")
    if outcome.skipped:
        lines.append("Too short: " + ", ".join(f"{name} ({why})" for name, why in outcome.skipped.items()) + ".")
    return lines


def page(outcome: Outcome, revision: str) -> str:
    """Return the page of the documentation."""
    head = f"# Real recordings\n\nWritten by `python -m benchmarks real FOLDER --page FILE`, {PRODUCT} {revision}.\n\n"
    return head + table.grids_markdown(grids(outcome), notes(outcome))


def _power(value: float) -> str:
    return f"{value:.2g}" if value >= 0.995 else f"{value:.1e}".replace("e-0", "e-")


def _times(value: float | None) -> str:
    return NOTHING if value is None else f"{value:.2f}"
