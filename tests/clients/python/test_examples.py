"""The examples of the documentation run."""

import importlib.util
import sys
from collections import Counter
from types import ModuleType, SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest

from lipserve import Client, StreamError
from tests import ROOT
from tests.service.data import stream
from tests.service.streams import MOTION

EXAMPLES = ROOT / "docs" / "examples"


def load(name):
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class Scripted:
    """Scripted stream, and robot that records its commands."""

    joints = 2

    def __init__(self, *answers):
        self.answers, self.commanded, self.timeout = list(answers), [], None

    def predict(self, *_, deadline):
        given = self.answers.pop(0)
        if isinstance(given, Exception):
            raise given
        return given

    def desired(self):
        return MOTION

    def own_torque(self, *_):
        return np.array([7.0, 7.0])

    def command(self, tau):
        self.commanded.append(tau.tolist())


def answer(late=False, std=0.1):
    return SimpleNamespace(tau=np.array([1.0, 2.0]), tau_std=np.array([0.1, std]), late=late)


def test_controller_uses_only_certain_and_timely_answers():
    both = Scripted(answer(), answer(late=True), answer(std=5.0), StreamError("slow", "timeout"), answer())
    seen = load("controller").run(both, both, cycles=5)
    assert seen == Counter(used=2, late=1, uncertain=1, timeout=1)
    own = [7.0, 7.0]
    assert both.commanded == [[1.0, 2.0], own, own, own, [1.0, 2.0]]
    assert 0 < both.timeout < 0.002


class Node:
    """Replacement of an rclpy node."""

    given: ClassVar = {}

    def __init__(self, name):
        self.logged, self.values = [], {}

    def declare_parameter(self, name, default):
        self.values[name] = self.given.get(name, default)

    def get_parameter(self, name):
        return SimpleNamespace(value=self.values[name])

    def create_subscription(self, kind, topic, callback, depth):
        self.topic, self.callback = topic, callback

    def get_logger(self):
        return SimpleNamespace(info=self.logged.append, warning=self.logged.append, error=self.logged.append)

    def destroy_node(self):
        pass


@pytest.fixture
def bridge(monkeypatch):
    """The example, with stub modules instead of ROS."""
    for name, members in {
        "rclpy": {"init": lambda: None, "spin": lambda node: None, "try_shutdown": lambda: None},
        "rclpy.node": {"Node": Node},
        "sensor_msgs": {},
        "sensor_msgs.msg": {"JointState": object},
    }.items():
        module = ModuleType(name)
        vars(module).update(members)
        monkeypatch.setitem(sys.modules, name, module)
    return load("ros2_bridge")


def message(names, t, q, dq, tau):
    stamp = SimpleNamespace(sec=int(t), nanosec=round(1e9 * (t % 1)))
    return SimpleNamespace(header=SimpleNamespace(stamp=stamp), name=names, position=q, velocity=dq, effort=tau)


def test_bridge_sends_observations(server, bridge, monkeypatch, tmp_path):
    with Client(server.url) as client:
        client.import_model(client.export("panda-sim", tmp_path / "m.tar"), "bridged", "always")
        monkeypatch.setattr(Node, "given", {"model": "bridged", "url": server.url, "rows": 30})
        node = bridge.Bridge()
        joints = client.version("bridged", 1).joint_names
        s = stream("panda", samples=70, rate=100.0, speed=1.0)
        swapped = ["gripper", *joints[::-1]]
        for row in range(len(s)):
            numbers = [[0.0, *part[row][::-1]] for part in (s.q, s.dq, s.tau)]
            node.callback(message(swapped, 100.0 + s.t[row], *numbers))
        node.callback(message(swapped[1:3], 0.0, [0.0], [0.0], [0.0]))  # of another robot
        node.callback(message(joints, 0.0, [0.0] * 7, [], []))  # without velocity and effort
        node.close()
        assert node.topic == "/joint_states"
        batches = sorted(client.observations("bridged", node.stream_id), key=lambda each: each.sequence)
        assert [each.rows for each in batches] == [30, 30, 10]
        first = client.observation("bridged", node.stream_id, 0, rows=True).observed
        np.testing.assert_allclose(first.q, s.q[: len(first.q)], atol=1e-12)
        np.testing.assert_allclose(first.tau, s.tau[: len(first.tau)], atol=1e-12)
    assert sum("rows learnt" in line for line in node.logged) == 3


def test_bridge_runs_until_it_is_stopped(server, bridge, monkeypatch):
    monkeypatch.setattr(Node, "given", {"model": "panda-sim", "url": server.url})
    bridge.main()
