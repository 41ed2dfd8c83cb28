"""Drawing measured and predicted torque. Needs matplotlib (extra `plot`)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lipcore.data.samples import Samples
from service.client import Prediction


def draw(path: Path, samples: Samples, answer: Prediction, level: float = 0.95) -> None:
    """Draw each joint's measured torque, its prediction and the band that shall hold `level` of measurements."""
    import matplotlib  # noqa: PLC0415 - an extra

    matplotlib.use("agg")
    from matplotlib import pyplot as plt  # noqa: PLC0415

    lower, upper = answer.interval(level)
    figure, axes = plt.subplots(samples.n_joints, 1, sharex=True, figsize=(9, 1.5 * samples.n_joints))
    for j, axis in enumerate(np.atleast_1d(axes)):
        axis.fill_between(
            samples.t, lower[:, j], upper[:, j], color="tab:blue", alpha=0.25, lw=0, label=f"{level:.0%} interval"
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
