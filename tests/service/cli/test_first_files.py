"""First files of three users, from file to judged model. Every option that is typed is one that a message printed."""

import re
import shlex

import h5py
import numpy as np
import pandas as pd
import pytest

from tests.service.data import stream
from tests.service.datasets import bag_writers as bags
from tests.service.datasets.bag_writers import ROS1, START
from tests.service.datasets.test_bag_messages import KORTEX, stamped
from tests.service.datasets.test_bag_topics import filled, store_with

ROWS = 1500


def recorded(robot: str, rate: float):
    return stream(robot, ROWS, 1, rate=rate, speed=5.0, noise=0.05, viscous=2.0, coulomb=1.0)


def kinova_bag(path):
    """Joint states with an open gripper and positions within a turn, and the feedback of the base in degrees."""
    samples, feedback, actuator = recorded("ur5", 100.0), "BaseCyclic_Feedback", "kortex_driver/msg/ActuatorFeedback"
    store = store_with(f"kortex_driver/msg/{feedback}", KORTEX, ROS1)
    names = [*(f"joint_{j}" for j in range(1, 7)), "finger_joint"]
    with bags.rosbag1.Writer(path) as writer:
        states = writer.add_connection("/my_gen3/joint_states", bags.JOINT_STATE, typestore=ROS1)
        base = writer.add_connection("/my_gen3/base_feedback", f"kortex_driver/msg/{feedback}", typestore=store)
        for t, *row in zip(samples.t, samples.q, samples.dq, samples.tau, strict=True):
            time = START + round(t * 1e9)
            wrapped = (row[0] + np.pi) % (2 * np.pi) - np.pi
            values = [np.append(each, last) for each, last in zip((wrapped, *row[1:]), (0.1, 0, 0), strict=True)]
            state = stamped(time) | {"name": names} | dict(zip(bags.QUANTITIES, values, strict=True))
            message = ROS1.serialize_ros1(filled(ROS1, bags.JOINT_STATE, state), bags.JOINT_STATE)
            writer.write(states, time + 500_000, message)
            parts = [
                filled(store, actuator, {"position": np.degrees(q) % 360, "velocity": np.degrees(dq), "torque": tau})
                for q, dq, tau in np.transpose(row)
            ]
            body = filled(store, base.msgtype, {"actuators": parts})
            writer.write(base, time + 400_000, store.serialize_ros1(body, base.msgtype))


def act_episode(path):
    """The layout of Action Chunking with Transformers: no times, and images."""
    samples = recorded("ur5", 50.0)
    with h5py.File(path, "w") as file:
        file.attrs["sim"] = False
        file["action"] = file["observations/qpos"] = samples.q
        file["observations/qvel"], file["observations/effort"] = samples.dq, samples.tau
        file["observations/images/top"] = np.zeros((ROWS, 4, 4, 3), np.uint8)


def rtde_csv(path):
    """The columns of UR's recorder, separated by blanks: motor currents, and moments that the controller wants."""
    samples = recorded("ur5", 125.0)
    columns = {
        "actual_q": samples.q,
        "actual_qd": samples.dq,
        "target_moment": samples.tau,
        "actual_current": samples.tau / 10,
    }
    table = {f"{name}_{j}": values[:, j] for name, values in columns.items() for j in range(6)}
    pd.DataFrame({"timestamp": 100 + samples.t, **table}).to_csv(path, sep=" ", index=False)


FILES = {
    "kinova.bag": (kinova_bag, [r"--drop \w+"]),
    "episode_0.hdf5": (act_episode, [r"--dt 0\.01"]),
    "rtde.csv": (rtde_csv, ["--effort measured", r"--column '[^']+'"]),
}


@pytest.mark.parametrize("name", FILES)
def test_first_file_becomes_a_judged_model(lipserve, streaming, tmp_path, name):
    def run(*arguments):
        return lipserve(*arguments, "--url", streaming.server.url)

    write, remedies = FILES[name]
    path = tmp_path / name
    write(path)
    model = f"first-{name.partition('.')[0]}".replace("_", "-")
    train = ("train", path, "--model", model, "--estimator", "rigid-body")
    code, _, error = run(*train)
    assert code == 1
    assert f"`lipserve data add {path}`" in error.replace("\n", "")
    for remedy in remedies:
        option = re.search(remedy, error)
        assert option is not None, error
        code, added, refusal = run("data", "add", path, *shlex.split(option[0].replace("0.01", "0.02")))
        assert code == 0, refusal
        assert "rows are used as samples" in added
    code, trained, refusal = run(*train)
    assert code == 0, refusal
    assert re.search(rf"{model} version 1 trained: (now serving|candidate)", trained)
    assert "coverage (95 %)" in trained
