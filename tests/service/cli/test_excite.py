"""`lipserve excite`: what it writes, prints and draws, and what it says where it cannot go on."""

from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

import lipcore
from lipcore.profiles import profile
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Simulation, inverse_dynamics, simulate
from service.cli import excite as command
from service.cli.excite import fetch, find
from tests.service.cli.conftest import lacking
from tests.service.data import QUICK, stream, train, upload
from tests.service.robots.test_robots import urdf
from tests.service.server import free_port

SHORT = ("--seconds", "6", "--rate", "20", "--iterations", "2", "--budget", "1000")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A saved model of a double pendulum, whose joints are called as the robot's."""
    made = lipcore.train(stream(), ("revolute", "revolute"), "lip-chain", lipcore.FitOptions(**QUICK, starts=1))
    path = tmp_path_factory.mktemp("excite") / "model"
    lipcore.save(made, path)
    return path


def excite(*arguments, ok=True):
    """Run the command; what it printed, or the error that it ended with."""
    ended = CliRunner().invoke(command.app, [str(each) for each in arguments])
    if ok:
        assert ended.exit_code == 0, (ended.output, ended.exception)
        return ended.output
    assert ended.exit_code != 0
    return ended.exception


def read(path):
    header = path.read_text().split("\n", 1)[0].split(",")
    values = np.loadtxt(path, delimiter=",", skiprows=1)
    return header, values[:, 0], *np.split(values[:, 1:], 3, axis=1)


@pytest.mark.slow
def test_motion_for_a_saved_model_is_written_plotted_and_described(folder, tmp_path):
    out, plot = tmp_path / "motion.csv", tmp_path / "motion.png"
    reply = excite("--model", folder, "--robot", "double-pendulum", *SHORT, "--out", out, "--plot", plot)
    header, t, q, dq, ddq = read(out)
    assert (header, len(t)) == (["t", "q1", "q2", "dq1", "dq2", "ddq1", "ddq2"], 121)
    np.testing.assert_allclose(np.diff(t), 0.05)
    np.testing.assert_allclose([dq[0], dq[-1], ddq[0], ddq[-1]], 0, atol=1e-9)
    # velocity and acceleration are the derivatives of the position
    np.testing.assert_allclose(np.gradient(q, t, axis=0)[1:-1], dq[1:-1], atol=0.02)
    assert plot.read_bytes().startswith(b"\x89PNG")
    parts = ("joint1", "joint2", "geometric mean", "planned for the model", "2 iterations", str(out), "obstacles")
    assert lacking(reply, *parts) == []


@pytest.mark.slow
def test_motion_without_a_model_stays_within_shares_of_the_limits(tmp_path):
    out = tmp_path / "motion.csv"
    reply = excite("--robot", "asr-twodof", *SHORT, "--range", "0.5", "--scale", "0.4", "--noise", "0.1", "--out", out)
    assert "planned for a rigid-body prior" in reply
    _, _, q, dq, ddq = read(out)
    known = profile("asr-twodof")
    assert (np.abs(q - (known.lower + known.upper) / 2) <= 0.5 * (known.upper - known.lower) / 2 * (1 + 1e-9)).all()
    assert (np.abs(dq) <= 0.4 * known.speed * (1 + 1e-9)).all()
    assert (np.abs(ddq) <= 0.4 * known.speed / 0.25 * (1 + 1e-9)).all()
    assert (np.abs(inverse_dynamics(load_robot("asr-twodof"), q, dq, ddq)) <= 0.4 * known.torque).all()


@pytest.mark.slow
def test_fetched_model_predicts_like_the_served_one(server):
    dataset = upload(server.client, stream())["id"]
    train(server.client, "to-excite", dataset)
    result = fetch("to-excite", server.url)
    query = {name: [0.1, -0.2] for name in ("q", "dq", "ddq")}
    answer = server.client.post("/v1/models/to-excite/predict", json=query).json()
    np.testing.assert_allclose(result.predict(**query).tau[0], answer["tau"], rtol=1e-9)
    np.testing.assert_allclose(result.predict(**query).tau_std[0], answer["tau_std"], rtol=1e-6)


def test_robot_has_the_joints_of_the_model(folder, tmp_path):
    samples = simulate(load_robot("panda"), Simulation(n_samples=20), 0)
    result = find(None, lipcore.train(samples, ("revolute",) * 7, "lip-chain", lipcore.FitOptions(**QUICK, starts=1)))
    assert (result.name, result.limits.joint_names) == ("panda", samples.joint_names)
    np.testing.assert_array_equal(result.limits.acceleration, profile("panda").acceleration)
    path, model = tmp_path / "arm.urdf", lipcore.load(folder)
    path.write_bytes(urdf(kind="revolute", joints=("joint1", "joint2")))
    for given in (None, model):
        result = find(str(path), given)
        assert (result.name, result.limits.joint_names) == ("arm", ("joint1", "joint2"))
        assert result.robot.joint_names == result.bodies.joint_names == ("joint1", "joint2")
    with pytest.raises(ValueError, match="the joints"):
        find(str(path), replace(model, joint_names=("a", "b", "c")))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "give --robot or --model"),
        (("--robot", "r2d2"), "robot is 'r2d2', expected one of panda"),
        (("--robot", "nowhere.urdf"), "nowhere.urdf"),
        (("--robot", "fr3"), "no URDF of robot 'fr3' is installed, so its torques are unknown"),
        (("--robot", "double-pendulum", "--scale", "1.5"), "the share of motion is 1.5"),
        (("--robot", "double-pendulum", "--range", "0"), "the share of position is 0.0"),
        (("--robot", "double-pendulum", "--seconds", "-1"), "seconds is -1.0, expected a positive number"),
        (("--robot", "double-pendulum", "--noise", "0"), "noise_std is 0.0, expected positive numbers"),
        (("--robot", "double-pendulum", "--estimator", "magic"), "estimator is 'magic', expected one of lip"),
        (("--model", "folder", "--robot", "ur5"), "robot 'ur5' has the joints shoulder_pan_joint"),
        (("--model", "empty"), "has no manifest.json: it is not the folder of a saved model"),
        (("--model", "nobody", "--url", f"http://127.0.0.1:{free_port()}"), "start one with `lipserve serve`"),
    ],
)
def test_invalid_arguments_are_explained(folder, tmp_path, monkeypatch, arguments, message):
    (tmp_path / "empty").mkdir()
    (tmp_path / "folder").symlink_to(folder)
    monkeypatch.chdir(tmp_path)
    error = excite(*arguments, "--out", "motion.csv", ok=False)
    assert isinstance(error, (ValueError, OSError, *command.ERRORS))
    assert message in str(error)
    assert not (tmp_path / "motion.csv").exists()
