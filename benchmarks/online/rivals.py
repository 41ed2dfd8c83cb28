"""Other methods to learn a payload: adapting as to any change, a full refit, and least squares."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

import lipcore
from benchmarks.clients import HttpClient
from benchmarks.online.arms import NOISE, RATE, UP, Arm, Case
from benchmarks.online.bed import install, serving
from benchmarks.online.carried import AFTER, BATCH, STREAM, Answers, evaluate_answers, evaluate_served
from benchmarks.online.sending import batch_request, send
from lipcore.data.samples import Array, Samples
from lipcore.model.torque_model import TorqueModel
from lipcore.robots.library import Robot, pinocchio
from service.contract.observations import LearningOptions

MODEL, FORGETTING_S = "adapts", 30.0
PRIOR = 1.0
"""Prior standard deviation of each of a link's ten parameters around the URDF's, kg, kg·m or kg·m²; not tuned."""
Unseen = tuple[Samples, Array]


@dataclass
class Rival:
    """Another method, and its answers by s after the pick-up; a text is the reason for no answer."""

    label: str
    answers: dict[float, Answers | str] = field(default_factory=dict)


def rivals(arm: Arm, model: TorqueModel, case: Case) -> list[Rival]:
    """Evaluate all methods on the stream of one case, and the same test motion with the payload."""
    samples, unseen = arm.live(case), arm.unseen(case, True)
    return [
        Rival("adapts (payloads=false, on_change=adapt)", dict(_adapting(model, samples, unseen))),
        Rival("full refit on the rows since", _each(samples, lambda since: _refitted(arm, since, unseen))),
        Rival("least squares around the URDF", _each(samples, lambda since: _least_squares(arm.robot, since, unseen))),
    ]


def _each(samples: Samples, answer: Callable[[Samples], Answers | str]) -> dict[float, Answers | str]:
    """Evaluate a method on the rows since the pick-up; the time of the pick-up is given."""
    first = round(UP * RATE)
    return {after: answer(samples.rows(slice(first, first + round(after * RATE)))) for after in AFTER}


def _adapting(model: TorqueModel, samples: Samples, unseen: Unseen) -> dict[float, Answers]:
    """Evaluate the service without payload detection, after it has learnt all rows sent."""
    options = LearningOptions(
        payloads=False, on_change="adapt", forgetting_s=FORGETTING_S, auto_refresh=False, auto_promote=False
    )
    out = {}
    moments = {round((UP + after) * RATE): after for after in AFTER}
    with tempfile.TemporaryDirectory(prefix="lipserve-bench-") as folder:
        lipcore.save(model, Path(folder) / "model")
        install(Path(folder) / "home", Path(folder) / "model", {MODEL: options}, model.n_joints)
        with serving(Path(folder) / "home") as bed, HttpClient(bed.tcp) as client:
            for number, start in enumerate(range(0, max(moments), BATCH)):
                batch = samples.rows(slice(start, start + BATCH))
                ack = send(client, batch_request(MODEL, STREAM, number, batch))
                if (after := moments.get(start + BATCH)) is not None:
                    motion = np.stack([batch.q[-1], batch.dq[-1], batch.ddq[-1]])
                    bed.wait_learnt(MODEL, motion, ack.revision)
                    out[after] = evaluate_served(bed, MODEL, unseen)
    return out


def _refitted(arm: Arm, since: Samples, unseen: Unseen) -> Answers | str:
    """Evaluate a model trained on these rows only."""
    try:
        model = lipcore.train(since, arm.robot.joint_types, "rigid-body")
    except (ValueError, ArithmeticError, RuntimeError) as error:
        return f"refused: {error}"
    exact, measured = unseen
    answer = model.predict(exact.q, exact.dq, exact.ddq)
    return evaluate_answers(exact, measured, *answer.interval)


def _least_squares(robot: Robot, since: Samples, unseen: Unseen) -> Answers:
    """Evaluate ridge regression of every link's ten parameters around the URDF's.

    It equals recursive least squares with the prior N(π₀, PRIOR² I) and torque Y π with noise of NOISE.
    """
    exact, measured = unseen
    usual = np.concatenate([body.toDynamicParameters() for body in list(robot.model.inertias)[1:]])
    rows = _regressor(robot, since)
    precision = rows.T @ rows / NOISE**2 + np.eye(len(usual)) / PRIOR**2
    residual = since.tau.ravel() - rows @ usual
    mean = usual + np.linalg.solve(precision, rows.T @ residual / NOISE**2)
    queried = _regressor(robot, exact)
    spread = np.einsum("ij,ij->i", queried, np.linalg.solve(precision, queried.T).T)
    tau, std = (queried @ mean).reshape(exact.tau.shape), np.sqrt(spread).reshape(exact.tau.shape)
    return evaluate_answers(exact, measured, tau, std, np.full(robot.n_joints, NOISE), 1.0)


def _regressor(robot: Robot, samples: Samples) -> Array:
    """Return Pinocchio's joint-torque regressor of N states, (N n, 10 n)."""
    pin, data = pinocchio(), robot.model.createData()
    motions = zip(samples.q, samples.dq, samples.ddq, strict=True)
    return np.concatenate(
        [
            pin.computeJointTorqueRegressor(robot.model, data, robot.configuration(q), dq, ddq).copy()
            for q, dq, ddq in motions
        ]
    )
