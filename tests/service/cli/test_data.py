"""`lipserve data` and `lipserve simulate`."""

import re
from dataclasses import replace

import numpy as np
import pytest

from lipcore.data.samples import Samples
from lipcore.profiles import profile
from lipcore.robots.dirt import Dirt
from lipcore.robots.library import ROBOTS, profile_urdf
from lipcore.robots.simulation import Payload
from service.cli.simulate import write_recording
from service.datasets.formats.opening import open_table
from service.datasets.mapping.mapping import map_columns
from service.datasets.options import ReadOptions, UploadOptions
from service.foundation.settings import Settings
from tests.service.cli.conftest import lacking
from tests.service.data import arrays, ended, stream


def read(path):
    """Read a written recording like an upload; return the table and its columns by name."""
    with open_table(path, None, ReadOptions(), Settings()) as table:
        rows = np.concatenate(list(table.blocks))
        return table, dict(zip(table.names, rows.T, strict=True))


WORDS = {"q": "position", "dq": "velocity", "ddq": "acceleration", "tau": "torque"}


@pytest.mark.parametrize("ending", ["csv", "npz"])
def test_simulated_recordings_are_read_back_unchanged(lipserve, tmp_path, ending):
    path = tmp_path / f"stream.{ending}"
    code, out, _ = lipserve("simulate", "double-pendulum", path, "--samples", 50, "--seed", 3, "--rate", 20)
    assert code == 0
    assert "50 samples of joint1, joint2" in out
    table, seen = read(path)
    for name, values in arrays(stream(samples=50, seed=3, rate=20.0, speed=1.0)).items():
        pattern = f"joint{{}}/{WORDS.get(name)}" if ending == "csv" else f"{name}{{}}"
        columns = [seen[name]] if values.ndim == 1 else [seen[pattern.format(joint)] for joint in (1, 2)]
        np.testing.assert_array_equal(np.squeeze(np.column_stack(columns)), values)
    assert table.joint_names == (None if ending == "csv" else ("joint1", "joint2"))


@pytest.mark.parametrize(
    ("robot", "options", "expected"),
    [
        (
            "ur5",
            "--samples 40 --noise 0 --viscous 2 --coulomb 1 --payload 3 --fast --motion full",
            {"speed": 10.0, "motion": "full", "noise": 0.0, "viscous": 2.0, "coulomb": 1.0, "payload": Payload(3.0)},
        ),
        (
            "double-pendulum",
            "--samples 20 --rate 20 --course rests --dirt 0.5",
            {"rate": 20.0, "speed": 1.0, "course": "rests", "dirt": Dirt().scaled(0.5)},
        ),
        (
            "double-pendulum",
            "--samples 20 --rate 20 --dirt 1 --drive maxwell",
            {"rate": 20.0, "speed": 1.0, "dirt": Dirt(drive="maxwell")},
        ),
    ],
)
def test_simulation_options_have_effect(lipserve, tmp_path, robot, options, expected):
    assert lipserve("simulate", robot, tmp_path / "other.npz", *options.split())[0] == 0
    columns = read(tmp_path / "other.npz")[1]
    tau = stream(robot, int(options.split()[1]), 0, **expected).tau
    np.testing.assert_array_equal(np.column_stack([columns[f"tau{joint + 1}"] for joint in range(tau.shape[1])]), tau)


@pytest.mark.parametrize("robot", ROBOTS)
def test_simulated_recordings_have_the_joint_names_of_the_robot(tmp_path, robot):
    names, moved = ROBOTS[robot].free, np.linspace(0.0, 1.0, 3 * len(ROBOTS[robot].free)).reshape(3, -1)
    path, times = tmp_path / "named.csv", np.arange(3.0)
    write_recording(path, Samples(names, times, np.zeros(3, np.int64), moved, moved, moved, moved))
    table, _ = read(path)
    for known in (None, profile(robot)):
        columns = map_columns(table.names, table.units, table.joint_names, UploadOptions(), known, len(names))
        assert (columns.joints, columns.unused, columns.torque.effort) == (names, (), "measured")


@pytest.mark.slow
def test_same_recording_gives_the_same_data_set(run_command, recording, tmp_path):
    path, again = recording(75, "twice.csv"), tmp_path / "elsewhere" / "twice.csv"
    again.parent.mkdir()
    again.write_bytes(path.read_bytes())
    first = run_command("data", "add", path, "--json")["id"]
    assert run_command("data", "add", again, "--json")["id"] == first
    for options in (("--cutoff", 3, "--filtering", "always"), ("--name", "another")):
        assert run_command("data", "add", path, *options, "--json")["id"] != first
    run_command("data", "delete", first, "--yes")
    assert run_command("data", "add", path, "--json")["id"] != first  # the deleted data set is not reused


@pytest.mark.slow
def test_file_is_found_as_its_existing_data_set(run_command, run_rejected_command, server, recording):
    path = recording(90, "read-before.csv", samples=60)
    made = run_command("data", "add", path, "--name", "otherwise", "--joint-names", "shoulder,elbow", "--json")
    job = run_command("train", path, "--model", "cli-of-file", "--estimator", "se", "--no-wait", "--json")
    assert job["datasets"] == [made["id"]]
    server.client.post(f"/v1/jobs/{job['id']}/cancel")
    assert ended(server.client, job["id"])["state"]
    assert "are shoulder, elbow" in run_rejected_command("evaluate", "panda-sim", path)
    run_command("data", "add", path, "--name", "plain")
    assert "are joint1, joint2" in run_rejected_command("evaluate", "panda-sim", path)  # the newest reading
    again = run_command("data", "add", made["id"], "--joint-names", "a,b", "--json")
    assert "are a, b" in run_rejected_command("evaluate", "panda-sim", path)
    assert again["report"]["upload_sha256"] == made["report"]["upload_sha256"]


@pytest.mark.slow
def test_data_sets_can_be_given_by_name(run_command, run_rejected_command, arm, recording):
    path = recording(76, "by-name.csv")
    made = run_command("data", "add", path, "--name", "by name", "--json")
    assert run_command("data", "show", "by name", "--json") == made
    assert run_command("evaluate", arm[0], "by name", "--json")["dataset"] == made["id"]
    other = run_command("data", "add", path, "--name", "by name", "--cutoff", 3, "--filtering", "always", "--json")
    assert run_command("data", "show", "by name", "--json") == other  # the newest reading of this file
    message = run_rejected_command("data", "delete", "by name", "--yes")
    assert f"Use one of their ids: {other['id']}, {made['id']}" in message
    run_command("data", "delete", made["id"], "--yes")
    assert run_command("data", "delete", "by name", "--yes", "--json") == {"deleted": ["by name"]}
    assert "no dataset 'by name'" in run_rejected_command("evaluate", arm[0], "by name")


def test_upload_errors_name_command_line_options(run_rejected_command, recording):
    path, samples = recording(77, "in-degrees.csv", samples=60), stream(seed=77, samples=60)
    for factor, message in (
        (50 * 180 / np.pi, "Set --unit q=deg if these are degrees, or --unit q=rad if the joint turns this far"),
        ([1.0, 0.0], "Leave out locked joints with --drop joint2"),
    ):
        write_recording(path, replace(samples, q=samples.q * factor))
        assert f"{message} (invalid_data" in run_rejected_command("data", "add", path)
    hint = run_rejected_command("train", path, "--model", "never").splitlines()[-1]
    assert f"upload it with `lipserve data add {path}`, which has options for reading" in hint


@pytest.fixture
def flat(tmp_path):
    """Files without column names (positions.txt, velocities.txt, torques.txt), and their samples."""
    samples = stream(seed=78, samples=60, rate=50.0)
    files = {
        tmp_path / f"{name}.txt": each for name, each in (("positions", "q"), ("velocities", "dq"), ("torques", "tau"))
    }
    for path, quantity in files.items():
        np.savetxt(path, getattr(samples, quantity))
    return list(files), samples


def test_join_makes_one_data_set_of_several_files(run_command, run_rejected_command, flat):
    files, samples = flat
    command = ("data", "add", *files, "--join", "--dt", 0.02, "--filtering", "never", "--json")
    made = run_command(*command)
    assert (made["name"], made["report"]["rows_uploaded"]) == ("positions+velocities+torques", 60)
    assert made["report"]["derived"] == ["ddq"]
    assert made["report"]["ranges"]["tau"]["max"] == pytest.approx(samples.tau.max(0), rel=0.05)
    assert run_command(*command)["id"] == made["id"]
    message, hint = run_rejected_command("data", "add", *files, "--dt", 0.02).splitlines()
    assert "Or set --columns t,q1..q7,tau1..tau7 (invalid_data" in message
    assert hint == "hint: if the files are parts of one recording, add --join"
    files[2].write_text("\n".join(files[2].read_text().splitlines()[:50]))
    message = run_rejected_command("data", "add", *files, "--join")
    assert "torques.txt is a table of 50 rows, expected 60 rows, like positions.txt" in message


def test_columns_option_names_tables_without_header(run_command, run_rejected_command, tmp_path):
    samples = stream(seed=79, samples=60, rate=50.0)
    path, table = tmp_path / "bare.csv", np.column_stack([samples.t, samples.q, samples.dq, samples.ddq, samples.tau])
    np.savetxt(path, table, delimiter=",")
    made = run_command("data", "add", path, "--columns", "t,q1..q2,dq1..dq2,ddq1..2,tau1,tau2", "--json")
    assert made["report"]["rows"] == 60
    assert made["report"]["ranges"]["q"]["max"] == pytest.approx(samples.q.max(0))
    for columns, problem in (("t,q1..q2", "3 names, expected 9"), ("q5..q1", "q5..q1, expected a range")):
        assert f"--columns is {problem}" in run_rejected_command("data", "add", path, "--columns", columns)


def test_upload_prints_its_report(run_command, recording):
    path = recording(72, "two-joints.csv", samples=600, rate=100.0)
    options = ("--joint-names", "shoulder,elbow", "--filtering", "always", "--rate", 50)
    parts = ("two-joints.csv", "low-passed at 4 Hz", "shoulder", "Coulomb", "in 1 episode, at", "; 0 gaps")
    assert lacking(run_command("data", "add", path, *options), *parts) == []


def test_added_data_set_is_listed_shown_and_deleted(run_command, run_rejected_command, recording):
    paths = [recording(84, name) for name in ("a.csv", "b.csv")]
    options = ("--name", "monday", "--column", "q={joint}/position", "--unit", "t=s")
    added = run_command("data", "add", paths[0], *options, "--json")
    assert added["name"] == "monday"
    assert next(line for line in run_command("data", "list").splitlines() if added["id"] in line).count("monday") == 1
    assert run_command("data", "show", added["id"], "--json") == added
    assert added in run_command("data", "list", "--json")
    made = [each["id"] for each in run_command("data", "add", *paths, "--json")]
    assert run_command("data", "delete", *made, "--yes", "--json") == {"deleted": made}
    assert f"no dataset '{made[0]}'" in run_rejected_command("data", "show", made[0])
    assert "effort" in run_rejected_command("data", "add", paths[0], "--effort", "volts")
    assert "--unit must have the form NAME=VALUE" in run_rejected_command("data", "add", paths[0], "--unit", "deg")


def test_urdf_file_of_a_robot_is_uploaded_once(run_command, recording, tmp_path):
    path = tmp_path / "mine.urdf"
    text = re.sub("<robot[^>]*>", '<robot name="mine">', profile_urdf("double-pendulum"), flags=re.DOTALL)
    path.write_text(text)
    for seed in (5, 6):
        report = run_command("data", "add", recording(seed), "--robot", path, "--json")["report"]
        assert report["robot"] == "mine"
    assert [each["name"] for each in run_command("robots", "list", "--json")["uploaded"]].count("mine") == 1
