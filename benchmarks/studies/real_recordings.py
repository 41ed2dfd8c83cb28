"""Real recordings as a user brings them: uploaded, trained on with a part held out, judged on that part.

    python benchmarks/studies/real_recordings.py FOLDER [ESTIMATOR...]

FOLDER holds `panda_exciting_trajectory.db3` and `ur10_exciting_trajectory.db3` (a Franka Panda at 30 Hz and a UR10 at
125 Hz, 24 and 28 s; BSD-3-Clause, github unisa-acg/inverse-dynamics-solver) and `schunk_liu_althoff.npz` (a Schunk arm,
100 episodes at 250 Hz; CC0-1.0, Liu & Althoff, IROS 2018). A service of its own takes them, as `lipserve train` with
`--hold-out 0.3` does; of the Schunk whole episodes are held out, then the last ones, which are other kinds of motion.
`rigid-body (URDF)` is calibrated around the URDF of example-robot-data.

`least squares` is what an engineer has without all this: the inertial parameters and friction of the URDF's arm by
least squares on the same samples, intervals by split conformal prediction, from errors of five parts left out in turn.
`wider by`: its mean width over that of an interval that knows how far the errors spread.
"""

import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lipcore.data.metrics import LEVEL, Metrics, evaluate, quantile
from lipcore.data.samples import Array, Samples
from lipcore.kernels.friction import SIGN_WIDTH
from lipcore.robots.library import pinocchio
from lipcore.robots.urdf import RigidBody
from lipcore.vocabulary import AUTO
from lipserve import Client
from lipserve.asking import Reading
from lipserve.records.datasets import Dataset
from lipserve.states import SUCCEEDED
from service.cli.demo import ServiceProcess
from service.datasets import store
from service.foundation.settings import Settings
from service.storage.storage import Storage
from service.training import holding_out

UR10 = ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint")
WITH_URDF = " (URDF)"
ESTIMATORS = (AUTO, "rigid-body", "rigid-body" + WITH_URDF, "lip-chain")
SHARE = 0.3
RECORDINGS: tuple[tuple[str, str | None, Reading, dict[str, Any]], ...] = (
    ("panda_exciting_trajectory.db3", "panda", Reading(robot="panda"), {}),
    ("ur10_exciting_trajectory.db3", "ur10", Reading(joints=UR10), {}),
    ("schunk_liu_althoff.npz", None, Reading(), {"kind": "episodes"}),
    ("schunk_liu_althoff.npz", None, Reading(), {"kind": "last"}),
)
FOLDS, CUTOFFS = 5, (1e-6, 1e-5, 1e-4, 1e-3, 1e-2)
"""Parts left out in turn; singular values, over the largest, below which directions are left alone: that with the least
errors on parts left out is taken."""


def row(label: str, nmse: Array, rmse: Array, coverage: Array, width: Array) -> str:
    """A row of the table, figures of every joint."""
    figures = (
        " ".join(f"{each:.1e}" for each in nmse),
        " ".join(f"{100 * each:.0f}" for each in coverage),
        " ".join(f"{each:.2g}" for each in width),
        " ".join(f"{each:.1f}" for each in width / (2 * quantile(LEVEL) * rmse)),
    )
    return f"| {label} | " + " | ".join(figures) + " |"


def judge(client: Client, dataset: Dataset, name: str, profile: str | None, holdout: dict[str, Any]) -> dict[str, Any]:
    """Train one estimator on a data set, print how well it answers what was held out, and return its lineage."""
    robot = profile if name.endswith(WITH_URDF) else None
    estimator = name.removesuffix(WITH_URDF)
    asked = {"share": SHARE, **holdout}
    job = client.wait(
        client.train("judged", [dataset.id], estimator, robot=robot, holdout=asked, promotion="always").id
    )
    if job.state != SUCCEEDED or job.version is None:
        raise RuntimeError(f"job {job.id} has {job.state}: {job.error}")
    version = client.version("judged", job.version)
    figures = client.evaluate("judged", dataset.id, part="held_out", version=job.version)
    chosen = f", which chose {version.estimator}" if estimator == AUTO else ""
    columns = figures.nmse, figures.rmse, figures.coverage, figures.interval_width
    print(row(name + chosen, *columns), flush=True)
    for each in (*version.warnings, *figures.warnings):
        print(f"| {name} warns: {each} | | | | |")
    return version.lineage


def regressor(body: RigidBody, samples: Samples) -> Array:
    """Y of τ = Y w, (N, n, k): inertial parameters, rotor inertia, Coulomb and viscous friction and offset."""
    pin, data = pinocchio(), body.model.createData()
    chain = np.argsort(body.order)  # base to tip
    rigid = [
        pin.computeJointTorqueRegressor(body.model, data, *(each[chain] for each in state))[list(body.order)]
        for state in zip(samples.q, samples.dq, samples.ddq, strict=True)
    ]
    own = np.stack([samples.ddq, np.tanh(samples.dq / SIGN_WIDTH), samples.dq, np.ones_like(samples.dq)], axis=2)
    joints = own[:, :, None, :] * np.eye(samples.n_joints)[:, :, None]
    return np.concatenate([np.array(rigid), joints.reshape(*samples.tau.shape, -1)], axis=2)


def least_squares(body: RigidBody, known: Samples, held: Samples) -> Metrics:
    """Figures of least squares on held-out samples, with the finite-sample quantile of errors left out."""
    scale = known.tau.std(axis=0)
    features, parts = regressor(body, known), np.arange(len(known)) * FOLDS // len(known)

    def solved(rows: NDArray[np.bool_], cutoff: float) -> Array:
        wide = (features[rows] / scale[:, None]).reshape(-1, features.shape[2])
        return np.linalg.lstsq(wide, (known.tau[rows] / scale).reshape(-1), rcond=cutoff)[0]

    def left_out(cutoff: float) -> Array:
        each = (known.tau[parts == k] - features[parts == k] @ solved(parts != k, cutoff) for k in range(FOLDS))
        return np.concatenate(list(each))

    cutoff = min(CUTOFFS, key=lambda each: float(np.sum((left_out(each) / scale) ** 2)))
    errors = left_out(cutoff)
    place = int(np.ceil(LEVEL * (len(known) + 1))) - 1
    half = np.sort(np.abs(errors), axis=0)[place]
    answer = regressor(body, held) @ solved(parts >= 0, cutoff)
    return evaluate(held.tau, answer, np.zeros_like(answer), half / quantile(LEVEL))


def compare(home: str, dataset: Dataset, profile: str, lineage: dict[str, Any]) -> None:
    """Print the figures of least squares, on the samples that a version was trained and judged on."""
    storage = Storage.open(Settings(home=Path(home)))
    found = store.find(storage.database, dataset.id)
    samples, split = store.samples(storage.files, found), holding_out.remembered(found, lineage)
    assert split is not None  # as asked for
    parts = split.parts(samples.episode, samples.t)
    storage.database.close()
    body = RigidBody.from_profile(profile, samples.joint_names, ("revolute",) * samples.n_joints)
    figures = least_squares(body, samples.rows(parts.train), samples.rows(parts.held_out))
    columns = figures.nmse, figures.rmse, figures.coverage, figures.width
    print(row("least squares (URDF)", *columns), flush=True)


def main() -> None:
    """Upload every recording, and judge the estimators named, or ESTIMATORS."""
    folder, estimators = Path(sys.argv[1]), sys.argv[2:] or ESTIMATORS
    with tempfile.TemporaryDirectory() as home:
        service = ServiceProcess(0, {"LIPSERVE_HOME": home})
        try:
            with Client(service.url) as client:
                service.wait_ready(client)
                for file, profile, reading, holdout in RECORDINGS:
                    dataset = client.upload(folder / file, **reading)
                    print(f"\n**{file}**, {SHARE:.0%} held out by {holdout.get('kind', AUTO)}\n")
                    print(
                        "| estimator | nMSE, joint by joint | coverage, % | width, N·m | wider by |\n|" + " --- |" * 5
                    )
                    for name in estimators:
                        if profile is not None or not name.endswith(WITH_URDF):
                            lineage = judge(client, dataset, name, profile, holdout)
                    if profile is not None:
                        compare(home, dataset, profile, lineage)
        finally:
            service.stop()


if __name__ == "__main__":
    main()
