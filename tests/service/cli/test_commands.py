"""The command line: what it prints, writes and says where it cannot go on."""

from __future__ import annotations

import json

import numpy as np
import pytest

from lipcore.robots.library import ROBOTS
from lipcore.robots.simulation import Payload
from service import __version__
from service.cli.main import Commands
from service.datasets.formats.opening import open_table
from service.datasets.options import ReadOptions
from service.foundation.settings import Settings
from tests.service.cli.conftest import QUICKLY
from tests.service.data import arrays, stream
from tests.service.server import free_port


def test_version(lipserve):
    assert lipserve("--version") == (0, f"{__version__}\n", "")


def test_help_lists_the_commands(lipserve):
    code, said, _ = lipserve("--help")
    assert code == 0
    for command in Commands.entries:
        assert f"{command} " in said


def read(path):
    """A written recording as it was uploaded: columns by canonical name."""
    with open_table(path, None, ReadOptions(), Settings()) as table:
        rows = np.concatenate(list(table.blocks))
        return table, dict(zip(table.names, rows.T, strict=True))


@pytest.mark.parametrize("ending", ["csv", "npz"])
def test_simulated_streams_are_read_back_equal(lipserve, tmp_path, ending):
    path = tmp_path / f"stream.{ending}"
    code, said, _ = lipserve("simulate", "double-pendulum", path, "--samples", 50, "--seed", 3, "--rate", 20)
    assert code == 0
    assert "50 samples of joint1, joint2" in said
    table, found = read(path)
    for name, values in arrays(stream(samples=50, seed=3, rate=20.0, speed=1.0)).items():
        columns = [found[name]] if values.ndim == 1 else [found[f"{name}{joint}"] for joint in (1, 2)]
        np.testing.assert_array_equal(np.squeeze(np.column_stack(columns)), values)
    assert table.joint_names == (None if ending == "csv" else ("joint1", "joint2"))


def test_options_of_the_simulator_matter(lipserve, tmp_path):
    plain, other = tmp_path / "plain.npz", tmp_path / "other.npz"
    lipserve("simulate", "ur5", plain, "--samples", 40)
    options = ("--noise", 0, "--viscous", 2, "--coulomb", 1, "--payload", 3, "--fast", "--motion", "full")
    lipserve("simulate", "ur5", other, "--samples", 40, *options)
    found, before = (
        np.column_stack([read(path)[1][f"tau{joint}"] for joint in range(1, 7)]) for path in (other, plain)
    )
    expected = stream(
        "ur5", 40, 0, speed=10.0, motion="full", noise=0.0, viscous=2.0, coulomb=1.0, payload=Payload(3.0)
    )
    np.testing.assert_array_equal(found, expected.tau)
    assert not np.array_equal(found, before)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("simulate", "r2d2", "x.csv"), f"robot is 'r2d2', expected one of {', '.join(ROBOTS)}"),
        (("simulate", "ur5", "x.parquet"), "expected the ending .csv or .npz"),
        (("simulate", "ur5", "x.csv", "--motion", "wild"), "motion is 'wild'"),
        (("simulate", "ur5", "x.csv", "--noise", "-1"), "noise is -1.0"),
        (("simulate", "ur5", "nowhere/x.csv", "--samples", "40"), "nowhere/x.csv"),
        (("predict", "m", "--q", "1,two,3"), "--q is '1,two,3', expected numbers separated by commas"),
        (("predict", "m", "--q", ""), "--q is ''"),
        (("predict", "m", "--q", "1", "--dq", "x"), "--dq is 'x'"),
        (("serve", "--port", "70000"), "port: Input should be less than or equal to 65535"),
    ],
)
def test_mistakes_are_explained_in_one_line(lipserve, tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    code, said, err = lipserve(*arguments)
    assert (code, said) == (1, "")
    assert err.startswith("error: ")
    assert message in err
    assert err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_nobody_listening_is_said_with_the_remedy(lipserve):
    code, _, err = lipserve("predict", "m", "--q", "1", "--url", f"http://127.0.0.1:{free_port()}")
    assert code == 1
    assert "start one with `lipserve serve`" in err


def test_wrong_environment_is_named(lipserve, monkeypatch):
    monkeypatch.setenv("LIPSERVE_MAX_SAMPLES", "-5")
    code, _, err = lipserve("serve")
    assert code == 1
    assert err.startswith("error: max_samples: ")


def test_from_a_recording_to_a_torque(lipserve, server, tmp_path):
    path = tmp_path / "stream.csv"
    lipserve("simulate", "double-pendulum", path, "--samples", 60, "--fast")
    types = ("--joint-types", "revolute, revolute")
    code, said, err = lipserve("train", path, "--model", "from-cli", "--url", server.url, *types, *QUICKLY)
    assert code == 0, err
    assert "from-cli version 1 is trained and answers" in said

    code, said, _ = lipserve("predict", "from-cli", "--q", "0.1,-0.2", "--url", server.url, "--json")
    assert code == 0
    answer = json.loads(said)
    zero = [0.0, 0.0]
    query = {"q": [0.1, -0.2], "dq": zero, "ddq": zero}
    assert answer == server.client.post("/v1/models/from-cli/predict", json=query).json()

    code, said, _ = lipserve("predict", "from-cli", "--q", "0.1,-0.2", "--url", server.url)
    assert code == 0
    assert "joint1" in said
    assert f"{answer['tau'][1]:.4f}" in said


def test_refusals_of_the_service_are_passed_on(lipserve, server, tmp_path):
    code, _, err = lipserve("predict", "nobody", "--q", "1", "--url", server.url)
    assert code == 1
    said, hint = err.splitlines()
    assert said == "error: no model 'nobody' (not_found, 404)"
    assert hint.startswith("hint: models that exist: ")
    assert "panda-sim" in hint

    path = tmp_path / "bad.csv"
    path.write_text("t,q1,speed1\n0,0,0\n")
    code, _, err = lipserve("train", path, "--model", "m", "--url", server.url)
    assert code == 1
    assert "column tau1 is missing" in err


def test_a_model_name_that_is_refused_is_said(lipserve, server, tmp_path):
    path = tmp_path / "stream.csv"
    lipserve("simulate", "double-pendulum", path, "--samples", 60)
    code, _, err = lipserve("train", path, "--model", "BAD NAME", "--url", server.url)
    assert code == 1
    assert "model is BAD NAME" in err


def test_components_are_printed_beside_the_torque(lipserve, server):
    q, names = [0.0, -0.5, 0.0, -2.0, 0.0, 1.5, 0.7], ["gravity", "inertia_matrix", "potential_energy"]
    query = {"q": q, "dq": [0.0] * 7, "ddq": [0.0] * 7, "components": names}
    expected = server.client.post("/v1/models/panda-sim/predict", json=query).json()["components"]
    motion = ("--q", ",".join(map(str, q)))
    asked = ("predict", "panda-sim", *motion, "--components", ", ".join(names), "--url", server.url)
    code, said, err = lipserve(*asked)
    assert code == 0, err
    for mean, std in (
        (expected["gravity"]["mean"][1], expected["gravity"]["std"][1]),
        (expected["inertia_matrix"]["mean"][2][3], expected["inertia_matrix"]["std"][2][3]),
    ):
        assert f"{mean:.4f} ± {std:.4f}" in said
    assert f"{expected['potential_energy']['mean']:.4f}" in said

    code, said, _ = lipserve(*asked, "--json")
    assert json.loads(said)["components"] == expected
    code, _, err = lipserve(*asked, "--tau", "0,0,0,0,0,0,0")
    assert (code, "tau is given, expected no tau" in err) == (1, True)
