"""ROS 2 node, compiled against the stubs of tests/clients/ros2: published torques and learning."""

import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

import lipcore
from tests.choosing import slow
from tests.clients.cpp.building import COMPILERS, CPP, STRICT, here, sanitizers
from tests.clients.cpp.driver import rows_file, started
from tests.clients.cpp.services import Talk, serving, streaming
from tests.docs.blocks import ROOT
from tests.service import streams
from tests.service.data import DEADLINE, eventually
from tests.service.server import Server

NODE, STUBS = ROOT / "clients/ros2", Path(__file__).with_name("stubs")
JOINTS = [f"panda_joint{k}" for k in range(1, 8)]
PERIOD = 0.002
SOON = 0.1
"""Time to wait if there may be no answer, s."""


def compiled(compiler: str, source: Path, folder: Path, *options: str) -> Path:
    program = folder / f"{source.stem}-{compiler}"
    includes = (f"-I{NODE / 'include'}", f"-I{CPP / 'include'}", f"-I{STUBS}")
    command = [compiler, *STRICT, *options, *includes, source, "-o", program, "-pthread"]
    made = subprocess.run(command, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr
    return program


@pytest.mark.journey
@pytest.mark.parametrize("compiler", [COMPILERS[0], *map(slow, COMPILERS[1:])])
def test_node_compiles_without_warnings(compiler, tmp_path):
    if not here(compiler):
        pytest.skip(f"{compiler} is not installed")
    compiled(compiler, NODE / "src/feedforward.cpp", tmp_path)


def test_package_builds_with_cmake(any_compiler, tmp_path):
    """Check the node's own targets, paths and options, with stub packages instead of ROS."""
    if shutil.which("cmake") is None:
        pytest.skip("cmake is not installed")
    made = {"ament_cmake": "macro(ament_package)\nendmacro()\n"}
    for name in ("rclcpp", "sensor_msgs", "trajectory_msgs"):
        made[name] = (
            f"add_library({name}::{name} INTERFACE IMPORTED)\n"
            f'target_include_directories({name}::{name} INTERFACE "{STUBS}")\n'
            f"set({name}_TARGETS {name}::{name})\n"
        )
    for name, text in made.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / f"{name}-config.cmake").write_text(text)
    options = [f"-DCMAKE_CXX_COMPILER={any_compiler}", f"-DCMAKE_PREFIX_PATH={tmp_path}"]
    options += [f"-D{name}_DIR={tmp_path / name}" for name in made]
    for command in (
        ["cmake", "-S", NODE, "-B", tmp_path / "build", *options],
        ["cmake", "--build", tmp_path / "build"],
        ["cmake", "--install", tmp_path / "build", "--prefix", tmp_path / "out"],
    ):
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
    assert (tmp_path / "out/lib/lipserve_ros2/feedforward").exists()
    manifest = ElementTree.parse(NODE / "package.xml").getroot()
    assert manifest.findtext("name") == "lipserve_ros2"
    assert {each.text for each in manifest.iter("depend")} == made.keys() - {"ament_cmake"}


@pytest.fixture(scope="module", params=["address,undefined", "thread"])
def driven(request, any_compiler, tmp_path_factory) -> Path:
    """Node on an in-process bus, with sanitizers; the last one detects races of its two threads."""
    options = sanitizers(any_compiler, request.param)
    if request.param == "thread" and not options:
        pytest.skip(f"{any_compiler} comes without a sanitizer of threads that runs here")
    folder = tmp_path_factory.mktemp("ros2")
    return compiled(any_compiler, STUBS / "drive.cpp", folder, "-O1", "-g", *options)


class Node:
    """Node driven line by line. parameters: those of the node."""

    def __init__(self, program: Path, motions: np.ndarray, url: str, **parameters: Any) -> None:
        file = rows_file(program, motions, self)
        host, _, port = url.removeprefix("http://").rpartition(":")
        given = {"host": host, "port": port, "period": PERIOD, "deadline_s": DEADLINE, "rows_file": file, **parameters}
        self.process = started(program, given)

    def do(self, line: str) -> dict[str, Any]:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        assert self.process.stderr is not None
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()
        said = self.process.stdout.readline()
        assert said, self.process.stderr.read()
        report: dict[str, Any] = json.loads(said)
        return report

    def end(self) -> str:
        """Stop the node and return its log."""
        _, errors = self.process.communicate("end\n", DEADLINE)
        assert self.process.returncode == 0, errors
        return errors

    def __enter__(self) -> "Node":
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait()


def panda_rows(count: int) -> np.ndarray:
    """Return a smooth motion with arbitrary torques, (N, 4, 7)."""
    at = (PERIOD * np.arange(count))[:, None]
    rate = np.linspace(0.5, 1.5, 7)
    rest = np.array([0.1, -0.1, 0.0, -1.8, 0.2, 1.6, 0.3])
    motion = [rest + 0.3 * np.sin(rate * at), 0.3 * rate * np.cos(rate * at), -0.3 * rate**2 * np.sin(rate * at)]
    return np.stack([*motion, np.random.default_rng(50).uniform(-5, 5, (count, 7))], 1)


@pytest.fixture(scope="module")
def panda() -> lipcore.TorqueModel:
    return lipcore.load(ROOT / "models/panda-sim")


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    with Server(tmp_path_factory.mktemp("ros2") / "home", warm=True) as started:
        yield started


PANDA = {"model": "panda-sim", "joints": ",".join(JOINTS)}


def assert_answers(report: dict[str, Any], model: lipcore.TorqueModel, motion: np.ndarray) -> None:
    tau, std = model.answer(motion)
    assert report["answered"], report
    assert report["first"] == JOINTS[0]
    np.testing.assert_allclose(report["tau"], tau, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(report["std"], std, rtol=1e-9)


def test_torques_at_commanded_accelerations(driven, server, panda):
    rows = panda_rows(20)
    with Node(driven, rows, server.url, acceleration="commanded", **PANDA) as node:
        assert not node.do(f"state 0 {SOON}")["answered"]  # none is commanded yet
        node.do("command 0")
        eventually(lambda: node.do(f"state 0 {SOON}")["answered"])
        for number in range(1, 20):
            node.do(f"command {number}")
            assert_answers(node.do(f"state {number} {DEADLINE}"), panda, rows[number, :3])
        assert "receiving answers of panda-sim" in node.end()


@pytest.mark.parametrize("cutoff", [0.0, 20.0])
def test_torques_at_derived_accelerations(driven, server, panda, cutoff):
    rows = panda_rows(40)
    with Node(driven, rows, server.url, cutoff_hz=cutoff, **PANDA) as node:
        eventually(lambda: node.do(f"state 0 {SOON}")["answered"])
        assert_answers(node.do(f"state 0 {DEADLINE}"), panda, np.stack([*rows[0, :2], np.zeros(7)]))
        share = PERIOD / (PERIOD + 1 / (2 * np.pi * cutoff)) if cutoff else 1.0
        expected = np.zeros(7)
        for number in range(1, 40):
            expected = expected + share * ((rows[number, 1] - rows[number - 1, 1]) / PERIOD - expected)
            motion = np.stack([*rows[number, :2], expected])
            assert_answers(node.do(f"state {number} {DEADLINE}"), panda, motion)
        node.end()


def test_measured_torques_are_learnt_in_order(driven, server):
    motions, name = panda_rows(120), f"cell-{driven.parent.name}"
    with Node(driven, motions, server.url, stream=name, flush_s=DEADLINE, **PANDA) as node:
        eventually(lambda: node.do(f"state 0 {SOON}")["answered"])
        begun = node.do("states 0 1")
        for first in range(1, 120, 17):
            node.do(f"states {first} {min(first + 17, 120)}")
        assert node.do(f"state 119 {DEADLINE}")["dropped"] == begun["dropped"]
        said = node.end()
    assert "not acknowledged 0, dropped 0" in said
    (stream,) = re.findall(rf"{name}-\d+-\d+", said)
    # the first state has no acceleration; row 0 has come until the service answered, row 119 once more at the end
    logged = streams.logged_rows(server, stream)
    order = [*range(120), 119]
    for part, name in enumerate(("q", "dq")):
        np.testing.assert_array_equal(getattr(logged, name)[-121:], motions[order, part])
    np.testing.assert_array_equal(logged.tau[-121:], motions[order, 3])
    assert f"sent {len(logged.tau)}, " in said


def test_callbacks_never_wait_for_the_service(driven):
    """The service never answers: the node waits, but its callbacks do not."""

    def silent(talk: Talk) -> None:
        while True:
            talk.request()

    names = {"joint_names": JOINTS, "noise_std": [0.1] * 7}
    rows = panda_rows(5000)
    with serving(streaming(silent, **names)) as url, Node(driven, rows, url, deadline_s=2.0, rows=64, **PANDA) as node:
        node.do("states 0 10")
        report = node.do("states 10 5000")
        assert report["dropped"] >= 4000
        assert report["tau"] == []
        node.end()


def test_model_with_other_joint_names_is_not_used(driven, server):
    other = {"model": "panda-sim", "joints": ",".join(reversed(JOINTS))}
    with Node(driven, panda_rows(3), server.url, **other) as node:
        for number in (0, 1, 2, 0, 1, 2):
            assert not node.do(f"state {number} {SOON}")["answered"]
        assert "joint names differ from the model's: nothing is published" in node.end()
