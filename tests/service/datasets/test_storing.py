"""What of an upload is stored and shown: its samples, prepared step by step, its report, its preview."""

import hashlib
import json

import numpy as np
import pyarrow as pa
import pytest
from safetensors.numpy import load_file
from scipy.interpolate import Akima1DInterpolator
from scipy.signal import butter, sosfiltfilt
from sqlalchemy import select

from benchmarks.ingest import recording
from lipcore.preparation.recipe import Recipe
from lipcore.robots.dirt import Dirt
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Simulation, simulate
from service.datasets.staging import QUANTITIES, Staged, column, prepare
from service.foundation.settings import Settings
from service.storage import sample_file
from service.storage.database import JobRow
from service.storage.disk import Disk
from tests.service.data import arrays, npz, post, queue, service_of, stream
from tests.service.datasets.reading import parquet
from tests.service.datasets.test_uploads import read_created

SAMPLES = stream(samples=600, rate=100.0, seed=71)


def test_arrays_written_one_by_one_are_read_by_the_library(tmp_path):
    path = tmp_path / "samples.safetensors"
    with path.open("wb") as file:
        digest = sample_file.write(file, len(SAMPLES), SAMPLES.n_joints, lambda name: getattr(SAMPLES, name))
    result = load_file(path)
    assert set(result) == set(sample_file.ARRAYS)
    for name, values in result.items():
        np.testing.assert_array_equal(values, getattr(SAMPLES, name))
        assert values.dtype == getattr(SAMPLES, name).dtype
    assert digest == hashlib.sha256(path.read_bytes()).hexdigest() == sample_file.sha256(path)
    assert sample_file.count_rows(path) == len(SAMPLES)
    chosen = np.array([0, 7, 599])
    for name, values in sample_file.read(path, chosen).items():
        np.testing.assert_array_equal(values, getattr(SAMPLES, name)[chosen])


def test_recipe_and_source_of_an_upload_are_kept(api):
    columns = {
        "stamp": pa.array(np.round(1000 * SAMPLES.t)),
        **{f"arm_{joint}/pos": pa.array(np.degrees(SAMPLES.q[:, joint])) for joint in range(2)},
        **{f"arm_{joint}/torque": pa.array(SAMPLES.tau[:, joint]) for joint in range(2)},
    }
    query = {
        "columns": '{"t": "stamp", "q": "arm_{joint}/pos", "tau": "arm_{joint}/torque"}',
        "units": '{"t": "ms", "q": "deg"}',
        "joint_names": "shoulder,elbow",
    }
    answer = post(api, parquet(columns), "application/vnd.apache.parquet", cutoff=6, rate=50, **query)
    dataset = read_created(answer)
    report = dataset["report"]
    assert dataset["joint_names"] == ["shoulder", "elbow"]
    assert report["rate_hz"] == pytest.approx(50.0)
    assert report["recipe"]["cutoff_hz"] == 6.0
    assert report["derived"] == ["dq", "ddq"]
    assert report["source"]["columns"]["q"] == ["arm_0/pos", "arm_1/pos"]
    assert [step["text"] for step in report["steps"]] == report["preparation"]
    motion = SAMPLES.q[25:-25]  # what the edges leave, in radians
    assert np.array(report["ranges"]["q"]["max"]) == pytest.approx(motion.max(axis=0), abs=0.05)


def test_joint_types_of_the_robot_are_the_default_of_a_job(api):
    tiago = stream("tiago", samples=80, seed=73)
    dataset = read_created(post(api, npz(**arrays(tiago), joint_names=np.array(tiago.joint_names)), robot="tiago"))
    types = load_robot("tiago").joint_types
    assert types.count("prismatic") == 1
    assert dataset["report"]["joint_types"] == list(types)
    job = queue(api, "types-of-tiago", dataset["id"])
    with service_of(api).database.session() as session:
        assert session.scalar(select(JobRow).where(JobRow.id == job["id"])).request["joint_types"] == list(types)
    api.post(f"/v1/jobs/{job['id']}/cancel")
    unknown = read_created(post(api, npz(**arrays(SAMPLES))))
    assert unknown["report"]["joint_types"] is None


@pytest.mark.parametrize("kind", recording.FORMATS)
def test_service_reads_files_of_the_benchmark(api, tmp_path, kind):
    path = tmp_path / f"recording.{kind}"
    recording.write(path, 3000, 2, ("q", "dq", "tau"), 0)
    media_type = {"csv": "text/csv", "parquet": "application/vnd.apache.parquet"}[kind]
    report = read_created(post(api, path.read_bytes(), media_type))["report"]
    assert (report["rows_uploaded"], report["derived"]) == (3000, ["ddq"])
    assert report["rate_hz"] == pytest.approx(1000.0)


def test_array_of_another_shape_is_rejected(tmp_path):
    with (tmp_path / "x").open("wb") as file, pytest.raises(ValueError, match="q has shape"):
        sample_file.write(file, len(SAMPLES), 3, lambda name: getattr(SAMPLES, name))


RATE, ROWS, NAMES = 90.0, 900, ("shoulder", "elbow", "wrist")


def position(t, joint):
    return np.sin((1 + 0.5 * joint) * t) + 0.2 * np.cos(3.3 * t + joint)


def test_steps_suffice_to_repeat_the_preparation_by_hand(tmp_path):
    t = np.arange(ROWS) / RATE + np.random.default_rng(0).uniform(0, 0.7, ROWS) / RATE
    t[500:] += 3
    raw = Staged(tmp_path, NAMES, Disk(Settings(home=tmp_path)))
    rows = {column("q", joint): position(t, joint) for joint in range(3)}
    raw.append({"t": t, **rows, **{column("tau", joint): np.cos(rows[column("q", joint)]) for joint in range(3)}})
    prepared = prepare(raw, tmp_path, Recipe(cutoff_hz=5), 30)
    assert (prepared.staged.joint_names, prepared.staged.quantities) == (NAMES, QUANTITIES)
    assert all(step["step"] and step["text"] for step in prepared.steps)

    split, resample, low_pass, _, trim = json.loads(json.dumps(prepared.steps))
    rate, q = resample["rate_hz"], position(t, 1)
    sections = butter(4, low_pass["cutoff_hz"], fs=rate, output="sos")
    ends = np.flatnonzero(np.diff(t) > split["longer_than_s"]) + 1
    # uneven stamps with a gap, done anew with SciPy from the parameters of the steps alone
    parts = []
    for part in np.split(np.arange(ROWS), ends):
        times = np.arange(t[part[0]], t[part[-1]], 1 / rate)
        even = sosfiltfilt(sections, Akima1DInterpolator(t[part], q[part])(times))
        dq = np.gradient(even, 1 / rate, edge_order=2)
        ddq = np.gradient(sosfiltfilt(sections, dq), 1 / rate, edge_order=2)
        parts.append(np.stack([times, even, dq, ddq])[:, trim["first"] : len(times) - trim["last"]])
    for name, expected in zip(("t", "q2", "dq2", "ddq2"), np.hstack(parts), strict=True):
        np.testing.assert_allclose(prepared.staged.read(name), expected, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(raw.read("q1"), position(t, 0))


def test_unknown_torque_constants_are_estimated_from_the_robot(api):
    constants = np.array([11.0, 12.0, 9.0, 3.0, 2.0, 4.0])
    dirt = Dirt(gain=0.0, seed=5)
    moved = simulate(load_robot("ur10"), Simulation(4000, rate=100.0, motion="middle", speed=5.0, dirt=dirt), 72)
    columns = arrays(moved) | {"tau": moved.tau / constants}
    dataset = read_created(post(api, npz(**columns), robot="ur10", effort="current"))
    found = np.array(dataset["report"]["source"]["torque_constants"])
    # gravity shows the constants of these joints; the others have no more than inertia and friction
    np.testing.assert_allclose(found[1:4], constants[1:4], rtol=0.2)
    assert ((found > 0.3 * constants) & (found < 3.0 * constants)).all()
    [note] = [each for each in dataset["report"]["reading"] if "estimated from the masses of ur10" in each]
    assert "Set torque_constants if you know them" in note
    values = service_of(api).storage.files.read_samples(dataset["id"], dataset["joint_names"], dataset["sha256"])
    np.testing.assert_allclose(values.tau.std(axis=0)[1:4], moved.tau.std(axis=0)[1:4], rtol=0.2)


def test_torque_constants_that_the_currents_do_not_show_are_required(api):
    moved = stream("ur10", samples=600, rate=100.0, seed=71)
    noise = np.random.default_rng(0).standard_normal(moved.tau.shape)
    answer = post(api, npz(**arrays(moved) | {"tau": noise}), robot="ur10", effort="current")
    assert answer.status_code == 422
    assert "cannot be estimated, because the currents do not show the masses of robot ur10" in answer.text
