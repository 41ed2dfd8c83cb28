"""The input of a training, checked before any work is done."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import accumulate

import numpy as np

from lipcore.data.motion import check_finite, check_joint_types
from lipcore.data.samples import Samples
from lipcore.estimators.hyperparameters import Cancelled, Progress
from lipcore.estimators.options import FitOptions
from lipcore.kernels.arm_prior import Arm
from lipcore.robots.urdf import JointMismatchError, RigidBody
from lipcore.vocabulary import TORQUE_CONVENTIONS, JointType, TorqueConvention

MIN_SAMPLES = 10
"""Min samples of a fit."""


@dataclass(frozen=True)
class Task:
    """Input of a training, the same for all estimators.

    Raise ValueError for samples that are too few, not finite or of other joints, JointMismatchError for a robot of
    other joints.
    """

    samples: Samples
    """Samples of n joints, thinned if all are too many for memory."""
    joint_types: tuple[JointType, ...]
    """Types of the joints, (n,)."""
    options: FitOptions = field(default_factory=FitOptions)
    """Options of the fit."""
    torque_convention: TorqueConvention = "gravity_included"
    """Meaning of `samples.tau`."""
    robot: RigidBody | None = None
    """Rigid bodies, built for the joints of the samples."""
    stretches: Samples | None = None
    """Contiguous samples of the same recordings, to estimate the white noise of signals. None: the samples
    themselves."""
    on_progress: Progress | None = None
    """Called after every step."""
    cancelled: Cancelled | None = None
    """Called at every evaluation. If it returns true, the training ends with FitCancelledError."""
    sibling: Arm | None = None
    """Arm of another unit of the same robot: the prior instead of `robot`."""

    def __post_init__(self) -> None:
        samples, convention = self.samples, self.torque_convention
        types = check_joint_types(self.joint_types)
        if len(types) != samples.n_joints:
            raise ValueError(f"joint_types has {len(types)} entries, expected {samples.n_joints}, one for each joint")
        object.__setattr__(self, "joint_types", types)
        if convention not in TORQUE_CONVENTIONS:
            raise ValueError(f"torque_convention is {convention!r}, expected one of {', '.join(TORQUE_CONVENTIONS)}")
        if len(samples) < MIN_SAMPLES:
            raise ValueError(f"samples has {len(samples)} rows, expected at least {MIN_SAMPLES}")
        check_finite("tau", samples.tau)
        if self.robot is not None and self.robot.joint_names != samples.joint_names:
            raise JointMismatchError(
                f"robot {self.robot.name!r} was built for the joints {', '.join(self.robot.joint_names)}; the data "
                f"have {', '.join(samples.joint_names)}"
            )

    @property
    def gravity(self) -> bool:
        """Whether torques contain gravity."""
        return self.torque_convention == "gravity_included"

    @property
    def roots(self) -> tuple[int, ...]:
        """First joint of each arm, arm after arm from base to tip."""
        if self.sibling is not None:
            return self.sibling.geometry.roots
        sizes = self.options.sizes
        return self.robot.roots if self.robot is not None else (0, *accumulate(sizes[:-1]))

    @property
    def signals(self) -> Samples:
        """Contiguous samples to estimate the white noise."""
        return self.samples if self.stretches is None else self.stretches

    def contiguous(self, most: int) -> Samples:
        """Return `signals`. If there are more than `most`, return that many in 20 stretches, each a separate episode.

        The stretches are distributed over all signals.
        """
        signals, length = self.signals, most // 20
        if len(signals) <= most:
            return signals
        begins = np.linspace(0, len(signals) - length, 20).round().astype(np.int64)
        rows = (begins[:, None] + np.arange(length)).reshape(-1)
        stretch = np.repeat(np.arange(len(begins)), length)
        episode = np.unique(np.stack([signals.episode[rows], stretch]), axis=1, return_inverse=True)[1]
        return replace(signals.rows(rows), episode=episode.reshape(-1))

    def on(self, samples: Samples) -> Task:
        """Return the same task with other samples of the same recordings."""
        return replace(self, samples=samples)
