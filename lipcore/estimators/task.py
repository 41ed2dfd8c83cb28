"""What a training is given, checked before anything is spent on it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from lipcore.data.motion import check_finite, check_joint_types
from lipcore.data.samples import Samples
from lipcore.estimators.hyperparameters import Cancelled, Progress
from lipcore.estimators.options import FitOptions
from lipcore.kernels.arm_prior import Arm
from lipcore.robots.urdf import JointMismatchError, RigidBody
from lipcore.vocabulary import TORQUE_CONVENTIONS, JointType, TorqueConvention

MIN_SAMPLES = 10
"""Fewer samples say too little to fit anything to."""


@dataclass(frozen=True)
class Task:
    """What a training is given, whichever estimator it is of.

    samples: of n joints, thinned where all are too many for memory; joint_types: (n,); torque_convention: what
    `samples.tau` holds; robot: rigid bodies, built for the joints of the samples; stretches: contiguous samples of the
    same recordings, which tell the white noise of signals, the samples themselves where None; on_progress: called after
    every step; cancelled: asked at every evaluation, and ends the training with FitCancelledError; sibling: the
    arm of another unit of the same robot, which is expected beforehand in the place of `robot`.

    Raise ValueError for samples that are too few, not finite or of other joints, JointMismatchError for a robot of
    other joints.
    """

    samples: Samples
    joint_types: tuple[JointType, ...]
    options: FitOptions = field(default_factory=FitOptions)
    torque_convention: TorqueConvention = "gravity_included"
    robot: RigidBody | None = None
    stretches: Samples | None = None
    on_progress: Progress | None = None
    cancelled: Cancelled | None = None
    sibling: Arm | None = None

    def __post_init__(self) -> None:
        samples, convention = self.samples, self.torque_convention
        types = check_joint_types(self.joint_types)
        if len(types) != samples.n_joints:
            raise ValueError(f"joint_types has {len(types)} entries, expected {samples.n_joints}, one a joint")
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
    def signals(self) -> Samples:
        """The contiguous samples that tell the white noise."""
        return self.samples if self.stretches is None else self.stretches

    def contiguous(self, most: int) -> Samples:
        """`signals`, or of more than `most` so many, in 20 stretches from all over them, each an episode of its own."""
        signals, length = self.signals, most // 20
        if len(signals) <= most:
            return signals
        begins = np.linspace(0, len(signals) - length, 20).round().astype(np.int64)
        rows = (begins[:, None] + np.arange(length)).reshape(-1)
        stretch = np.repeat(np.arange(len(begins)), length)
        episode = np.unique(np.stack([signals.episode[rows], stretch]), axis=1, return_inverse=True)[1]
        return replace(signals.rows(rows), episode=episode.reshape(-1))

    def on(self, samples: Samples) -> Task:
        """The same task on other samples of the same recordings."""
        return replace(self, samples=samples)
