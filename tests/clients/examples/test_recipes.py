"""Recipes for robots, compiled against stubs of their libraries: right torques, limits and stops."""

import re
import shutil
import subprocess
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

import lipcore
from tests import ROOT
from tests.clients.examples.recipes import EXAMPLES, STUBS, Law, build, move_and_return, play
from tests.docs.test_pages import parse
from tests.lipcore.export.models import train_arm

JOINTS = [f"panda_joint{k}" for k in range(1, 8)]
POSTURE = np.array([0.1, -0.1, 0.0, -1.8, 0.2, 1.6, 0.3])
FRANKA = Law(
    max_torque=np.array([43.0] * 4 + [6.0] * 3),
    max_rate=np.full(7, 900.0),
    stiffness=np.array([200.0, 200.0, 200.0, 200.0, 80.0, 50.0, 20.0]),
    damping=np.array([20.0, 20.0, 20.0, 20.0, 8.0, 5.0, 3.0]),
)
UR = Law(
    max_torque=np.array([100.0, 100.0, 50.0, 18.0, 18.0, 18.0]),
    max_rate=np.array([500.0] * 3 + [200.0] * 3),
    stiffness=np.array([600.0, 600.0, 400.0, 100.0, 100.0, 50.0]),
    damping=np.array([40.0, 40.0, 25.0, 5.0, 5.0, 3.0]),
)
FRI = Law(
    max_torque=np.array([20.0, 20.0, 15.0, 15.0, 10.0, 5.0, 5.0]),
    max_rate=np.array([200.0] * 4 + [100.0, 50.0, 50.0]),
    stiffness=np.zeros(7),
    damping=np.zeros(7),
    adds_coriolis=True,
)
ROS = Law(np.full(7, 60.0), np.full(7, 500.0), np.full(7, 50.0), np.full(7, 5.0))


@pytest.fixture(scope="module")
def panda() -> lipcore.TorqueModel:
    return lipcore.load(ROOT / "models/panda-sim")


def cycles(count: int, period: float) -> np.ndarray:
    """Return the time since the last cycle, (N,): none before the first."""
    return np.full(count, period) * (np.arange(count) > 0)


def behind(desired: np.ndarray) -> np.ndarray:
    """Return q and dq of a robot that follows a motion with a small error, (2, N, n)."""
    away = 0.01 * np.sin(0.01 * np.arange(desired.shape[1]))[:, None] * np.linspace(1, 2, desired.shape[2])
    return desired[:2] + np.stack([away - away[0], 0.1 * away])


@pytest.fixture(scope="module")
def franka(panda: lipcore.TorqueModel, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(panda, tmp_path_factory.mktemp("franka"), EXAMPLES / "franka/franka.cpp")


def franka_motion(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return desired motion, measured q and dq, and times since the last cycle."""
    dt = cycles(count, 0.001)
    desired = move_and_return(POSTURE, dt.cumsum())
    return desired, behind(desired), dt


def test_franka_gets_the_torque_without_gravity(franka: Path, panda: lipcore.TorqueModel) -> None:
    desired, measured, dt = franka_motion(2300)
    played = play(franka, np.concatenate(measured, axis=1), "robot", "run", "60")
    assert played.status == 0, played.output
    assert "model an-arm, version 3, revision 7" in played.output
    expected = FRANKA.commands(panda, *measured, desired, dt, len(dt))
    np.testing.assert_allclose(played.commands, expected, atol=1e-9)
    assert np.abs(expected[-1]).max() < 10.0  # gravity alone is 25 N·m
    assert not played.commands[0].any()


def test_franka_stops_when_the_time_is_over(franka: Path) -> None:
    _, measured, _ = franka_motion(300)
    played = play(franka, np.concatenate(measured, axis=1), "robot", "run", "0.1")
    assert played.status == 0
    assert len(played.commands) == 101


@pytest.mark.parametrize(
    ("part", "value", "reason"),
    [
        (0, 3.05, "outside the range of the training"),
        pytest.param(1, -2.5, "outside the range of the training", marks=pytest.mark.slow),
        pytest.param(0, np.nan, "not finite", marks=pytest.mark.slow),
        (1, np.inf, "not finite"),
    ],
)
def test_franka_stops_at_a_state_outside_the_training(
    franka: Path, panda: lipcore.TorqueModel, part: int, value: float, reason: str
) -> None:
    desired, measured, dt = franka_motion(900)
    measured[part, 400:, 2] = value
    played = play(franka, np.concatenate(measured, axis=1), "robot", "run", "60")
    assert played.status == 1
    assert reason in played.output
    count = len(played.commands)
    assert 401 < count < 450  # it fades out in 40 ms, then ends the motion
    expected = FRANKA.commands(panda, *measured, desired, dt, 400)[:count]
    np.testing.assert_allclose(played.commands, expected, atol=1e-9)
    assert not played.commands[-1].any()


def test_franka_clips_torque_and_rate(franka: Path, panda: lipcore.TorqueModel) -> None:
    desired, measured, dt = franka_motion(1500)
    measured[0, 1000:] -= 0.9  # a step that no motor makes: the stub rejects torques that Franka rejects
    played = play(franka, np.concatenate(measured, axis=1), "robot", "run", "60")
    assert played.status == 0, played.output
    np.testing.assert_allclose(played.commands, FRANKA.commands(panda, *measured, desired, dt, len(dt)), atol=1e-9)
    assert (np.abs(played.commands).max(axis=0) <= FRANKA.max_torque).all()
    assert np.abs(played.commands[-1, :4]).max() == 43.0
    steps = np.abs(np.diff(played.commands, axis=0)).max(axis=0)
    assert (steps <= 0.9 + 1e-12).all()
    assert steps.max() > 0.89


def test_franka_records_what_the_service_reads(franka: Path) -> None:
    _, measured, _ = franka_motion(50)
    tau = np.random.default_rng(1).uniform(-10, 10, (50, 7))
    path = franka.with_name("recording.csv")
    played = play(franka, np.concatenate([*measured, tau], axis=1), "robot", "record", str(path), "0.02")
    assert played.status == 0, played.output
    names = path.read_text().splitlines()[0].split(",")
    assert names == ["t", *(f"{name}{k}" for name in ("q", "dq", "tau") for k in range(1, 8))]
    rows = np.loadtxt(path, delimiter=",", skiprows=1)
    assert len(rows) == 21
    np.testing.assert_allclose(rows[:, 0], 0.001 * np.arange(21), atol=1e-9)
    np.testing.assert_allclose(rows[:, 1:], np.concatenate([*measured, tau], axis=1)[:21], rtol=1e-11)


@pytest.fixture(scope="module")
def six() -> lipcore.TorqueModel:
    return train_arm("RRRRRR", 50)


@pytest.mark.slow
def test_ur_gets_the_torque_without_gravity(six: lipcore.TorqueModel, tmp_path: Path) -> None:
    program, dt = build(six, tmp_path, EXAMPLES / "ur/ur.cpp"), cycles(400, 0.002)
    limits = six.training_range["q"]
    desired = move_and_return(0.5 * (np.array(limits["min"]) + limits["max"]), dt.cumsum())
    measured = behind(desired)
    rows = np.concatenate(measured, axis=1)
    seconds = str(dt.sum() - 0.001)
    played = play(program, rows, "robot", "script", "run", seconds)
    assert played.status == 0, played.output
    expected = UR.commands(six, *measured, desired, dt, len(dt))
    np.testing.assert_allclose(played.commands[:-1], expected[:-1], atol=1e-9)
    assert not played.commands[-1].any()  # the end of torque control
    lost = play(program, rows, "robot", "script", "run", "60")
    assert (lost.status, "connection is lost" in lost.output) == (1, True)
    old = play(program, rows, "robot", "script", "run", "1", POLYSCOPE="5.22.1")
    assert (old.status, old.commands.size) == (1, 0)
    rows[100:, 3] = np.nan
    stopped = play(program, rows, "robot", "script", "run", "60")
    assert (stopped.status, "not finite" in stopped.output) == (1, True)
    np.testing.assert_allclose(stopped.commands[:100], expected[:100], atol=1e-9)
    assert len(stopped.commands) < 150
    assert not stopped.commands[-2:].any()


@pytest.mark.slow
def test_fri_overlay_is_inertia_and_friction(panda: lipcore.TorqueModel, tmp_path: Path) -> None:
    program, dt = build(panda, tmp_path, EXAMPLES / "kuka_fri/fri.cpp"), cycles(900, 0.001)
    planned = move_and_return(POSTURE, 0.001 * np.arange(900))[0]
    velocity = np.diff(planned, axis=0, prepend=planned[:1]) / 0.001
    desired = np.stack([planned, velocity, np.diff(velocity, axis=0, prepend=velocity[:1]) / 0.001])
    measured = behind(desired)
    tau = np.random.default_rng(1).uniform(-10, 10, planned.shape)
    rows = np.concatenate([measured[0], planned, tau], axis=1)
    path = tmp_path / "recording.csv"
    played = play(program, rows, str(path))
    assert played.status == 0, played.output
    expected = FRI.commands(panda, *measured, desired, dt, len(dt))
    np.testing.assert_allclose(played.commands, expected, atol=1e-6)
    recorded = np.loadtxt(path, delimiter=",", skiprows=1)[1:]  # the first row is of monitoring
    np.testing.assert_allclose(recorded[:, 0], 0.001 * np.arange(900), atol=1e-9)
    np.testing.assert_allclose(recorded[:, 1:], rows[:, [*range(7), *range(14, 21)]], rtol=1e-11)
    rows[500:, 1] = 2.5
    stopped = play(program, rows)
    np.testing.assert_allclose(stopped.commands[:500], expected[:500], atol=1e-6)
    assert not stopped.commands[560:].any()
    assert "outside the range of the training: no overlay" in stopped.output


@pytest.fixture(scope="module")
def controller(panda: lipcore.TorqueModel, tmp_path_factory: pytest.TempPathFactory) -> Path:
    source = EXAMPLES / "ros2_control/src/feedforward_controller.cpp"
    return build(panda, tmp_path_factory.mktemp("ros2_control"), source, STUBS / "drive_controller.cpp")


@pytest.mark.parametrize("adds_gravity", [True, False])
def test_ros2_controller_writes_efforts(adds_gravity: bool, panda: lipcore.TorqueModel, controller: Path) -> None:
    program, dt = controller, cycles(600, 0.001)
    desired = move_and_return(POSTURE, dt.cumsum())
    measured = behind(desired)
    rows = np.concatenate([*measured, *desired], axis=1)
    law = Law(ROS.max_torque, ROS.max_rate, ROS.stiffness, ROS.damping, adds_gravity)
    arguments = ("true" if adds_gravity else "false", *JOINTS)
    played = play(program, rows, *arguments)
    assert played.status == 0, played.output
    expected = law.commands(panda, *measured, desired, dt, len(dt))
    np.testing.assert_allclose(played.commands, expected, atol=1e-9)
    assert (np.abs(played.commands[0]).max() > 20.0) == (not adds_gravity)
    rows[300:, 7] = np.nan
    stopped = play(program, rows, *arguments)
    assert (stopped.status, "deactivated" in stopped.output) == (1, True)
    assert len(stopped.commands) < 400
    np.testing.assert_allclose(stopped.commands[:300], expected[:300], atol=1e-9)
    held = law.commands(panda, *measured, desired, dt, 300)[len(stopped.commands) - 1]
    np.testing.assert_allclose(stopped.commands[-1], held, atol=1e-9)  # gravity of the last good posture, or nothing
    wrong = play(program, rows, "true", *reversed(JOINTS))
    assert (wrong.status, "joints are not those of the model" in wrong.output) == (3, True)


@pytest.mark.slow
def test_ros2_package_builds_with_cmake(controller: Path, tmp_path: Path) -> None:
    """Check targets, plugin and manifest with stub packages instead of ROS."""
    if shutil.which("cmake") is None:
        pytest.skip("cmake is not installed")
    package = EXAMPLES / "ros2_control"
    made = {"ament_cmake": "macro(ament_package)\nendmacro()\n"}
    for name in ("controller_interface", "hardware_interface", "pluginlib"):
        made[name] = (
            f"add_library({name}::{name} INTERFACE IMPORTED)\n"
            f'target_include_directories({name}::{name} INTERFACE "{STUBS}")\n'
        )
    made["pluginlib"] += "macro(pluginlib_export_plugin_description_file)\nendmacro()\n"
    for name, text in made.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / f"{name}-config.cmake").write_text(text)
    options = [f"-DMODEL={controller.parent}", *(f"-D{name}_DIR={tmp_path / name}" for name in made)]
    for command in (
        ["cmake", "-S", package, "-B", tmp_path / "build", *options],
        ["cmake", "--build", tmp_path / "build"],
    ):
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
    assert (tmp_path / "build/liblipserve_feedforward.so").exists()
    manifest = ElementTree.parse(package / "package.xml").getroot()
    assert {each.text for each in manifest.iter("depend")} == made.keys() - {"ament_cmake"}
    plugin = ElementTree.parse(package / "feedforward_plugin.xml").getroot()
    assert plugin.get("path") == manifest.findtext("name")


@pytest.mark.parametrize("name", ["franka", "ur", "kuka_fri", "ros2_control"])
def test_readmes_are_short_and_their_commands_exist(name: str) -> None:
    text = (EXAMPLES / name / "README.md").read_text("utf-8")
    assert len(text.split()) <= 200
    found = re.findall(r"lipserve (?:[a-z]+ )+[^`&,;]*", text.replace("\n", " "))
    assert len(found) >= 2
    for line in found:
        words = line.split()
        if "--" not in line and len(words) <= 2:
            continue
        parse(line)
