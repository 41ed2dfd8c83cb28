"""What of an upload is stored and shown: the file of its samples, its report, its preview, and nothing beside."""

from __future__ import annotations

import hashlib
import io

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from safetensors.numpy import load_file
from sqlalchemy import select

from benchmarks.ingest import recording
from benchmarks.ingest import running as ingest
from lipcore.robots.library import load_robot
from service.storage import sample_file
from service.storage.database import JobRow
from tests.service.data import arrays, error, npz, post, queue, service_of, stream

SAMPLES = stream(samples=600, rate=100.0, seed=71)


def created(answer):
    assert answer.status_code == 201, answer.text
    return answer.json()


def parquet(**columns):
    file = io.BytesIO()
    pq.write_table(pa.table(columns), file)
    return file.getvalue()


def test_the_library_reads_what_was_written_array_by_array(tmp_path):
    path = tmp_path / "samples.safetensors"
    with path.open("wb") as file:
        digest = sample_file.write(file, len(SAMPLES), SAMPLES.n_joints, lambda name: getattr(SAMPLES, name))
    found = load_file(path)
    assert set(found) == set(sample_file.ARRAYS)
    for name, values in found.items():
        np.testing.assert_array_equal(values, getattr(SAMPLES, name))
        assert values.dtype == getattr(SAMPLES, name).dtype
    assert digest == hashlib.sha256(path.read_bytes()).hexdigest() == sample_file.sha256(path)
    assert sample_file.rows_of(path) == len(SAMPLES)
    chosen = np.array([0, 7, 599])
    for name, values in sample_file.read(path, chosen).items():
        np.testing.assert_array_equal(values, getattr(SAMPLES, name)[chosen])


def test_an_array_of_another_shape_is_not_written(tmp_path):
    with (tmp_path / "x").open("wb") as file, pytest.raises(ValueError, match="q has shape"):
        sample_file.write(file, len(SAMPLES), 3, lambda name: getattr(SAMPLES, name))


def test_an_upload_leaves_its_samples_and_nothing_else(api):
    service = service_of(api)
    before = set(service.files.uploads.iterdir())
    dataset = created(post(api, npz(**arrays(SAMPLES, "t", "q", "tau"))))
    error(post(api, npz(**arrays(SAMPLES, "q", "tau"))), 422, "invalid_data")
    assert set(service.files.uploads.iterdir()) == before
    assert (service.files.datasets / f"{dataset['id']}.safetensors").exists()


def test_recipe_and_source_of_an_upload_are_kept(api):
    columns = {
        "stamp": pa.array(np.round(1000 * SAMPLES.t)),
        **{f"arm_{joint}/pos": pa.array(np.degrees(SAMPLES.q[:, joint])) for joint in range(2)},
        **{f"arm_{joint}/torque": pa.array(SAMPLES.tau[:, joint]) for joint in range(2)},
    }
    answer = post(
        api,
        parquet(**columns),
        "application/vnd.apache.parquet",
        columns='{"t": "stamp", "q": "arm_{joint}/pos", "tau": "arm_{joint}/torque"}',
        units='{"t": "ms", "q": "deg"}',
        cutoff=6,
        rate=50,
        joint_names="shoulder,elbow",
    )
    dataset = created(answer)
    report = dataset["report"]
    assert dataset["joint_names"] == ["shoulder", "elbow"]
    assert report["rate_hz"] == pytest.approx(50.0)
    assert report["recipe"]["cutoff_hz"] == 6.0
    assert report["derived"] == ["dq", "ddq"]
    assert report["source"]["columns"]["q"] == ["arm_0/pos", "arm_1/pos"]
    assert [step["text"] for step in report["steps"]] == report["preparation"]
    motion = SAMPLES.q[25:-25]  # what the edges leave, in radians
    assert np.array(report["ranges"]["q"]["max"]) == pytest.approx(motion.max(axis=0), abs=0.05)


def test_the_types_of_joints_are_those_of_the_robot_unless_the_job_says_otherwise(api):
    tiago = stream("tiago", samples=80, seed=73)
    dataset = created(post(api, npz(**arrays(tiago), joint_names=np.array(tiago.joint_names)), robot="tiago"))
    types = load_robot("tiago").joint_types
    assert types.count("prismatic") == 1
    assert dataset["report"]["joint_types"] == list(types)
    job = queue(api, "types-of-tiago", dataset["id"])
    with service_of(api).database.session() as session:
        assert session.scalar(select(JobRow).where(JobRow.id == job["id"])).request["joint_types"] == list(types)
    api.post(f"/v1/jobs/{job['id']}/cancel")
    unknown = created(post(api, npz(**arrays(SAMPLES))))
    assert unknown["report"]["joint_types"] is None


def test_preview_keeps_the_extremes(api):
    dataset = created(post(api, npz(**arrays(SAMPLES), joint_names=np.array(["a", "b"]))))
    answer = api.get(f"/v1/datasets/{dataset['id']}/preview", params={"quantities": "tau,q", "points": 50})
    assert answer.status_code == 200
    found = answer.json()
    assert found["samples"] == len(SAMPLES)
    assert [(each["quantity"], each["joint"]) for each in found["columns"]] == [
        ("tau", "a"),
        ("tau", "b"),
        ("q", "a"),
        ("q", "b"),
    ]
    for each in found["columns"]:
        values = getattr(SAMPLES, each["quantity"])[:, "ab".index(each["joint"])]
        assert len(each["values"]) <= 50
        assert (max(each["values"]), min(each["values"])) == (values.max(), values.min())
        np.testing.assert_array_equal(values[each["rows"]], each["values"])
        np.testing.assert_array_equal(SAMPLES.t[each["rows"]], each["t"])


@pytest.mark.parametrize(
    ("params", "field"),
    [({"quantities": "q,force"}, "quantities"), ({"quantities": "q,q"}, "quantities"), ({"points": 1}, "points")],
)
def test_what_a_preview_cannot_show_is_named(api, params, field):
    dataset = created(post(api, npz(**arrays(SAMPLES))))
    said = error(api.get(f"/v1/datasets/{dataset['id']}/preview", params=params), 422, "invalid_request")
    assert said["detail"][0]["field"] == field


def test_preview_of_nothing_is_not_found(api):
    error(api.get("/v1/datasets/ds_none/preview"), 404, "not_found")


@pytest.mark.parametrize("kind", recording.FORMATS)
def test_the_benchmark_writes_what_the_service_reads(api, tmp_path, kind):
    path = tmp_path / f"recording.{kind}"
    recording.write(path, 3000, 2, ("q", "dq", "tau"), 0)
    media_type = {"csv": "text/csv", "parquet": "application/vnd.apache.parquet"}[kind]
    report = created(post(api, path.read_bytes(), media_type))["report"]
    assert (report["rows_uploaded"], report["derived"]) == (3000, ["ddq"])
    assert report["rate_hz"] == pytest.approx(1000.0)


def test_promises_of_ingestion_are_judged_for_a_million_rows_only():
    found = ingest.Ingested("parquet", 200.0, 61.0, 500.0, 900.0, 10)
    results = ingest.Results(ingest.Options(), {}, [found])
    assert [each.met for each in ingest.targets(results)] == [False, True]
    few = ingest.Results(ingest.Options(rows=1000), {}, [found])
    assert [each.met for each in ingest.targets(few)] == [None, None]
    assert "61.0" in ingest.grids(results)[1].markdown()
    with pytest.raises(ValueError, match="formats"):
        ingest.Options(formats=("xls",))
