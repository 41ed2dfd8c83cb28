"""Arms of tests of the layout: few and many joints, long names, each trained from a short recording."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import httpx
import numpy as np

from lipcore.data.samples import Samples
from lipcore.robots.library import Robot, pinocchio
from lipcore.robots.simulation import Simulation, simulate
from tests.service.data import QUICK, stream, train, upload

TURNTABLE = ("motorised_turntable_of_the_test_bench",)
CRANE = (
    "slewing_bearing",
    "boom_luffing_cylinder",
    "boom_folding_cylinder",
    "telescopic_extension_rotator",
    "gripper_yaw",
    *(f"wrist_{number}_of_the_dexterous_manipulator" for number in range(1, 7)),
    "J12",
)
"""Twelve names without a common part, short and long."""
_LINK = (
    '<link name="{0}"><inertial><origin xyz="0 0 0.1"/><mass value="1"/>'
    '<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>'
)
_JOINT = (
    '<joint name="{0}" type="revolute"><parent link="{1}"/><child link="{2}"/><origin xyz="0 0 0.2"/>'
    '<axis xyz="{3}"/><limit lower="-3" upper="3" effort="50" velocity="3"/></joint>'
)


@dataclass(frozen=True)
class Arm:
    """A trained model and what it was trained from."""

    model: str
    samples: Samples
    dataset: str
    """Id of its data set."""
    job: str
    """Id of the job of its newest version."""


def urdf(name: str, joints: tuple[str, ...]) -> str:
    """Return the URDF of a chain whose axes turn by 90 degrees from joint to joint."""
    links = [_LINK.format(f"link_{number}") for number in range(len(joints) + 1)]
    axes = ("0 1 0", "1 0 0", "0 0 1")
    made = [
        _JOINT.format(joint, f"link_{at}", f"link_{at + 1}", axes[at % len(axes)]) for at, joint in enumerate(joints)
    ]
    return f'<robot name="{name}">{"".join(links + made)}</robot>'


def chain(client: httpx.Client, model: str, joints: tuple[str, ...], versions: int = 1) -> Arm:
    """Train a model of a chain with these joints."""
    text = urdf(model, joints)
    kinematics = pinocchio().buildModelFromXML(text)
    ends = np.full(len(joints), 3.0)
    robot = Robot(model, kinematics, joints, ("revolute",) * len(joints), -ends, ends, ends)
    made = client.post("/v1/robots", content=text, headers={"content-type": "application/xml"})
    assert made.status_code == 201, made.text
    recorded = [simulate(robot, Simulation(n_samples=400, speed=5.0), seed) for seed in range(versions)]
    return _train(client, model, made.json()["id"], recorded)


def library_arm(client: httpx.Client, robot: str, versions: int = 1) -> Arm:
    """Train a model of an arm of the library, named after it."""
    return _train(client, robot, robot, [stream(robot, samples=400, seed=seed) for seed in range(71, 71 + versions)])


def _train(client: httpx.Client, model: str, robot: str, recorded: list[Samples]) -> Arm:
    request: dict[str, Any] = {"estimator": "rigid-body", "robot": robot, "options": QUICK}
    for number, samples in enumerate(recorded, start=1):
        name = f"{model}, exciting trajectory of day {number}.npz"
        data = upload(client, samples, name=name, robot=robot)["id"]
        job = train(client, model, data, **request, holdout={"kind": "last", "share": 0.3})["id"]
    return Arm(model, recorded[-1], data, job)
