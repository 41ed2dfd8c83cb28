"""Small models of all kinds for tests of exports."""

from dataclasses import replace
from functools import partial

import numpy as np

from lipcore import FitOptions, TorqueModel, load
from lipcore.arm.learning import learn
from lipcore.data.samples import Samples
from lipcore.estimators.catalogue import make_estimator
from lipcore.estimators.task import Task
from lipcore.export.origin import ModelOrigin
from lipcore.kernels.drive.play import element_widths
from lipcore.kernels.drive.terms import drive_terms
from lipcore.model.body import Body
from lipcore.online.batch import Rows
from lipcore.online.learner import OnlineModel
from lipcore.online.transfer import consolidate
from lipcore.posterior.compression import build_linear
from lipcore.posterior.misfit import Misfit
from lipcore.training.correction import correct
from lipcore.training.fit import fit_estimator
from lipcore.vocabulary import DRIVE_KINDS, DriveKind
from tests import ROOT
from tests.lipcore.arm.test_model import with_alternatives
from tests.lipcore.arm_oracles import (
    arm,
    correction_before,
    record_motion,
    reversed_pendulum_model,
    train_from_geometry,
)

OPTIONS = FitOptions(device="cpu", statistics="chosen")
ORIGIN = ModelOrigin("an-arm", 3, 7, "0123")
PANDA = ROOT / "models/panda-sim"
INERTIA = np.array([[0.020, 0.003, 0.001], [0.003, 0.015, -0.002], [0.001, -0.002, 0.010]])
BODY = Body(2.0, np.array([0.05, -0.03, 0.12]), INERTIA)


def draw_motions(model: TorqueModel, count: int, seed: int, beyond: float = 1.0) -> np.ndarray:
    """Return motions (3, N, n) within the training range times `beyond`."""
    draw, limits = np.random.default_rng(seed).uniform, model.training_range
    each = [draw(limits[name]["min"], limits[name]["max"], (count, model.n_joints)) for name in ("q", "dq", "ddq")]
    return beyond * np.stack(each)


def train_arm(kinds: str, seed: int, estimator: str = "rigid-body", options: FitOptions = OPTIONS) -> TorqueModel:
    geometry, _, robot = arm(kinds, seed)
    return train_from_geometry(geometry, robot, record_motion(robot, 1, 100), options, estimator)


def train_with_energies(kinds: str, seed: int) -> TorqueModel:
    return train_arm(
        kinds, seed, "rigid-body+lip-chain", replace(OPTIONS, hyperparameter_samples=20, max_iterations=3, starts=1)
    )


def train_with_correction(kinds: str, seed: int) -> TorqueModel:
    """Train an arm with a local correction of its first two joints, and teach both with a stream."""
    geometry, _, robot = arm(kinds, seed)
    samples = record_motion(robot, 1, 200)
    samples = replace(samples, tau=samples.tau + 0.1 * np.sin(9 * samples.q))
    task = Task(samples, robot.joint_types, OPTIONS)
    before = correction_before(samples, (0, 1))
    learnt = learn(task, begin=(geometry.canonical(),))
    model = fit_estimator(task, "rigid-body+local", learnt, correct=partial(correct, before=before))
    parts = (samples.t, samples.q, samples.dq, samples.ddq, samples.tau + 0.05 * np.cos(9 * samples.q))
    return consolidate(OnlineModel.start(model).learn(Rows(*parts, np.zeros(len(samples), np.uint8))))


def with_misfit(model: TorqueModel) -> TorqueModel:
    """Return the model with every contribution to the variance."""
    rng, n = np.random.default_rng(0), model.n_joints
    rows = np.stack([rng.uniform(0.1, 1.0, n), np.full(n, 0.1), *rng.uniform(0.5, 1.0, (4, n))])
    own = model.posterior.misfit
    misfit = replace(Misfit.unpacked(rows), elements=own.elements, arms=own.arms)
    floor = np.array([1e-4, 10.0, *[1e-4] * (n - 2)])
    return replace(model, posterior=replace(model.posterior, misfit=misfit, floor=floor, std_factor=1.3))


def predicted_samples(model: TorqueModel) -> Samples:
    """Return samples of the model's own torque."""
    motion, names = draw_motions(model, 100, 1), model.joint_names
    tau, *_ = model.evaluator.many(*motion)
    return Samples(names, 0.01 * np.arange(100), np.zeros(100, int), *motion, tau)


def train_with_alternatives() -> TorqueModel:
    model = train_arm("RPR", 51)
    return with_alternatives(model, predicted_samples(model), 2)


def with_drive(model: TorqueModel, *kinds: DriveKind) -> TorqueModel:
    """Return the model of an arm with these kinds of friction."""
    rng, n, posterior, samples = np.random.default_rng(0), model.n_joints, model.posterior, predicted_samples(model)
    samples = replace(samples, tau=samples.tau + rng.standard_normal(samples.tau.shape))
    changed = replace(model.arm, drive=kinds, acceleration=rng.uniform(1.0, 5.0, n))
    estimator = make_estimator("rigid-body", model.joint_types, arm=changed)
    widths = posterior.params["friction.log_std"]
    more = np.repeat(widths[:, 1:2], len(drive_terms(kinds)) - 3, axis=1)
    params = {**posterior.params, "friction.log_std": np.concatenate([widths, more], axis=1)}
    misfit = replace(posterior.misfit, still=rng.uniform(0.1, 1.0, n))
    if "play" in kinds:
        elements = element_widths(model.joint_types)
        misfit = replace(misfit, elements=np.stack([rng.uniform(0.1, 1.0, elements.shape), elements]))
    variance = np.broadcast_to(posterior.noise_variance, samples.tau.shape)
    made = build_linear(estimator.kernel, params, samples, variance, 0.01, 1.0, misfit)
    return replace(model, estimator=estimator, posterior=made.posterior)


def train_with_alternatives_and_drive() -> TorqueModel:
    model = with_drive(train_arm("RPR", 51), *DRIVE_KINDS)
    return with_alternatives(model, predicted_samples(model), 2)


MODELS = {
    "panda": lambda: load(PANDA),
    "prismatic": lambda: train_arm("RPR", 51),
    "two arms": lambda: with_misfit(with_drive(train_arm("RRpRR", 52), *DRIVE_KINDS)),
    "prismatic first": lambda: train_arm("PRR", 50),
    "alternatives": train_with_alternatives,
    "fixed, from its tip": lambda: reversed_pendulum_model("fixed", OPTIONS),
    "calibrated, from its tip": lambda: reversed_pendulum_model("calibrate", OPTIONS),
    "friction of slow joints": lambda: with_drive(train_arm("RRR", 50), "stribeck"),
    "friction of all kinds": lambda: with_drive(train_arm("RRR", 50), *DRIVE_KINDS),
    "friction of all kinds, alternatives": train_with_alternatives_and_drive,
    "play, from its tip": lambda: with_drive(reversed_pendulum_model("fixed", OPTIONS), "play"),
    "misfit": lambda: with_misfit(train_arm("RRR", 50)),
    "energies": lambda: with_misfit(train_with_energies("RRR", 50)),
    "local": lambda: train_with_correction("RPR", 51),
    "energies of a prismatic joint": lambda: train_with_energies("RPR", 51),
}
