"""Training of a model: choice of the estimator, its fit, and the pass over all samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from lipcore.data import brakes, outliers
from lipcore.data.independence import recording_weights
from lipcore.data.motion import check_joint_types
from lipcore.data.samples import Samples
from lipcore.estimators.base import RobotKind, check_base
from lipcore.estimators.catalogue import check_estimator
from lipcore.estimators.hyperparameters import Cancelled, Progress
from lipcore.estimators.options import FitOptions
from lipcore.estimators.task import Task
from lipcore.kernels.drive.play import with_deflections
from lipcore.kernels.geometry import Geometry
from lipcore.model.sibling import arm_of_sibling
from lipcore.model.torque_model import TorqueModel
from lipcore.robots.urdf import RigidBody
from lipcore.training import conditioning
from lipcore.training.auto import train_auto
from lipcore.training.fit import fit_estimator
from lipcore.vocabulary import AUTO, TorqueConvention


def train(
    samples: Samples,
    joint_types: Sequence[str],
    estimator: str = AUTO,
    options: FitOptions | None = None,
    torque_convention: TorqueConvention = "gravity_included",
    on_progress: Progress | None = None,
    cancelled: Cancelled | None = None,
    robot: RigidBody | None = None,
    base: TorqueModel | None = None,
) -> TorqueModel:
    """Train a model on samples of n joints.

    Corrupt rows (`lipcore.data.outliers`) and rows with closed brakes (`lipcore.data.brakes`) are removed first. The
    fit's report contains their numbers.

    Args:
        samples: Samples of n joints.
        joint_types: `revolute` or `prismatic` for each joint, (n,).
        estimator: One of `ESTIMATORS`, or `auto`, which chooses (`lipcore.training.auto`).
        options: Options of the fit.
        torque_convention: Meaning of `samples.tau`.
        on_progress: See `lipcore.estimators.hyperparameters.fit`.
        cancelled: See `lipcore.estimators.hyperparameters.fit`.
        robot: Rigid bodies with the joints of the samples, for estimators with an arm.
        base: Model of another unit of the same robot; its arm is the prior (`lipcore.model.sibling`).

    Returns:
        The trained model.

    Raises:
        ValueError: An argument is invalid.
        BaseMismatchError: The training cannot start from the base.
        CorruptRowsError: Too many rows are corrupt.
        FitCancelledError: The caller cancelled the training.
        NotPositiveDefiniteError: A covariance matrix cannot be factored.

    """
    corrupt = outliers.find_in_samples(samples)
    braked = brakes.find_in_samples(samples)
    removed = corrupt.rows | braked.rows
    samples = samples.rows(~removed) if removed.any() else samples
    types, options = check_joint_types(joint_types), options or FitOptions()
    sibling = None
    if base is not None:
        of_base = RobotKind(base.joint_names, base.joint_types, base.torque_convention)
        of_data = RobotKind(samples.joint_names, types, torque_convention)
        order = None if base.arm is None else base.arm.order.tolist()
        check_base(
            f"a model of {base.estimator.name}",
            of_base,
            order,
            of_data,
            estimator,
            options,
            None if robot is None else robot.name,
            1 if base.arm is None else len(base.arm.geometry.roots),
        )
        robot, sibling = base.robot, arm_of_sibling(base)
    task = Task(
        samples,
        types,
        options,
        torque_convention,
        robot,
        on_progress=on_progress,
        cancelled=cancelled,
        sibling=sibling,
    )
    samples = with_deflections(samples, types)
    model = fit_model(task.on(samples), estimator)
    counts = {"samples_braked": int(braked.rows.sum())} if braked.joints else {}
    model = replace(model, fit={**model.fit, **corrupt.fit_entries(), **counts})
    weights = recording_weights(samples.t, samples.episode)
    if not conditioning.should_condition(task.options, len(samples), float(weights.sum())):
        return model
    return conditioning.condition(model, samples, weights, cancelled)


def fit_model(task: Task, estimator: str = AUTO, geometries: Sequence[Geometry] = ()) -> TorqueModel:
    """Train like `train`, on the given samples alone. If all are too many for memory, they are a thinned table.

    estimator: as in `train`; geometries: first starts of a search, base to tip, for example of an earlier version;
    `auto` ignores them. Raise like `train`.
    """
    if task.sibling is None:
        check_estimator(estimator, task.joint_types, task.robot, task.options)
    task.options.check_device(estimator)
    return train_auto(task) if estimator == AUTO else fit_estimator(task, estimator, geometries=geometries)
