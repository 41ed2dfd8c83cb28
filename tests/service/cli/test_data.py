"""`lipserve data` and `simulate`: recordings made, brought in, reported on, and deleted."""

import numpy as np
import pytest

from lipcore.robots.dirt import Dirt
from lipcore.robots.simulation import Payload
from service.datasets.formats.opening import open_table
from service.datasets.options import ReadOptions
from service.foundation.settings import Settings
from tests.service.data import arrays, stream


def read(path):
    """A written recording as it was uploaded: columns by canonical name."""
    with open_table(path, None, ReadOptions(), Settings()) as table:
        rows = np.concatenate(list(table.blocks))
        return table, dict(zip(table.names, rows.T, strict=True))


@pytest.mark.parametrize("ending", ["csv", "npz"])
def test_simulated_streams_are_read_back_equal(lipserve, tmp_path, ending):
    path = tmp_path / f"stream.{ending}"
    code, out, _ = lipserve("simulate", "double-pendulum", path, "--samples", 50, "--seed", 3, "--rate", 20)
    assert code == 0
    assert "50 samples of joint1, joint2" in out
    table, seen = read(path)
    for name, values in arrays(stream(samples=50, seed=3, rate=20.0, speed=1.0)).items():
        columns = [seen[name]] if values.ndim == 1 else [seen[f"{name}{joint}"] for joint in (1, 2)]
        np.testing.assert_array_equal(np.squeeze(np.column_stack(columns)), values)
    assert table.joint_names == (None if ending == "csv" else ("joint1", "joint2"))


def test_options_of_the_simulator_matter(lipserve, tmp_path):
    options = ("--noise", 0, "--viscous", 2, "--coulomb", 1, "--payload", 3, "--fast", "--motion", "full")
    assert lipserve("simulate", "ur5", tmp_path / "other.npz", "--samples", 40, *options)[0] == 0
    columns = read(tmp_path / "other.npz")[1]
    physics = {"noise": 0.0, "viscous": 2.0, "coulomb": 1.0, "payload": Payload(3.0)}
    expected = stream("ur5", 40, 0, speed=10.0, motion="full", **physics)
    np.testing.assert_array_equal(np.column_stack([columns[f"tau{joint}"] for joint in range(1, 7)]), expected.tau)
    dirty = ("--samples", 20, "--rate", 20, "--course", "rests", "--dirt", 0.5)
    assert lipserve("simulate", "double-pendulum", tmp_path / "dirty.npz", *dirty)[0] == 0
    columns = read(tmp_path / "dirty.npz")[1]
    expected = stream(samples=20, seed=0, rate=20.0, speed=1.0, course="rests", dirt=Dirt().times(0.5))
    np.testing.assert_array_equal(np.column_stack([columns["tau1"], columns["tau2"]]), expected.tau)


def test_an_upload_prints_its_report(asked, recording):
    path = recording(72, "two-joints.csv", samples=600, rate=100.0)
    options = ("--joint-names", "shoulder,elbow", "--filtering", "always", "--rate", 50)
    text = asked("data", "add", path, *options)
    for part in ("two-joints.csv", "low-passed at 4 Hz", "shoulder", "Coulomb"):
        assert part in text


def test_what_is_added_is_listed_shown_and_deleted(asked, refused, recording):
    paths = [recording(84, name) for name in ("a.csv", "b.csv")]
    options = ("--name", "monday", "--column", "q=q{joint}", "--unit", "t=s")
    added = asked("data", "add", paths[0], *options, "--json")
    assert added["name"] == "monday"
    assert next(line for line in asked("data", "list").splitlines() if added["id"] in line).count("monday") == 1
    assert asked("data", "show", added["id"], "--json") == added
    assert added in asked("data", "list", "--json")
    made = [each["id"] for each in asked("data", "add", *paths, "--json")]
    assert asked("data", "delete", *made, "--yes", "--json") == {"deleted": made}
    assert f"no dataset '{made[0]}'" in refused("data", "show", made[0])
    assert "effort" in refused("data", "add", paths[0], "--effort", "volts")
    assert "--unit is 'deg'" in refused("data", "add", paths[0], "--unit", "deg")
