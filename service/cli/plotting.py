"""Plots of planned motions and of measured and predicted torque. Requires matplotlib (extra `plot`)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lipcore.data.samples import Samples
from lipcore.excitation import Plan
from lipcore.extras import import_extra
from lipserve import Prediction
from service.foundation.text import percent


def pyplot() -> Any:
    """Import and return `matplotlib.pyplot`; raise MissingExtraError if it is not installed."""
    import_extra("matplotlib", "plot").use("agg")
    return import_extra("matplotlib.pyplot", "plot")


def draw_motion(path: Path, made: Plan) -> None:
    """Draw each joint's position, speed and acceleration with their limits, and the expected remaining variance."""
    plt, limits = pyplot(), made.limits
    t, *parts = made.table()
    bounds = ((limits.lower, limits.upper), (-limits.speed, limits.speed), (-limits.acceleration, limits.acceleration))
    figure, axes = plt.subplots(
        limits.n_joints, 3, sharex=True, squeeze=False, figsize=(11, 1.3 * limits.n_joints + 0.6)
    )
    for j, row in enumerate(axes):
        for axis, values, (low, high) in zip(row, parts, bounds, strict=True):
            axis.plot(t, values[:, j], color="tab:blue", lw=0.9)
            for bound in (low[j], high[j]):
                axis.axhline(bound, color="tab:red", lw=0.7, ls="--")
            axis.tick_params(labelsize=7)
        row[0].set_ylabel(f"{limits.joint_names[j]}\n{percent(made.left[j], 1)} left", fontsize=7)
    for axis, heading in zip(axes[0], ("position, rad (m)", "speed, per s", "acceleration, per s²"), strict=True):
        axis.set_title(heading, fontsize=8)
    for axis in axes[-1]:
        axis.set_xlabel("s", fontsize=8)
    mean = float(np.exp(np.log(made.left).mean()))
    figure.suptitle(f"planned motion: expected remaining torque variance {percent(mean, 2)}", fontsize=9)
    figure.tight_layout()
    figure.savefig(path, dpi=100)
    plt.close(figure)


def draw_torque(path: Path, samples: Samples, answer: Prediction) -> None:
    """Draw each joint's measured torque, its prediction and its 95 % interval."""
    plt = pyplot()
    lower, upper = answer.interval()
    figure, axes = plt.subplots(samples.n_joints, 1, sharex=True, figsize=(9, 1.5 * samples.n_joints))
    for j, axis in enumerate(np.atleast_1d(axes)):
        axis.fill_between(
            samples.t, lower[:, j], upper[:, j], color="tab:blue", alpha=0.25, lw=0, label="95 % interval"
        )
        axis.plot(samples.t, answer.tau[:, j], color="tab:blue", lw=1, label="predicted")
        axis.plot(samples.t, samples.tau[:, j], ".", color="black", ms=1.5, label="measured")
        axis.set_ylabel(f"{samples.joint_names[j].removeprefix('panda_')}\nN·m", fontsize=8)
        axis.tick_params(labelsize=7)
    axes[0].legend(ncols=3, fontsize=7, loc="lower right", bbox_to_anchor=(1, 1), frameon=False)
    axes[-1].set_xlabel("s", fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=100)
    plt.close(figure)
