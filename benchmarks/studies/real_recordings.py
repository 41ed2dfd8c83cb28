"""All estimators on real recordings, trained on one contiguous part and judged on another.

    python benchmarks/studies/real_recordings.py FOLDER [ESTIMATOR...]

FOLDER holds `panda_exciting_trajectory.db3` and `ur10_exciting_trajectory.db3` (a Franka Panda and a UR10,
BSD-3-Clause, github unisa-acg/inverse-dynamics-solver) and `schunk_liu_althoff.npz` (a Schunk arm, CC0-1.0, Liu &
Althoff, IROS 2018). Everything is low-passed at 4 Hz without delay, training and held-out parts apart, and the
acceleration is derived from the velocity. `rigid-body`, `auto` and so on learn the arm from torque alone; `rigid-body
(URDF)` is calibrated around the URDF of example-robot-data.
"""

import sqlite3
import sys
from pathlib import Path

import numpy as np
import torch
from rosbags.typesys import Stores, get_typestore

import lipcore
from lipcore.data.metrics import evaluate
from lipcore.data.samples import Array, Samples
from lipcore.data.signals import differentiate, low_pass
from lipcore.fitting.estimators import ESTIMATORS
from lipcore.model.parameters import report
from lipcore.model.warnings import warnings
from lipcore.robots.urdf import RigidBody
from lipcore.vocabulary import AUTO

PANDA_RATE, UR10_RATE, SHARE = 30.0, 125.0, 0.7
UR10 = ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint")
WITH_URDF = " (URDF)"
SCHUNK_LAST, SCHUNK_FOURTH = 70, 4
KEEP = 20
"""Of the Schunk's 250 Hz every 20th sample: 4 Hz of signal need no more."""


def from_signals(names: tuple[str, ...], rate: float, q: Array, dq: Array, tau: Array) -> Samples:
    """One recording: everything low-passed alike, the acceleration derived from the velocity."""
    q, dq, tau = (low_pass(signal, rate) for signal in (q, dq, tau))
    t = np.arange(len(q)) / rate
    return Samples(names, t, np.zeros(len(q), dtype=np.int64), q, dq, differentiate(dq, rate), tau)


def read_bag(path: Path, rate: float, joints: tuple[str, ...] | None = None) -> tuple[Samples, Samples]:
    """The first 70 % of a trajectory and the rest; read with sqlite3, as there is no metadata.yaml beside it.

    joints: their order from base to tip, where that of the messages is another one.
    """
    store = get_typestore(Stores.ROS2_HUMBLE)
    with sqlite3.connect(f"file:{path}?mode=ro", uri=True) as database:
        rows = database.execute(
            "SELECT m.data FROM messages m JOIN topics t ON t.id = m.topic_id "
            "WHERE t.name = '/joint_states' ORDER BY m.timestamp"
        ).fetchall()
    database.close()
    messages = [store.deserialize_cdr(data, "sensor_msgs/msg/JointState") for (data,) in rows]
    names = tuple(messages[0].name)
    signals = np.array([[getattr(m, key) for m in messages] for key in ("position", "velocity", "effort")])
    if joints is not None:
        signals, names = signals[:, :, [names.index(joint) for joint in joints]], joints
    cut = int(SHARE * signals.shape[1])
    first, rest = (from_signals(names, rate, *part) for part in (signals[:, :cut], signals[:, cut:]))
    return first, rest


def read_schunk(path: Path, held_out: str) -> tuple[Samples, Samples]:
    """Training and held-out episodes: the last 30 of 100 (`last`), or every fourth (`fourth`)."""
    with np.load(path) as file:
        q, dq, tau, episode, rate = file["q"], file["dq"], file["tau"], file["episode"], 1 / float(file["dt"])
    names = tuple(f"joint{k}" for k in range(1, 7))
    parts: dict[bool, list[Samples]] = {True: [], False: []}
    for number in np.unique(episode):
        rows = episode == number
        part = from_signals(names, rate, q[rows], dq[rows], tau[rows]).rows(slice(None, None, KEEP))
        out = number > SCHUNK_LAST if held_out == "last" else number % SCHUNK_FOURTH == 0
        parts[bool(out)].append(part)
    return Samples.concatenate(parts[False]), Samples.concatenate(parts[True])


def judge(title: str, training: Samples, held_out: Samples, estimators: list[str], profile: str | None) -> None:
    """Print a Markdown table: nMSE and coverage of every joint, for every estimator that can be used."""
    n = training.n_joints
    print(f"\n**{title}**: {len(training)} samples given, {len(held_out)} held out\n")
    print("| estimator | fit s | " + " | ".join(f"joint {j + 1}" for j in range(n)) + " |\n|" + " --- |" * (n + 2))
    types = ("revolute",) * n
    for name in estimators:
        if name.endswith(WITH_URDF) and profile is None:
            continue
        bodies = RigidBody.from_profile(profile, training.joint_names, types) if name.endswith(WITH_URDF) else None
        model = lipcore.train(training, types, name.removesuffix(WITH_URDF), robot=bodies)
        if name == AUTO:
            print(f"| {AUTO} chose {model.estimator.name} |" + " |" * (n + 1))
        for warning in warnings(model, report(model.posterior, model.estimator, model.joint_names)):
            print(f"| {name} warns: {warning} |" + " |" * (n + 1))
        answer = model.predict(held_out.q, held_out.dq, held_out.ddq)
        metrics = evaluate(held_out.tau, *answer.interval)
        for figures, label in (
            (metrics.nmse, f"{name}: nMSE"),
            (metrics.coverage, "coverage"),
            (metrics.width, "width"),
        ):
            seconds = f"{float(model.fit['seconds']):.0f}" if "nMSE" in label else ""
            form = "{:.1e}" if "nMSE" in label else "{:.2f}"
            print(f"| {label} | {seconds} | " + " | ".join(form.format(v) for v in figures) + " |", flush=True)


def main() -> None:
    """Judge the estimators named, or all, on both recordings."""
    torch.set_num_threads(1)
    folder, estimators = Path(sys.argv[1]), sys.argv[2:] or [AUTO, *ESTIMATORS, "rigid-body" + WITH_URDF]
    panda, schunk = folder / "panda_exciting_trajectory.db3", folder / "schunk_liu_althoff.npz"
    ur10 = folder / "ur10_exciting_trajectory.db3"
    judge("Franka Panda, last 30 % of 24 s held out", *read_bag(panda, PANDA_RATE), estimators, "panda")
    judge("UR10, last 30 % of 28 s held out", *read_bag(ur10, UR10_RATE, UR10), estimators, "ur10")
    judge("Schunk, last 30 of 100 episodes held out", *read_schunk(schunk, "last"), estimators, None)
    judge("Schunk, every fourth episode held out", *read_schunk(schunk, "fourth"), estimators, None)


if __name__ == "__main__":
    main()
