"""Writing samples as the files that the service reads."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lipcore.data.samples import Samples


def write(path: Path, samples: Samples) -> None:
    """Write samples as CSV or NPZ by the path's ending; raise ValueError for another ending."""
    if path.suffix == ".npz":
        names = ("t", "episode", "q", "dq", "ddq", "tau")
        arrays = {name: getattr(samples, name) for name in names}
        np.savez(path, joint_names=np.array(samples.joint_names), **arrays)
    elif path.suffix == ".csv":
        joints = range(1, samples.n_joints + 1)
        quantities = ("q", "dq", "ddq", "tau")
        header = ["t", "episode", *(f"{name}{joint}" for name in quantities for joint in joints)]
        table = np.column_stack([samples.t, samples.episode, *(getattr(samples, name) for name in quantities)])
        formats = ["%.17g", "%d", *["%.17g"] * (4 * samples.n_joints)]
        np.savetxt(path, table, fmt=formats, delimiter=",", header=",".join(header), comments="")
    else:
        raise ValueError(f"file is {path.name!r}, expected the ending .csv or .npz")
