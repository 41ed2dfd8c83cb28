"""Recordings in every accepted form become the same data set, and its report says what was found."""

from __future__ import annotations

import numpy as np
import pytest

from service.cli.simulate import write_recording
from service.datasets import store
from tests.service.data import arrays, columns, csv, npz, post, service_of, stream

TRUE_STREAM = stream()
STAYS = ("rows_uploaded", "rows", "episodes", "gaps", "derived", "preparation", "warnings")
"""Of the report, what says that nothing was done."""


def stored(api, dataset):
    """The samples of a data set as a training job reads them."""
    service = service_of(api)
    return store.samples(service.files, store.find(service.database, dataset["id"]))


def created(answer):
    assert answer.status_code == 201, answer.text
    return answer.json()


@pytest.fixture(scope="module")
def reference(api):
    """The stream as NPZ without anything optional."""
    return created(post(api, npz(**arrays(TRUE_STREAM))))


def test_npz_is_stored_as_it_was_sent(api, reference):
    kept = stored(api, reference)
    assert kept.joint_names == ("joint1", "joint2")
    for name, values in arrays(TRUE_STREAM).items():
        np.testing.assert_array_equal(getattr(kept, name), values)


def test_report_says_what_was_found(reference):
    report = reference["report"]
    ranges = report.pop("ranges")
    assert set(ranges) == {"q", "dq", "ddq", "tau"}
    for name, found in ranges.items():
        np.testing.assert_array_equal(found["min"], getattr(TRUE_STREAM, name).min(axis=0))
        np.testing.assert_array_equal(found["max"], getattr(TRUE_STREAM, name).max(axis=0))
    noise = report.pop("torque_noise_estimate")
    np.testing.assert_allclose(noise, 0.01, rtol=0.4)
    assert report.pop("rate_hz") == pytest.approx(10.0)
    assert {name: report[name] for name in STAYS} == {
        "rows_uploaded": 80,
        "rows": 80,
        "episodes": 1,
        "gaps": 0,
        "derived": [],
        "preparation": [],
        "warnings": [],
    }


def test_location_leads_to_the_data_set(api):
    answer = post(api, npz(**arrays(TRUE_STREAM)))
    assert api.get(answer.headers["location"]).json() == answer.json()


@pytest.mark.parametrize("ending", [".csv", ".npz"])
def test_written_recordings_are_read_back_exactly(api, reference, tmp_path, ending):
    path = tmp_path / f"recording{ending}"
    write_recording(path, TRUE_STREAM)
    media_type = {".csv": "text/csv", ".npz": "application/x-npz"}[ending]
    assert created(post(api, path.read_bytes(), media_type))["sha256"] == reference["sha256"]


@pytest.mark.parametrize(
    "rewrite",
    [
        pytest.param(csv, id="plain"),
        pytest.param(lambda table: csv(table, newline="\r\n"), id="windows line ends"),
        pytest.param(lambda table: b"\xef\xbb\xbf" + csv(table), id="byte order mark"),
        pytest.param(lambda table: csv(dict(reversed(table.items()))), id="columns in another order"),
        pytest.param(lambda table: csv({f'"{name} "': values for name, values in table.items()}), id="quoted header"),
        pytest.param(lambda table: csv(table) + b"\n\n", id="empty lines at the end"),
        pytest.param(lambda table: csv(table).rstrip(b"\n"), id="no line end at the end"),
        pytest.param(lambda table: csv({**table, "episode": ["3"] * len(table["t"])}), id="one episode"),
    ],
)
def test_csv_in_any_dialect_gives_the_same_samples(api, reference, rewrite):
    answer = post(api, rewrite(columns(TRUE_STREAM)), "text/csv; charset=utf-8")
    assert created(answer)["sha256"] == reference["sha256"]


@pytest.mark.parametrize(
    ("file_name", "body"),
    [("stream.csv", csv(columns(TRUE_STREAM))), ("STREAM.NPZ", npz(**arrays(TRUE_STREAM)))],
)
def test_multipart_takes_the_kind_and_the_name_from_the_file_name(api, reference, file_name, body):
    dataset = created(api.post("/v1/datasets", files={"file": (file_name, body)}))
    assert dataset["name"] == file_name
    assert dataset["sha256"] == reference["sha256"]


def test_file_name_is_never_a_path(api):
    files = {"file": ("../../etc/evil.csv", csv(columns(TRUE_STREAM)))}
    assert created(api.post("/v1/datasets", files=files))["name"] == "evil.csv"


def test_name_and_convention_of_the_query_are_kept(api):
    answer = post(api, npz(**arrays(TRUE_STREAM)), name="Möve 1", torque_convention="gravity_compensated")
    assert created(answer)["name"] == "Möve 1"
    assert answer.json()["torque_convention"] == "gravity_compensated"


def test_joint_names_come_from_the_npz(api):
    body = npz(**arrays(TRUE_STREAM), joint_names=np.array(["shoulder", "elbow"]))
    assert created(post(api, body))["joint_names"] == ["shoulder", "elbow"]


def test_joint_names_of_the_query_come_first(api):
    body = npz(**arrays(TRUE_STREAM), joint_names=np.array(["shoulder", "elbow"]))
    assert created(post(api, body, joint_names="a, b"))["joint_names"] == ["a", "b"]


def test_single_precision_and_whole_numbers_and_other_byte_orders_are_taken(api):
    body = npz(
        q=TRUE_STREAM.q.astype(">f4"),
        dq=np.asfortranarray(TRUE_STREAM.dq),
        ddq=np.zeros((80, 2), dtype=np.uint8),
        tau=TRUE_STREAM.tau,
        t=100 * np.arange(80),
    )
    kept = stored(api, created(post(api, body, units='{"t": "ms"}')))
    np.testing.assert_array_equal(kept.q, TRUE_STREAM.q.astype(np.float32))
    np.testing.assert_array_equal(kept.dq, TRUE_STREAM.dq)
    np.testing.assert_array_equal(kept.ddq, np.zeros((80, 2)))
    np.testing.assert_allclose(kept.t, 0.1 * np.arange(80), rtol=1e-15)


def test_times_are_not_needed_where_nothing_is_derived(api):
    dataset = created(post(api, npz(**arrays(TRUE_STREAM, "q", "dq", "ddq", "tau"))))
    assert dataset["report"]["rate_hz"] is None
    assert dataset["report"]["rows"] == 80


def test_constant_torque_is_warned_about(api):
    tau = TRUE_STREAM.tau.copy()
    tau[:, 1] = 0.5
    dataset = created(post(api, npz(**arrays(TRUE_STREAM) | {"tau": tau})))
    assert dataset["report"]["warnings"] == ["tau2 is constant: nothing can be learnt about this joint's torque"]
