"""Tests of the verdict on twelve models of known quality, in the API and on the command line."""

from dataclasses import replace

import numpy as np
import pytest

from lipcore.model.verdict import LEVELS
from lipserve import StreamClient
from service.cli.wording import in_shell
from tests.service.data import error, train, upload
from tests.service.server import Server
from tests.service.training.verdict_cases import CASES, ROBOT, good, other_robot, train_cases


@pytest.fixture(scope="module")
def asking(tmp_path_factory):
    """A service that promotes only usable versions, with a model for each case."""
    with Server(tmp_path_factory.mktemp("verdicts"), warm=True, LIPSERVE_PROMOTION="ask") as server:
        yield server, train_cases(server.client)


@pytest.mark.parametrize("name", CASES)
def test_verdict_is_the_same_in_api_and_command_line(asking, lipserve, name):
    (server, jobs), case = asking, CASES[name]
    model, number = jobs[name]["model"], jobs[name]["version"]
    shown = server.client.get(f"/v1/models/{model}/versions/{number}").json()
    verdict = shown["verdict"]
    assert (verdict["level"], case.words in verdict["reason"]) == (case.level, True), verdict["reason"]
    assert jobs[name]["verdict"] == verdict
    code, text, err = lipserve("models", "show", f"{model}@{number}", "--url", server.url)
    printed = " ".join(text.split())
    assert (code, f"{verdict['label']}: {in_shell(verdict['reason'])}" in printed) == (0, True), f"{printed} {err}"
    assert shown["promotion"]["answers"] == case.serves
    assert verdict["reason"] in shown["promotion"]["reason"]


@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.level in ("wrong", "too_uncertain")])
def test_version_that_is_not_usable_serves_only_by_override(asking, lipserve, name):
    server, jobs = asking
    model, number = jobs[name]["model"], jobs[name]["version"]
    before = server.client.get(f"/v1/models/{model}").json()["serving_version"]
    where = f"/v1/models/{model}/aliases/serving"
    refusal = error(server.client.put(where, json={"version": number}), 409, "conflict")
    assert CASES[name].words in refusal["message"]
    code, _, refused = lipserve("models", "promote", model, number, "--url", server.url)
    assert (code, "`--override`" in refused) == (1, True)
    assert server.client.get(f"/v1/models/{model}").json()["serving_version"] == before


BEST = {
    "mirrored-sign": "wrong",
    "wrong-order": "wrong",
    "gravity-missing": "wrong",
    "other-robot": "wrong",
    "short": "not_judged",
    "repeated-motion": "usable_in_range",
    "at-rest-only": "usable_in_range",
}
"""Level of the best verdict that a recording allows; `usable` for the other recordings."""


@pytest.mark.parametrize("name", CASES)
def test_recording_limits_the_verdict_of_its_models(asking, lipserve, name):
    server, jobs = asking
    dataset = jobs[name]["datasets"][0]
    best = server.client.get(f"/v1/datasets/{dataset}").json()["learnability"]
    assert best["level"] == BEST.get(name, "usable"), best["reason"]
    assert LEVELS.index(best["level"]) >= LEVELS.index(jobs[name]["verdict"]["level"])
    code, text, _ = lipserve("data", "show", dataset, "--url", server.url)
    assert (code, f"can be {best['label']} at best: {in_shell(best['reason'])}" in " ".join(text.split())) == (0, True)


def test_recording_of_another_robot_waits_for_approval(asking):
    """Without a URDF, only the serving version shows that the arm is another one."""
    server, _ = asking
    data = upload(server.client, other_robot())["id"]
    on_other = server.client.post("/v1/models/good/evaluate", json={"dataset": data, "version": 1}).json()["verdict"]
    assert (on_other["level"], on_other["judged_on"]) == ("wrong", "recording")
    holdout = {"share": 0.3, "kind": "last"}
    job = train(
        server.client, "good", data, estimator="rigid-body", robot=ROBOT, options={}, holdout=holdout, promotion=None
    )
    version = server.client.get(f"/v1/models/good/versions/{job['version']}").json()
    assert version["verdict"]["serves"]
    assert not version["promotion"]["answers"]
    assert "the errors of version 1 are no smaller than with the mean torque" in version["promotion"]["reason"]


def test_evaluation_names_a_fault_of_the_recording(asking):
    server, _ = asking
    samples = good(seed=4)
    data = upload(server.client, replace(samples, tau=samples.tau * [1, -1]), robot=ROBOT)["id"]
    verdict = server.client.post("/v1/models/good/evaluate", json={"dataset": data, "version": 1}).json()["verdict"]
    assert verdict["level"] == "not_judged"
    assert "joint2 has the opposite sign" in verdict["reason"]
    assert data in verdict["action"]


def test_thresholds_of_a_model_change_its_verdicts(asking, lipserve):
    server, jobs = asking
    model = jobs["repeated-motion"]["model"]
    text = lipserve("models", "thresholds", model, "--max-width", "0.005", "--url", server.url)[1]
    assert "0.005 times" in text
    shown = server.client.get(f"/v1/models/{model}").json()
    assert shown["thresholds"] == {"max_error": 0.9, "min_coverage": 0.9, "max_width": 0.005}
    verdict = shown["versions"][0]["verdict"]
    assert (verdict["level"], shown["serving_version"]) == ("too_uncertain", 1)
    dataset = jobs["repeated-motion"]["datasets"][0]
    asked = {"dataset": dataset, "part": "held_out"}
    assert server.client.post(f"/v1/models/{model}/evaluate", json=asked).json()["verdict"]["level"] == "too_uncertain"
    error(server.client.put(f"/v1/models/{model}/aliases/safe", json={"version": 1}), 409, "conflict")
    assert error(server.client.put(f"/v1/models/{model}/thresholds", json={"max_error": 2}), 422, "invalid_request")


def test_running_stream_keeps_its_version_after_a_refusal_and_follows_an_override(asking):
    server, jobs = asking
    where, number = "/v1/models/good/aliases/serving", jobs["other-robot"]["version"]
    motion = np.zeros((3, 2))
    with StreamClient("good", url=server.url) as stream:
        assert stream.predict(*motion).version == 1
        error(server.client.put(where, json={"version": number}), 409, "conflict")
        assert stream.predict(*motion).version == 1
        assert server.client.put(where, json={"version": number, "override": True}).status_code == 200
        assert stream.predict(*motion).version == number
        assert server.client.post(f"{where}/rollback", json={}).json()["version"] == 1
        assert stream.predict(*motion).version == 1
