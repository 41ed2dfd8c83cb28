"""Recordings in every accepted form become the same data set; unusable files are rejected and not stored."""

import io

import numpy as np
import pytest

from lipserve.media_types import MEDIA_TYPES, SUFFIXES
from service.datasets import store
from tests.service.data import QUICK, arrays, columns, csv, error, job, npz, post, queue, service_of, stream, upload

TRUE = stream()
SHORT = stream(samples=50, rate=50.0)
GOOD = csv(columns(TRUE))
LIMIT = 200_000


def stored(api, dataset):
    """The samples of a data set as a training job reads them."""
    service = service_of(api)
    return store.samples(service.files, store.find(service.database, dataset["id"]))


def post_form(api, name, body):
    return api.post("/v1/datasets", files={"file": (name, body)})


def read_created(answer):
    assert answer.status_code == 201, answer.text
    return answer.json()


def check_rejected(api, answer, status=422, code="invalid_data"):
    """Check that an upload is rejected and nothing of it is stored; return the error."""
    problem = error(answer, status, code)
    files = service_of(api).files
    assert api.get("/v1/datasets").json() == {"items": [], "next_cursor": None}
    assert list(files.uploads.iterdir()) == []
    assert list(files.datasets.iterdir()) == []
    return problem


def changed(column, row, text):
    """Return the table with another text in one cell; rows count from 1."""
    table = columns(TRUE)
    table[column][row - 1] = text
    return csv(table)


@pytest.fixture(scope="module")
def reference(api):
    """The stream as NPZ without anything optional."""
    return read_created(post(api, npz(**arrays(TRUE))))


def test_npz_is_stored_as_it_was_sent(api, reference):
    kept = stored(api, reference)
    assert api.get(f"/v1/datasets/{reference['id']}").json() == reference
    assert kept.joint_names == ("joint1", "joint2")
    for name, values in arrays(TRUE).items():
        np.testing.assert_array_equal(getattr(kept, name), values)


@pytest.mark.parametrize(
    ("file_name", "name", "body"),
    [("../../etc/stream.csv", "stream.csv", GOOD), ("STREAM.NPZ", "STREAM.NPZ", npz(**arrays(TRUE)))],
)
def test_form_upload_derives_format_and_name_from_the_file_name(api, reference, file_name, name, body):
    dataset = read_created(post_form(api, file_name, body))
    assert (dataset["name"], dataset["sha256"]) == (name, reference["sha256"])


def test_query_overrides_names_and_convention_of_the_file(api):
    body = npz(**arrays(TRUE), joint_names=np.array(["shoulder", "elbow"]))
    assert read_created(post(api, body))["joint_names"] == ["shoulder", "elbow"]
    query = {"name": "Möve 1", "torque_convention": "gravity_compensated", "joint_names": "a, b"}
    dataset = read_created(post(api, body, **query))
    assert {name: dataset[name] for name in query} == query | {"joint_names": ["a", "b"]}


def test_times_are_optional_if_nothing_is_derived(api):
    report = read_created(post(api, npz(**arrays(TRUE, "q", "dq", "ddq", "tau"))))["report"]
    assert (report["rate_hz"], report["rows"]) == (None, 80)


def bomb():
    """Small, and 32 MB unpacked."""
    out = io.BytesIO()
    np.savez_compressed(out, q=np.zeros((2_000_000, 2)), tau=np.zeros((2_000_000, 2)))
    assert len(out.getvalue()) < LIMIT
    return out.getvalue()


def zeros(rows, joints):
    """Return a recording of zeros."""
    return npz(q=np.zeros((rows, joints)), tau=np.zeros((rows, joints)))


HALF = np.array(["a", "\ud800"])
DEGREES = 'q2, row 12 is 90, expected radians or metres within ±12.6. Set units={"q": "deg"} if these are degrees'
WRONG = {
    "degrees": (changed("q2", 12, "90"), "text/csv", "q2, row 12", DEGREES),
    "text": (changed("q1", 1, "x" * 50_000), "text/csv", "q1, row 1", "x" * 200),
    "no times": (npz(**arrays(TRUE, "q", "tau")), "application/x-npz", "t", "because dq and ddq must be derived"),
    "too short once filtered": (npz(**arrays(SHORT, "t", "q", "tau")), "application/x-npz", "rows", "24, expected at"),
    "nine joints": (zeros(40, 9), "application/x-npz", "joints", "9, expected 1 to 8"),
    "many rows": (zeros(501, 1), "application/x-npz", "rows", "at most 500"),
    "a header of all that is allowed": (b"x" * LIMIT, "text/csv", "header", "at most 65536"),
    "half a name": (npz(q=TRUE.q, tau=TRUE.tau, joint_names=HALF), "application/x-npz", "joint_names[1]", "printable"),
    "wrong torques": (npz(q=TRUE.q, tau=TRUE.tau.T), "application/x-npz", "tau", "(80, 2)"),
}


@pytest.mark.parametrize("kind", WRONG)
def test_unusable_file_is_rejected_with_the_place_of_the_error(strict, kind):
    body, media_type, field, message = WRONG[kind]
    problem = check_rejected(strict, post(strict, body, media_type))
    assert problem["detail"][0]["field"] == field
    assert message in problem["message"]
    assert len(problem["message"]) < 400


@pytest.mark.parametrize(
    ("send", "message"),
    [
        (lambda api: post(api, b"x" * (LIMIT + 1), "text/csv"), str(LIMIT)),
        (lambda api: post(api, (b"x" * 10_000 for _ in range(LIMIT // 10_000 + 1))), str(LIMIT)),
        (lambda api: post(api, bomb()), "at most 400000"),
        (lambda api: post_form(api, "a.csv", b"x" * LIMIT), ""),
    ],
    ids=["announced", "in chunks", "bomb", "form"],
)
def test_too_large_file_is_rejected(strict, send, message):
    assert message in check_rejected(strict, send(strict), 413, "too_large")["message"]


def test_rejection_lists_accepted_media_types_and_suffixes(strict):
    message = check_rejected(strict, post(strict, GOOD, "text/plain"), 415, "unsupported_media_type")["message"]
    assert all(each in message for each in (*MEDIA_TYPES, "multipart/form-data"))
    problem = check_rejected(strict, post_form(strict, "stream.csv.exe", GOOD), 415, "unsupported_media_type")
    assert problem["detail"][0]["value"] == "stream.csv.exe"
    assert all(each in problem["message"] for each in SUFFIXES)


@pytest.mark.parametrize("names", ["a", "a,a", "", "a,b\x7f"])
def test_bad_joint_names_are_rejected(strict, names):
    problem = check_rejected(strict, post(strict, GOOD, "text/csv", joint_names=names))
    assert problem["detail"][0]["field"].startswith("joint_names")


@pytest.fixture
def dataset(strict):
    """The id of a data set."""
    return upload(strict, stream())["id"]


@pytest.mark.own_files("looks for the file below the home")
def test_deletion_removes_the_data_set_and_its_file(strict, dataset):
    file = service_of(strict).files.datasets / f"{dataset}.safetensors"
    assert file.exists()
    answer = strict.delete(f"/v1/datasets/{dataset}")
    assert (answer.status_code, answer.content) == (204, b"")
    assert not file.exists()
    error(strict.get(f"/v1/datasets/{dataset}"), 404, "not_found")


def test_data_set_of_a_queued_job_is_not_deleted(no_worker, dataset):
    waiting = queue(no_worker, "m", dataset, options={**QUICK, "posterior_samples": 40})
    reply = error(no_worker.delete(f"/v1/datasets/{dataset}"), 409, "conflict")
    assert waiting["id"] in reply["message"]
    assert no_worker.get(f"/v1/datasets/{dataset}").status_code == 200

    no_worker.post(f"/v1/jobs/{waiting['id']}/cancel")
    assert job(no_worker, waiting["id"])["state"] == "cancelled"
    assert no_worker.delete(f"/v1/datasets/{dataset}").status_code == 204
