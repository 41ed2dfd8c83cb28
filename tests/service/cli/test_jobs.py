"""`lipserve train` and `lipserve jobs`."""

from __future__ import annotations

import json
from contextlib import contextmanager

import pytest

from service.cli.simulate import write_recording
from service.client import Client
from tests.service.cli.conftest import QUICKLY
from tests.service.data import ENDLESS, ended, queue, stream, upload


@pytest.fixture
def interrupted(monkeypatch):
    """Ctrl-C at the first look at the job."""

    @contextmanager
    def bar(console):
        def look(job):
            raise KeyboardInterrupt

        yield look

    monkeypatch.setattr("service.client.progress.job_bar", bar)


@pytest.fixture(scope="module")
def long(server):
    """A data set that a fit with the options ENDLESS takes half a minute for."""
    return upload(server.client, stream("panda", 200, seed=81))["id"]


ENDLESSLY = ["--estimator", "lip-chain"]
ENDLESSLY += [part for name, value in ENDLESS.items() for part in ("--option", f"{name}={value}")]


def test_ctrl_c_in_train_cancels_the_job(lipserve, server, long, interrupted):
    code, said, err = lipserve("train", long, "--model", "cli-cut", *ENDLESSLY, "--url", server.url, "--json")
    assert code == 130
    found = json.loads(said)
    assert found["state"] == "cancelled"
    assert f"{found['id']} is cancelled" in err


def test_ctrl_c_while_the_job_is_queued_cancels_it(lipserve, server, long, monkeypatch):
    """It has come before its answer could be read: there is a job, whose id nobody knows."""
    send, interruptions = Client.send, iter([KeyboardInterrupt])

    def cut(client, call):
        answer = send(client, call)
        if (call.method, call.path) == ("POST", "/v1/jobs") and (interruption := next(interruptions, None)):
            raise interruption
        return answer

    monkeypatch.setattr(Client, "send", cut)
    code, said, _ = lipserve("train", long, "--model", "cli-torn", *ENDLESSLY, "--url", server.url)
    assert (code, said) == (130, "")
    (found,) = [job for job in server.client.get("/v1/jobs").json()["items"] if job["model"] == "cli-torn"]
    assert ended(server.client, found["id"])["state"] == "cancelled"


def test_ctrl_c_in_follow_leaves_the_job(lipserve, asked, server, long, interrupted):
    job = queue(server.client, "cli-left", long, options=ENDLESS)["id"]
    code, said, err = lipserve("jobs", "follow", job, "--url", server.url, "--json")
    assert (code, json.loads(said)["state"] in ("queued", "running")) == (130, True)
    assert "goes on" in err
    assert asked("jobs", "cancel", job, "--json")["id"] == job


def test_a_job_is_queued_followed_and_listed(lipserve, asked, server, tmp_path):
    path = tmp_path / "arm.npz"
    write_recording(path, stream(seed=82))
    job = asked("train", path, "--model", "cli-queued", "--no-wait", *QUICKLY, "--estimator", "se", "--json")["id"]
    assert "cli-queued (se): succeeded, version 1" in asked("jobs", "follow", job)
    assert asked("jobs", "show", job, "--json")["state"] == "succeeded"
    assert job in [each["id"] for each in asked("jobs", "list", "--json")]
    assert "cli-queued" in asked("jobs", "list")
    code, _, err = lipserve("jobs", "retry", job, "--url", server.url)
    assert (code, "conflict" in err) == (1, True)


def test_a_file_is_evaluated(asked, arm, tmp_path):
    path = tmp_path / "unseen.npz"
    write_recording(path, stream(seed=83))
    name, dataset = arm
    assert not asked("evaluate", name, path, "--json")["in_training"]
    assert asked("evaluate", name, dataset, "--json")["in_training"]
    assert "which it was trained on" in asked("evaluate", name, dataset)


def test_data_sets_are_deleted(lipserve, asked, server, tmp_path):
    paths = [tmp_path / f"{name}.npz" for name in "ab"]
    for path in paths:
        write_recording(path, stream(seed=84))
    made = [each["id"] for each in asked("data", "add", *paths, "--json")]
    assert asked("data", "delete", *made, "--yes", "--json") == {"deleted": made}
    code, _, err = lipserve("data", "show", made[0], "--url", server.url)
    assert (code, "no dataset" in err) == (1, True)
