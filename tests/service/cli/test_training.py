"""From a recording to a torque: `lipserve train`, `jobs`, `evaluate` and `predict`."""

import json
from contextlib import contextmanager

import pytest

from lipserve import Client
from tests.service.cli.conftest import QUICKLY, options_of_train
from tests.service.data import ENDLESS, ended, queue, stream, upload

ENDLESSLY = options_of_train(ENDLESS)


def test_from_a_recording_to_figures_on_what_was_held_out_and_a_torque(asked, server, recording):
    path = recording(11, samples=120, rate=10.0)
    types = ("--joint-types", "revolute, revolute", "--hold-out", 0.25, "--hold-out-by", "blocks")
    text = asked("train", path, "--model", "from-cli", *types, *QUICKLY)
    assert "from-cli version 1 is trained and answers" in text
    held = server.client.get("/v1/models/from-cli/versions/1").json()["lineage"]["holdout"]
    assert (held["split"]["kind"], held["split"]["share"]) == ("blocks", 0.25)
    assert f"on {held['samples']} samples held out" in text
    assert f"{held['nmse'][1]:.2e}" in text
    assert (
        f"{held['coverage_low'][0]:.0%} to {held['coverage_high'][0]:.0%}, by {held['independent'][0]:.0f} errors"
        in text
    )
    assert "it answers by itself: its 95 % intervals hold 90 % of what was held out" in text

    dataset = held["datasets"][0]["id"]
    text = asked("evaluate", "from-cli", dataset, "--held-out")
    assert f"on {held['samples']} held-out samples of {dataset}" in text
    assert f"{held['rmse'][0]:.4f}" in text
    assert asked("evaluate", "from-cli", dataset, "--json")["part"] == "all"
    assert "which it was trained on" in asked("evaluate", "from-cli", dataset)
    assert not asked("evaluate", "from-cli", recording(83), "--json")["in_training"]

    answer = asked("predict", "from-cli", "--q", "0.1,-0.2", "--json")
    query = {"q": [0.1, -0.2], "dq": [0.0, 0.0], "ddq": [0.0, 0.0]}
    assert answer == server.client.post("/v1/models/from-cli/predict", json=query).json()
    text = asked("predict", "from-cli", "--q", "0.1,-0.2")
    assert "joint1" in text
    assert f"{answer['tau'][1]:.4f}" in text


def test_components_are_printed_beside_the_torque(asked, refused, server):
    q, names = [0.0, -0.5, 0.0, -2.0, 0.0, 1.5, 0.7], ["gravity", "inertia_matrix", "potential_energy"]
    query = {"q": q, "dq": [0.0] * 7, "ddq": [0.0] * 7, "components": names}
    expected = server.client.post("/v1/models/panda-sim/predict", json=query).json()["components"]
    command = ("predict", "panda-sim", "--q", ",".join(map(str, q)), "--components", ", ".join(names))
    text = asked(*command)
    assert f"{expected['gravity']['mean'][1]:.4f} ± {expected['gravity']['std'][1]:.4f}" in text
    inertia = expected["inertia_matrix"]
    assert f"{inertia['mean'][2][3]:.4f} ± {inertia['std'][2][3]:.4f}" in text
    assert f"{expected['potential_energy']['mean']:.4f}" in text
    assert asked(*command, "--json")["components"] == expected
    assert "tau is given, expected no tau" in refused(*command, "--tau", "0,0,0,0,0,0,0")


def test_a_payload_is_declared_in_two_options(asked, refused, server):
    inertia = [[0.02, 0.001, 0.002], [0.001, 0.03, 0.003], [0.002, 0.003, 0.04]]
    payload = {"mass": 2.0, "com": [0.0, 0.01, 0.1], "inertia": inertia}
    query = {"q": [0.1] * 7, "dq": [0.0] * 7, "ddq": [1.0] * 7, "payload": payload}
    expected = server.client.post("/v1/models/panda-sim/predict", json=query).json()
    motion = ("--q", ",".join(["0.1"] * 7), "--ddq", ",".join(["1"] * 7))
    command = ("predict", "panda-sim", *motion, "--payload", "2,0,0.01,0.1")
    assert asked(*command, "--payload-inertia", "0.02,0.001,0.002,0.03,0.003,0.04", "--json") == expected
    assert asked(*command, "--json")["tau"] != expected["tau"]
    text = refused(*command, "--payload-inertia", "1,0,0,1,0,3")
    assert "expected no principal moment above the sum of the other two" in text


def test_refusals_of_the_service_are_passed_on(refused, recording, tmp_path):
    message, hint = refused("predict", "nobody", "--q", "1").splitlines()
    assert message == "error: no model 'nobody' (not_found, 404)"
    assert hint.startswith("hint: models that exist: ")
    assert "panda-sim" in hint
    bad = tmp_path / "bad.csv"
    bad.write_text("t,q1,speed1\n0,0,0\n")
    assert "column tau1 is missing" in refused("train", bad, "--model", "m")
    assert "holdout.kind" in refused("train", recording(12), "--model", "m", "--hold-out-by", "rows")


@pytest.fixture
def interrupted(monkeypatch):
    """Ctrl-C at the first look at the job."""

    @contextmanager
    def bar(console):
        def look(job):
            raise KeyboardInterrupt

        yield look

    monkeypatch.setattr("lipserve.progress.job_bar", bar)


@pytest.fixture(scope="module")
def long(server):
    """A data set that a fit with the options ENDLESS takes half a minute for."""
    return upload(server.client, stream("panda", 200, seed=81))["id"]


def test_ctrl_c_in_train_cancels_the_job(lipserve, server, long, interrupted):
    code, out, err = lipserve("train", long, "--model", "cli-cut", *ENDLESSLY, "--url", server.url, "--json")
    assert code == 130
    job = json.loads(out)
    assert job["state"] == "cancelled"
    assert f"{job['id']} is cancelled" in err


def test_ctrl_c_while_the_job_is_queued_cancels_it(lipserve, server, long, monkeypatch):
    """It has come before its answer could be read: there is a job, whose id nobody knows."""
    send, interruptions = Client.send, iter([KeyboardInterrupt])

    def cut(client, call):
        answer = send(client, call)
        if (call.method, call.path) == ("POST", "/v1/jobs") and (interruption := next(interruptions, None)):
            raise interruption
        return answer

    monkeypatch.setattr(Client, "send", cut)
    code, out, _ = lipserve("train", long, "--model", "cli-torn", *ENDLESSLY, "--url", server.url)
    assert (code, out) == (130, "")
    (torn,) = [job for job in server.client.get("/v1/jobs").json()["items"] if job["model"] == "cli-torn"]
    assert ended(server.client, torn["id"])["state"] == "cancelled"


def test_ctrl_c_in_follow_leaves_the_job(lipserve, asked, server, long, interrupted):
    job = queue(server.client, "cli-left", long, options=ENDLESS)["id"]
    code, out, err = lipserve("jobs", "follow", job, "--url", server.url, "--json")
    assert (code, json.loads(out)["state"] in ("queued", "running")) == (130, True)
    assert "goes on" in err
    assert asked("jobs", "cancel", job, "--json")["id"] == job


def test_a_job_is_queued_followed_and_listed(refused, asked, recording):
    queued = asked(
        "train", recording(82), "--model", "cli-queued", "--no-wait", *QUICKLY, "--estimator", "se", "--json"
    )
    job = queued["id"]
    assert "cli-queued (se): succeeded, version 1" in asked("jobs", "follow", job)
    assert asked("jobs", "show", job, "--json")["state"] == "succeeded"
    assert job in [each["id"] for each in asked("jobs", "list", "--json")]
    assert "cli-queued" in asked("jobs", "list")
    assert "conflict" in refused("jobs", "retry", job)


def test_without_options_the_service_holds_out_what_it_does_by_default_and_zero_is_nothing(asked, server, recording):
    path = recording(12, samples=120, rate=10.0)
    job = asked("train", path, "--model", "by-default", *QUICKLY, "--json")
    body = {"model": "by-default", "datasets": job["datasets"], "estimator": "lip-chain"}
    plain = server.client.post("/v1/jobs", json=body).json()
    server.client.post(f"/v1/jobs/{plain['id']}/cancel")
    assert job["holdout"] == plain["holdout"]
    assert (job["holdout"]["kind"], job["holdout"]["share"]) == ("auto", 0.3)
    assert job["quality"]["samples"] > 0
    job = asked("train", path, "--model", "by-default", *QUICKLY, "--hold-out", 0, "--json")
    assert (job["holdout"], job["quality"]) == (None, None)
