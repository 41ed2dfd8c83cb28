"""The Python client against a real server."""

from __future__ import annotations

import numpy as np
import pytest

from service.cli.simulate import write_recording
from service.client import ApiError, Client, ServiceUnreachableError
from tests.service.data import QUICK, stream
from tests.service.server import free_port


@pytest.fixture(scope="module")
def client(server):
    with Client(server.url) as opened:
        yield opened


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A training stream as CSV, an unseen one as NPZ."""
    folder = tmp_path_factory.mktemp("files")
    write_recording(folder / "train.csv", stream())
    write_recording(folder / "test.npz", stream(seed=2))
    return folder


def test_from_files_to_torques(client, files):
    names = list(stream().joint_names)
    train = client.upload(files / "train.csv", joint_names=names)
    test = client.upload(files / "test.npz", name="unseen")
    assert (train.name, test.name) == ("train.csv", "unseen")
    assert train.joint_names == test.joint_names == names

    looks = []
    job = client.train("roundtrip", [train.id], "lip", ["revolute", "revolute"], QUICK)
    assert job.state == "queued"
    job = client.wait(job.id, looks.append)
    assert (job.state, job.version) == ("succeeded", 1)
    assert looks[-1] == job == client.job(job.id)

    assert client.model("roundtrip").latest_version == 1
    assert client.version("roundtrip", 1).lineage["datasets"][0]["sha256"] == train.sha256

    s = stream()
    batch = client.predict("roundtrip", s.q, s.dq, s.ddq, covariance=True)
    single = client.predict("roundtrip", s.q[3], s.dq[3], s.ddq[3], version=1)
    assert np.shape(batch.tau) == (80, 2)
    np.testing.assert_allclose(single.tau, batch.tau[3], rtol=1e-9)
    assert single.covariance is None
    assert np.shape(batch.covariance) == (80, 2, 2)

    result = client.evaluate("roundtrip", test.id, version=1)
    assert (result.dataset, result.samples, result.in_training) == (test.id, 80, False)


def test_cancelling(client, files):
    dataset = client.upload(files / "train.csv").id
    running = client.train(
        "cancelled", [dataset], "lip-chain", options={"max_iterations": 10_000, "posterior_samples": 80}
    )
    job = client.cancel(running.id)
    assert job.id == running.id
    seen = list(client.job_events(job.id))
    assert seen[-1].state == client.wait(job.id).state == "cancelled"
    again = client.retry(job.id)
    assert (again.retry_of, again.model) == (job.id, "cancelled")
    assert client.cancel(again.id).id == again.id
    with pytest.raises(ApiError) as caught:
        next(client.job_events("job_nowhere"))
    assert caught.value.status == 404


def test_refusals_carry_code_message_and_detail(client):
    with pytest.raises(ApiError) as caught:
        client.predict("panda-sim", [0.0] * 6, [0.0] * 6, [0.0] * 6)
    assert (caught.value.status, caught.value.code) == (422, "invalid_request")
    assert str(caught.value) == caught.value.message
    assert "q is 6 numbers long, expected 7 numbers: panda_joint1" in caught.value.message
    assert caught.value.detail[0]["field"] == "q"

    with pytest.raises(ApiError) as caught:
        client.model("nobody")
    assert (caught.value.status, caught.value.code) == (404, "not_found")


def test_refused_data_say_why(client, tmp_path):
    path = tmp_path / "bad.csv"
    path.write_text("t,q1,speed1\n0,0,0\n")
    with pytest.raises(ApiError, match="column tau1 is missing"):
        client.upload(path)


def test_uploads_beyond_the_limit_say_so(client, tmp_path):
    path = tmp_path / "large.csv"
    path.write_bytes(b"x" * 3_000_000)
    with pytest.raises(ApiError) as caught:
        client.upload(path)
    assert (caught.value.status, caught.value.code) == (413, "too_large")


def test_other_endings_are_refused_before_anything_is_sent(tmp_path):
    said = pytest.raises(ValueError, match=r"expected the ending \.csv, ")
    with Client(f"http://127.0.0.1:{free_port()}") as client, said:
        client.upload(tmp_path / "stream.xlsx")


def test_nobody_listening_is_said_with_the_remedy():
    url = f"http://127.0.0.1:{free_port()}"
    with Client(url) as client:
        assert client.ready() is False
        with pytest.raises(ServiceUnreachableError, match=f"no service answers at {url}.*lipserve serve"):
            client.model("panda-sim")


def test_ready(client):
    assert client.ready() is True
