"""Compile ahead of the first use, for images and installations: `python -m lipcore.warm_up [ESTIMATOR …]`.

Numba keeps the machine code on disk (`NUMBA_CACHE_DIR`, else beside the source, else below the home). Without it the
first training on a machine waits up to a minute for the compiler.
"""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np

from lipcore.data.motion import Motion
from lipcore.data.samples import Samples
from lipcore.estimators.options import FitOptions
from lipcore.kernels.arm import ArmKernel
from lipcore.kernels.arm_prior import Alternative, Arm
from lipcore.kernels.drive.terms import drive_terms
from lipcore.kernels.payload import PayloadKernel
from lipcore.robots.urdf import PARAMETERS
from lipcore.training.train import train
from lipcore.vocabulary import ROBOT_ESTIMATORS

COMPILED_ESTIMATORS = ("lip", "lip-chain", *ROBOT_ESTIMATORS)
"""Estimators with compiled terms. Code that they share is compiled with each."""
FASTEST_OPTIONS = FitOptions(
    hyperparameter_samples=20, posterior_samples=40, max_iterations=3, starts=1, device="cpu", search_seconds=0.01
)
"""The fastest training that compiles everything."""


def warm_up(*names: str) -> None:
    """Train the named estimators, or all of COMPILED_ESTIMATORS, on an artificial robot of two joints, and predict.

    The machine code does not depend on the number of joints or samples, so these are small. Raise ValueError for a name
    that is not one of COMPILED_ESTIMATORS.
    """
    if unknown := [name for name in names if name not in COMPILED_ESTIMATORS]:
        raise ValueError(f"{unknown[0]!r} is not a compiled estimator. Compiled are {', '.join(COMPILED_ESTIMATORS)}")
    for name in names or COMPILED_ESTIMATORS:
        model = train(_swinging(), ("revolute", "revolute"), name, FASTEST_OPTIONS)
        model.warm_up()
        model.torque(*np.zeros((3, 1, 2)))
        if model.arm is not None:
            _of_arm(model.arm)


def _swinging() -> Samples:
    """Return samples of two joints that swing under gravity, each at its own frequency."""
    time, frequency = np.linspace(0.0, 30.0, 60), np.array([1.0, 1.7])
    phase = time[:, None] * frequency
    q, dq, ddq = np.sin(phase), np.cos(phase) * frequency, -np.sin(phase) * frequency**2
    tau = 3.0 * np.sin(np.cumsum(q, axis=1)) + ddq + 0.1 * dq
    return Samples(("first", "second"), time, np.zeros(len(time), np.int64), q, dq, ddq, tau)


def _of_arm(arm: Arm) -> None:
    """Compile the kernels that only a training on another recording needs: other arms or none, and the energies."""
    friction = np.zeros((arm.n_joints, len(drive_terms(arm.drive))))
    one = Alternative(arm.geometry, arm.parameters, np.zeros(arm.n_joints), friction, 0.5)
    zeros = np.zeros((1, arm.n_joints))
    motion = Motion(zeros, zeros, zeros)
    for kernel in (ArmKernel(replace(arm, alternatives=others)) for others in ((), (one, one))):
        kernel.features(motion)
        kernel.energy_features(motion)
        kernel.torque(np.zeros(kernel.size), motion)
        kernel.regressor().fill(motion.arrays()[0], np.empty((kernel.size, arm.n_joints)))
    payload = PayloadKernel(arm, np.ones(PARAMETERS))
    payload.features(motion)
    payload.regressor().fill(motion.arrays()[0], np.empty((PARAMETERS, arm.n_joints)))


if __name__ == "__main__":
    warm_up(*sys.argv[1:])
