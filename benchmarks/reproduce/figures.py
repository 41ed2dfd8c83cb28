"""The figures of a run as PNG: errors by joint, errors by number of samples, reliability. Needs matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.reproduce import table
from benchmarks.reproduce.report import Run
from lipcore.data.metrics import RELIABILITY_LEVELS
from lipcore.data.samples import Array
from lipcore.extras import import_extra

COLOURS = {
    "se": "#999999",
    "gip": "#009E73",
    "lse": "#CC79A7",
    "lip": "#56B4E9",
    "lip-chain": "#0072B2",
    "rigid-body": "#D55E00",
    "rigid-body+lip-chain": "#E69F00",
}
"""Okabe and Ito's palette, safe for colour-blind readers; related estimators have related hues."""
MARKERS = dict(zip(COLOURS, "Xsvo^DP", strict=True))
OTHER = "#000000"
STYLE = {
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e6e6e6",
    "grid.linewidth": 0.7,
    "legend.frameon": False,
    "figure.constrained_layout.use": True,
    "savefig.dpi": 150,
    "savefig.bbox": "tight",
}


def pyplot() -> Any:
    """Return Matplotlib's pyplot without a window; raise MissingExtraError."""
    import_extra("matplotlib", "plot").use("agg")
    return import_extra("matplotlib.pyplot", "plot")


def draw(run: Run, folder: Path) -> None:
    """Draw figure1.png, samples.png and reliability.png."""
    plt = pyplot()
    with plt.rc_context(STYLE):
        for name, figure in (
            ("figure1", _boxes(plt, run)),
            ("samples", _samples(plt, run)),
            ("reliability", _reliability(plt, run)),
        ):
            figure.savefig(folder / f"{name}.png")
            plt.close(figure)


def _boxes(plt: Any, run: Run) -> Any:
    """Box plots of nMSE per joint, grouped by joint, one panel a speed: Fig. 1 of the paper."""
    figure, axes = plt.subplots(
        len(run.speeds), 1, squeeze=False, figsize=(_width(1.6 * len(run.joint_names)), 3.6 * len(run.speeds))
    )
    step = 0.86 / len(run.estimators)
    for axis, speed in zip(axes[:, 0], run.speeds, strict=True):
        for place, estimator in enumerate(run.estimators):
            at = (place - (len(run.estimators) - 1) / 2) * step
            colour = COLOURS.get(estimator, OTHER)
            found = [
                _finite(table.column(run.main(speed=speed, estimator=estimator, joint=joint), "nmse"))
                for joint in run.joint_names
            ]
            axis.boxplot(
                found,
                positions=np.arange(len(found)) + at,
                widths=0.78 * step,
                patch_artist=True,
                manage_ticks=False,
                boxprops={"facecolor": colour, "edgecolor": colour, "linewidth": 0.8},
                medianprops={"color": "black", "linewidth": 1.2},
                whiskerprops={"color": colour, "linewidth": 0.9},
                showcaps=False,
                flierprops={"marker": ".", "markersize": 2.5, "markeredgecolor": colour, "markerfacecolor": colour},
            )
        for joint, share in enumerate(run.noise_share(speed)):
            axis.hlines(share, joint - 0.46, joint + 0.46, color="black", lw=1, linestyles=(0, (3, 2)), zorder=1)
        axis.set(yscale="log", ylabel="nMSE", xlim=(-0.5, len(run.joint_names) - 0.5), title=_titled(run, speed))
        axis.set_xticks(range(len(run.joint_names)), _joints(run))
        axis.grid(False, axis="x")
        for edge in np.arange(len(run.joint_names) - 1) + 0.5:
            axis.axvline(edge, color="#e6e6e6", lw=0.7)
    patches = import_extra("matplotlib.patches", "plot")
    lines = import_extra("matplotlib.lines", "plot")
    handles = [patches.Patch(color=COLOURS.get(name, OTHER), label=name) for name in run.estimators]
    handles.append(lines.Line2D([], [], color="black", lw=1, ls=(0, (3, 2)), label="noise / torque variance"))
    _legend(figure, handles)
    return figure


def _samples(plt: Any, run: Run) -> Any:
    """Median nMSE against the number of training samples, one panel a joint, one row a speed."""
    sizes = (*run.sizes, run.experiment.samples)
    shape = (len(run.speeds), len(run.joint_names))
    figure, axes = plt.subplots(
        *shape, squeeze=False, sharex=True, sharey="row", figsize=(_width(1.75 * shape[1]), 2.5 * shape[0])
    )
    seeds = run.experiment.training_seeds(run.curve_sets)
    for row, speed in zip(axes, run.speeds, strict=True):
        for axis, joint, label in zip(row, run.joint_names, _joints(run), strict=True):
            at = [each for each in table.select(run.rows, speed=speed, joint=joint) if each.train_seed in seeds]
            for estimator in run.estimators:
                found = [table.column(table.select(at, estimator=estimator, samples=size), "nmse") for size in sizes]
                known = [(size, np.median(nmse)) for size, nmse in zip(sizes, found, strict=True) if len(nmse)]
                if known:
                    axis.plot(*np.transpose(known), **_line(estimator), marker=MARKERS.get(estimator, "o"), ms=4)
            axis.axhline(1, color="black", lw=0.8, ls=":")
            axis.set(xscale="log", yscale="log", title=label)
            axis.set_xticks(sizes, [str(size) for size in sizes], fontsize=7)
            axis.minorticks_off()
        row[0].set_ylabel(f"median nMSE\nspeed {speed:g}" if len(run.speeds) > 1 else "median nMSE")
    figure.supxlabel("training samples", fontsize=9)
    _legend(figure, axes[0, 0].get_legend_handles_labels()[0])
    return figure


def _reliability(plt: Any, run: Run) -> Any:
    """Observed against nominal coverage, one panel an estimator: each joint thin, all joints together thick."""
    shape = (len(run.speeds), len(run.estimators))
    figure, axes = plt.subplots(
        *shape, squeeze=False, sharex=True, sharey=True, figsize=(_width(1.75 * shape[1]), 2.15 * shape[0])
    )
    for row, speed in zip(axes, run.speeds, strict=True):
        for axis, estimator in zip(row, run.estimators, strict=True):
            axis.plot([0, 1], [0, 1], color="black", lw=0.8, ls=":")
            curves = [
                each.reliability
                for each in run.results
                if (each.cell.speed, each.cell.estimator) == (speed, estimator)
                and each.cell.samples == run.experiment.samples
            ]
            if curves:
                observed = np.mean(curves, axis=0)  # (levels, joints)
                colour = COLOURS.get(estimator, OTHER)
                axis.plot(RELIABILITY_LEVELS, observed, color=colour, lw=0.7, alpha=0.5)
                axis.plot(RELIABILITY_LEVELS, observed.mean(axis=1), color=colour, lw=2.4)
            axis.set(xlim=(0, 1), ylim=(0, 1), aspect="equal", title=estimator)
            axis.title.set_fontsize(8.5)
            axis.set_xticks([0, 0.5, 1], ["0", "50 %", "100 %"])
            axis.set_yticks([0, 0.5, 1], ["0", "50 %", "100 %"])
        row[0].set_ylabel(f"observed coverage\nspeed {speed:g}" if len(run.speeds) > 1 else "observed coverage")
    figure.supxlabel(
        "nominal coverage (thick: all joints; thin: each joint; below the diagonal: overconfident)", fontsize=9
    )
    return figure


def _line(estimator: str) -> dict[str, Any]:
    return {"color": COLOURS.get(estimator, OTHER), "lw": 1.4, "label": estimator}


def _legend(figure: Any, handles: Sequence[Any]) -> None:
    figure.legend(handles=handles, loc="outside upper center", ncols=int(figure.get_figwidth() / 1.5), fontsize=8.5)


def _width(panels: float) -> float:
    """Return the width of a figure with room for the legend, inches."""
    return max(panels + 0.8, 6.5)


def _finite(values: Array) -> Array:
    return np.asarray(values[np.isfinite(values)])


def _joints(run: Run) -> list[str]:
    return [f"joint {number}" for number in range(1, len(run.joint_names) + 1)]


def _titled(run: Run, speed: float) -> str:
    e = run.experiment
    sets = f"{run.training_sets} training × {e.test_sets} test sets"
    return f"{e.robot}, speed {speed:g}: {e.samples} training samples, {sets}"
