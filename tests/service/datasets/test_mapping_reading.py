"""Tables become columns on disk in SI units; wrong values are rejected with their row, missing ones are counted."""

import sqlite3
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lipcore.profiles import profile
from service.datasets.formats.opening import open_table
from service.datasets.mapping.reading import read
from service.datasets.mapping.vocabulary import unit_factor
from service.datasets.staging import staging
from service.foundation.errors import InvalidDataError, StorageFullError
from service.foundation.settings import Settings
from service.storage.disk import Disk
from tests.service.datasets.mapping_tables import RATE, Arm, canonical, motion, options, table
from tests.service.training.test_real_data import PANDA, SCHUNK


@pytest.fixture
def limits(tmp_path):
    return Settings(home=tmp_path, max_samples=100_000)


@pytest.fixture
def reading(tmp_path, limits):
    """Return a function that reads columns, each time into a new folder."""

    def once(columns, reply=None, robot=None, block=64, **kwargs):
        folder = tmp_path / f"columns{len(list(tmp_path.iterdir()))}"
        folder.mkdir()
        return read(table(columns, block, **kwargs), folder, reply or options(), robot, limits, Disk(limits))

    return once


def check_rejected(reading, columns, message, field=None):
    """Check the message of a rejection, and the field if one is given."""
    with pytest.raises(InvalidDataError) as caught:
        reading(columns)
    assert message in caught.value.message
    assert field in (None, caught.value.detail[0].field)


def changed(name, row, value):
    """Return canonical columns with one value changed; rows are counted from 1."""
    columns = canonical(motion())
    columns[name] = columns[name].copy()
    columns[name][row - 1] = value
    return columns


def test_columns_are_staged_as_they_were_recorded(reading):
    data = motion()
    result = reading(canonical(data) | {"episode": np.repeat([4.0, 2.0], 100)})
    assert result.staged.quantities == ("q", "dq", "ddq", "tau")
    assert result.staged.joint_names == ("joint1", "joint2")
    for name, values in data.items():
        np.testing.assert_array_equal(result.staged.read("t") if name == "t" else result.staged.table(name), values)
    np.testing.assert_array_equal(result.staged.read("episode"), np.repeat([4.0, 2.0], 100))
    assert (result.facts["effort"], result.torque_convention) == ("measured", "gravity_included")
    assert not result.staged.missing().any()
    assert result.facts["rows_read"] == 200
    assert result.facts["columns"]["q"] == ["q1", "q2"]


@given(block=st.integers(1, 300))
@settings(max_examples=10, deadline=None)
def test_blocks_of_any_size_give_the_same(tmp_path_factory, block):
    data = motion(rows=120)
    columns = canonical(data)
    columns["q1"][5], columns["tau2"][70], columns["t"][60] = np.nan, np.inf, columns["t"][59]
    limits = Settings(home=tmp_path_factory.mktemp("blocks"))
    with staging(limits.home) as folder:
        result = read(table(columns, block), folder, options(), None, limits, Disk(limits))
        assert result.facts["repeated_stamps"] == 1
        assert result.facts["first_repeated_row"] == 61
        assert (result.facts["missing_rows"], result.facts["first_missing_row"]) == (2, 6)
        assert np.flatnonzero(result.staged.missing()).tolist() == [5, 70]
        assert result.staged.rows == 120
        assert np.isnan(result.staged.read("tau2")[70])


@pytest.mark.parametrize(
    ("quantity", "unit"), [("q", "deg"), ("dq", "rpm"), ("ddq", "deg/s^2"), ("tau", "mN·m"), ("t", "ms")]
)
@pytest.mark.parametrize("where", ["header", "file", "upload"])
def test_units_are_converted_from_any_source(reading, quantity, unit, where):
    data = motion()
    columns = canonical(data | {quantity: data[quantity] / unit_factor(quantity, unit)})
    names = [name for name in columns if name.rstrip("0123456789") == quantity]
    if where == "header":
        result = reading({f"{name} [{unit}]" if name in names else name: each for name, each in columns.items()})
    elif where == "file":
        result = reading(columns, units=dict.fromkeys(names, unit))
    else:
        result = reading(columns, options(units={quantity: unit}))
    read_back = result.staged.read("t") if quantity == "t" else result.staged.table(quantity)
    np.testing.assert_allclose(read_back, data[quantity], rtol=1e-13, atol=1e-15)
    assert any(unit in note for note in result.noted)


def test_units_of_the_upload_come_first_and_can_be_given_by_column(reading):
    data = motion()
    columns = {f"{name} [rad]" if name[0] == "q" else name: each for name, each in canonical(data).items()}
    columns["q1 [rad]"], columns["q2 [rad]"] = np.degrees(data["q"][:, 0]), data["q"][:, 1] * 1000
    result = reading(columns, options(units={"q": "deg", "q2 [rad]": "mm"}))
    np.testing.assert_allclose(result.staged.table("q"), data["q"], rtol=1e-13)


def test_seconds_and_nanoseconds_add_up(reading):
    data = motion()
    ticks = np.round((data["t"] + 5) * 1e9)
    columns = {"stamp.sec": ticks // 10**9, "stamp.nanosec": ticks % 10**9, **canonical(data)}
    del columns["t"]
    np.testing.assert_allclose(reading(columns).staged.read("t"), data["t"] + 5, atol=1e-9)


def test_currents_become_torques(reading):
    data = motion()
    columns = canonical(data | {"current_": data["tau"]})
    del columns["tau1"], columns["tau2"]
    result = reading(columns, options(torque_constants=(0.5, -2.0)))
    np.testing.assert_array_equal(result.staged.table("tau"), data["tau"] * [0.5, -2.0])
    turned = reading(columns, options(torque_constants=(0.5, -2.0), torque_factors=(1.0, -1.0)))
    assert (turned.staged.table("tau") == result.staged.table("tau") * [1.0, -1.0]).all()
    assert turned.facts["torque_factors"] == [1.0, -1.0]
    small = reading(columns, options(units={"tau": "mA"}, torque_constants=(1.0, 2.0)))
    np.testing.assert_allclose(small.staged.table("tau"), data["tau"] * [1e-3, 2e-3], rtol=1e-14)
    assert (result.facts["effort"], result.facts["torque_constants"]) == ("current", [0.5, -2.0])
    arm = Arm(("a", "b"), "current", (3.0, 4.0))
    np.testing.assert_array_equal(reading(columns, robot=arm).staged.table("tau"), data["tau"] * [3.0, 4.0])


def test_velocities_without_values_are_ignored(reading):
    columns = canonical(motion())
    columns["dq1"][:] = columns["dq2"][:] = np.nan
    result = reading(columns | {"phase": np.zeros(200), "temp_1": np.ones(200)})
    assert result.staged.quantities == ("q", "ddq", "tau")
    assert "dq has no values and is ignored" in result.noted
    assert not result.staged.missing().any()
    assert "2 columns are not used: phase, temp_1" in result.noted


def with_column(**columns):
    return {**canonical(motion()), **columns}


def scaled(**factors):
    """Return canonical columns with quantities in other units."""
    return canonical({name: each * factors.get(name, 1.0) for name, each in motion(rows=1000).items()})


def without(first, last):
    """Return 200 values, of which some are missing."""
    values = np.cos(np.arange(200.0))
    values[first:last] = np.nan
    return values


MISSING = with_column(tau2=without(50, 200), q1=without(0, 1))
BACK = "expected more than 0.38, the time of the row before"
LOCKED = "constant at 0.25, expected a joint that moves. Leave out locked joints with drop_joints=joint2"
DEGREES = 'radians or metres within ±12.6. Set units={"q": "deg"} if these are degrees'
UNMEASURED = "constant at 0, expected a torque measured while the joint moved. Leave out joints without one"
TOO_FEW = "The file has 29 usable rows, expected at least 30"
NO_TIME = "199 repeat the time of the row before"


@pytest.mark.parametrize(
    ("columns", "field", "message"),
    [
        pytest.param(changed("t", 40, 0.2), "t, row 40", BACK, id="back"),
        pytest.param(changed("t", 65, 0.2), "t, row 65", "the time of the row before", id="back at a block's start"),
        pytest.param(changed("tau2", 4, 1e300), "tau2, row 4", "SI units within ±1e+12", id="absurdly large"),
        pytest.param(changed("q2", 12, 90.0), "q2, row 12", DEGREES, id="degrees"),
        pytest.param(canonical(motion(rows=29)), "rows", TOO_FEW, id="too few"),
        pytest.param(with_column(t=np.full(200, 3.0)), "rows", NO_TIME, id="no time"),
        pytest.param(with_column(episode=np.full(200, 0.5)), "episode, row 1", "a whole number", id="half"),
        pytest.param(with_column(q2=np.full(200, 0.25)), "q2", LOCKED, id="locked"),
        pytest.param(with_column(tau1=np.zeros(200)), "tau1", UNMEASURED, id="no torque"),
        pytest.param(with_column(tau1=np.full(200, -3.5)), "tau1", "constant at -3.5, expected", id="constant torque"),
        pytest.param(with_column(t=np.arange(200) * 10.0), "t", 'units={"t": "ms"}', id="milliseconds"),
        pytest.param(with_column(t=1.7e18 + np.arange(200) * 1e7), "t, row 1", 'units={"t": "ns"}', id="ns since 1970"),
        pytest.param(MISSING, "tau2, row 51", "150 of 200 rows", id="missing"),
        pytest.param(scaled(dq=180 / np.pi), None, '{"dq": "deg/s"}', id="deg/s"),
        pytest.param(scaled(q=10, dq=10, ddq=1800 / np.pi), None, '{"ddq": "deg/s^2"}', id="deg/s^2"),
        pytest.param(scaled(q=18 / np.pi, dq=0.1, ddq=0.1), None, '{"q": "deg"}', id="deg"),
    ],
)
def test_unusable_values_are_rejected_with_their_row(reading, columns, field, message):
    check_rejected(reading, columns, message, field)


def wrapped(q, lowest=-np.pi):
    """Return positions as a sensor wraps them at a whole turn."""
    return (q - lowest) % (2 * np.pi) + lowest


@pytest.mark.parametrize("lowest", [-np.pi, 0.0])
def test_wrapped_positions_are_unwrapped(reading, lowest):
    data = motion()
    data["q"][:, 0] = 40.0 * data["t"] + data["q"][:, 0]
    result = reading(canonical(data | {"q": wrapped(data["q"], lowest)}), block=33)
    turns = (result.staged.table("q") - data["q"]) / (2 * np.pi)
    np.testing.assert_allclose(turns, np.round(turns[:1]) * np.ones((200, 1)), atol=1e-12)
    count = int((np.diff(wrapped(data["q"], lowest)[:, 0]) < -5).sum())
    assert result.facts["turns"]["joint1"] == count > 5
    assert f"the position of joint1 jumps by whole turns {count} times, first in row" in " ".join(result.noted)


def test_unwrapping_restarts_with_every_episode(reading):
    data = motion()
    data["q"][:, 0] = 10.0 * data["t"]
    columns = canonical(data | {"q": wrapped(data["q"])}) | {"episode": np.repeat([0.0, 1.0], 100)}
    columns["q1"][50] = np.nan
    q = reading(columns).staged.table("q")[:, 0]
    assert q[100] == columns["q1"][100]
    assert np.nanmax(np.abs(np.delete(np.diff(q), 99))) < 0.3


def test_positions_with_a_unit_have_no_limit(reading):
    data = motion()
    data["q"][:, 0] += 30.0
    check_rejected(reading, canonical(data), 'units={"q": "rad"} if the joint turns this far')
    np.testing.assert_array_equal(reading(canonical(data), options(units={"q": "rad"})).staged.table("q"), data["q"])


def test_full_disk_stops_reading(tmp_path):
    limits = Settings(home=tmp_path, min_free_bytes=2**60)
    with pytest.raises(StorageFullError):
        read(table(canonical(motion())), tmp_path, options(), None, limits, Disk(limits))


@pytest.mark.parametrize("seed", range(2))
def test_noisy_and_late_derivatives_are_accepted(reading, seed):
    rng, data = np.random.default_rng(seed), motion(rows=2000, n=3, seed=seed)
    data["q"] += 1e-3 * rng.standard_normal(data["q"].shape)
    data["dq"] = np.roll(data["dq"], 3, axis=0) + 0.3 * rng.standard_normal(data["dq"].shape)
    data["ddq"] = 10 * rng.standard_normal(data["ddq"].shape)
    assert reading(canonical(data)).staged.rows == 2000


@pytest.mark.parametrize(
    ("moves", "record"),
    [(0.5, "warning: gripper is left out although it moved by 0.5"), (1e-5, "gripper is left out and did not move")],
)
def test_dropped_joint_is_reported(reading, moves, record):
    data = motion()
    renamed = {"q1": "joint1/position", "q2": "joint2/position"}
    columns = {renamed.get(name, name): values for name, values in canonical(data).items()}
    columns["gripper/position"] = np.linspace(0, moves, 200)
    result = reading(columns, options(drop_joints=("gripper",)))
    assert any(record in note for note in result.noted)
    assert result.facts["dropped_joints"] == ["gripper"]
    np.testing.assert_array_equal(result.staged.table("q"), data["q"])


def test_memory_does_not_grow_with_the_recording(tmp_path, limits):
    """Of a recording of 100 000 rows and 21 columns, 17 MB, only a few columns of 0.8 MB are in memory."""
    rows, part = 100_000, canonical(motion(rows=1000, n=5))
    block = np.column_stack(list(part.values()))

    def blocks():
        for start in range(0, rows, 1000):
            moved = block.copy()
            moved[:, 0] += start / RATE
            yield moved

    given = table(part)
    given.blocks = blocks()
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        result = read(given, tmp_path, options(), None, limits, Disk(limits))
        peak = tracemalloc.get_traced_memory()[1] - before
    finally:
        tracemalloc.stop()
    assert result.staged.rows == rows
    assert peak < 10e6


def read_file(tmp_path, path, kind, robot=None):
    """Read a real recording."""
    limits = Settings(home=tmp_path)
    with open_table(path, kind, options().read, limits) as given:
        return read(given, tmp_path, options(), robot, limits, Disk(limits))


@pytest.mark.skipif(not PANDA.exists(), reason=f"{PANDA} is not there")
def test_recording_of_a_real_panda_is_mapped(tmp_path):
    rosbags = pytest.importorskip("rosbags.typesys")
    store = rosbags.get_typestore(rosbags.Stores.ROS2_HUMBLE)
    with sqlite3.connect(f"file:{PANDA}?mode=ro", uri=True) as database:
        rows = database.execute("SELECT data FROM messages ORDER BY timestamp").fetchall()
    database.close()
    messages = [store.deserialize_cdr(data, "sensor_msgs/msg/JointState") for (data,) in rows]
    result = read_file(tmp_path, PANDA, "rosbag2", profile("panda"))
    assert result.staged.joint_names == profile("panda").joint_names
    assert (result.facts["effort"], result.torque_convention) == ("measured", "gravity_included")
    for quantity, field in (("q", "position"), ("dq", "velocity"), ("tau", "effort")):
        expected = np.array([getattr(message, field) for message in messages])
        np.testing.assert_array_equal(result.staged.table(quantity), expected)


@pytest.mark.skipif(not SCHUNK.exists(), reason=f"{SCHUNK} is not there")
def test_episodes_of_a_real_schunk_are_mapped(tmp_path):
    result = read_file(tmp_path, SCHUNK, "npz")
    assert result.noted == []
    with np.load(SCHUNK) as file:
        for quantity in ("q", "dq", "tau"):
            np.testing.assert_array_equal(result.staged.table(quantity), file[quantity])
        np.testing.assert_array_equal(result.staged.read("episode"), file["episode"])


def test_joints_without_effort_are_left_out(reading):
    """Wheels and grippers have none."""
    data = motion(n=4)
    data["tau"][:, [0, 2]] = np.nan
    kept = reading(canonical(data))
    assert kept.staged.joint_names == ("joint2", "joint4")
    np.testing.assert_array_equal(kept.staged.table("tau"), data["tau"][:, [1, 3]])
    assert "joints without effort are left out: joint1, joint3" in kept.noted
    data["tau"][150, 2] = 1.5
    check_rejected(reading, canonical(data), "Leave out the joint with drop_joints=joint3", "tau3, row 151")
    assert (
        reading(canonical(data), options(drop_joints=("joint1", "joint3"))).staged.joint_names
        == kept.staged.joint_names
    )


def test_remedy_names_all_joints_without_velocity(reading):
    data = motion(n=4)
    data["dq"][:, [0, 2]] = np.nan
    with pytest.raises(InvalidDataError) as caught:
        reading(canonical(data))
    assert caught.value.detail[0].expected.endswith("drop_joints=joint1,joint3")


def test_one_joint_of_a_robot_is_read(reading):
    data = {name.replace("1", "3"): values for name, values in canonical(motion(n=1)).items()}
    result = reading(data)
    assert result.staged.joint_names == ("joint3",)
    np.testing.assert_array_equal(result.staged.read("tau1"), data["tau3"])


def test_torque_that_equals_a_command_is_named(reading):
    data = canonical(motion(n=2))
    wanted = {f"commanded_tau{j}": data[f"tau{j}"].copy() for j in (1, 2)}
    equal = "The torque equals what was commanded, commanded_tau1, commanded_tau2, in all rows"
    assert any(equal in each for each in reading(data | wanted).noted)
    wanted["commanded_tau1"][-1] += 1e-3
    wanted["commanded_tau2"][7] += 1e-3
    assert not any("equals what was commanded" in each for each in reading(data | wanted).noted)
