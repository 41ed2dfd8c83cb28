"""Promotion: a trained version serves if its held-out data pass, or if the request demands it."""

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from lipcore.model.texts import NOTHING_HELD_OUT
from service.contract.holdout import HeldOutBlocks
from service.contract.models import Promotion
from service.models.registry import serving_version
from service.storage.database import LearnerRow, VersionRow
from service.training.promotion import settle
from tests.service.data import QUICK, ended, error, queue, service_of, stream, train, upload
from tests.service.learning.learning_models import publish
from tests.service.models.archives.packing import TAR, exported
from tests.service.models.versions import predict, predict_json
from tests.service.training.conftest import version_of

ROWS, HELD = 120, {"share": 0.3}
CUT = 84
"""The number of rows of a recording that are learnt."""


def upload_recording(api, seed, spoilt=None, amount=5.0):
    """Upload a pendulum with white noise of so many N·m on some of its torque; return the data set's id."""
    samples = stream(samples=ROWS, rate=10.0, seed=seed)
    if spoilt is not None:
        tau = samples.tau.copy()
        tau[spoilt] += amount * np.random.default_rng(seed).standard_normal(tau[spoilt].shape)
        samples = replace(samples, tau=tau)
    return upload(api, samples)["id"]


def reason(api, model, number):
    return version_of(api, model, number)["promotion"]["reason"]


def promotion(api, model, number):
    found = version_of(api, model, number)["promotion"]
    return found["answers"], found["serving"]


def level(api, model, number):
    return version_of(api, model, number)["verdict"]["level"]


@pytest.fixture(scope="module")
def judged_jobs(api):
    """Jobs of a model with four versions. Version 1 serves. The held-out part of 2 and 4 is noisier than their training
    rows; 4 is promoted always. Version 3 has learnt from noise, and its intervals are as wide as they should be."""
    narrow, noisy = (
        upload_recording(api, 32, slice(CUT, None), 0.3),
        upload_recording(api, 34, slice(0, CUT - 10), 10.0),
    )
    train(api, "judged", upload_recording(api, 31))
    jobs = [train(api, "judged", each, holdout=HELD, promotion="ask") for each in (narrow, noisy)]
    jobs.append(train(api, "judged", narrow, holdout=HELD, promotion="always"))
    return jobs


@pytest.mark.slow
def test_version_without_held_out_data_serves_only_on_request(api, judged_jobs):
    why = f"Not judged. {NOTHING_HELD_OUT}"
    train(api, "unjudged", upload_recording(api, 31), promotion="ask")
    assert promotion(api, "judged", 1) == (True, None)
    assert reason(api, "judged", 1) == f"{why} It serves, because `promotion` is always."
    assert promotion(api, "unjudged", 1) == (False, None)
    assert reason(api, "unjudged", 1) == why


def test_version_that_fails_on_held_out_data_serves_only_if_the_request_demands_it(api, judged_jobs):
    assert [promotion(api, "judged", number) for number in (2, 3, 4)] == [(False, 1), (False, 1), (True, 1)]
    assert [level(api, "judged", number) for number in (2, 4)] == ["wrong", "wrong"]
    narrow, worse, demanded = (reason(api, "judged", number) for number in (2, 3, 4))
    assert narrow.startswith("Wrong. The 95 % intervals are too narrow: joint1")
    assert "effective samples" in narrow
    assert judged_jobs[0]["history"][-1]["message"] == f"version 2 is trained and is a candidate: {narrow}"
    assert worse.startswith("Wrong. The errors are no smaller than with the mean torque: joint1")
    assert min(version_of(api, "judged", 3)["lineage"]["holdout"]["coverage"]) > 0.9
    assert judged_jobs[2]["promotion"] == "always"
    assert demanded.endswith("It serves, because `promotion` is always.")


def test_newest_candidate_has_an_alias_and_can_be_promoted(api, judged_jobs):
    model = api.get("/v1/models/judged").json()
    assert (model["serving_version"], model["aliases"]) == (4, {"candidate": 3})
    assert [predict_json(api, "judged", **chosen)["version"] for chosen in ({}, {"alias": "candidate"})] == [4, 3]
    with service_of(api).database.session() as session:
        roles = [session.get_one(LearnerRow, ("judged", number)).role for number in (2, 3)]
    assert roles == ["dismissed"] * 2  # the learner compares neither of them

    moved = api.put("/v1/models/judged/aliases/serving", json={"alias": "candidate"})
    assert moved.status_code == 200, moved.text
    assert predict_json(api, "judged")["version"] == 3
    assert promotion(api, "judged", 3) == (False, 1)  # recorded at the end of the training
    assert "'candidate'" in error(api.delete("/v1/models/judged/versions/3"), 409, "conflict")["message"]
    assert api.delete("/v1/models/judged/versions/2").status_code == 204


def test_model_has_no_serving_version_if_its_first_fails(api):
    train(api, "first-bad", upload_recording(api, 35, slice(CUT, None)), holdout=HELD, promotion="ask")
    assert promotion(api, "first-bad", 1) == (False, None)
    model = api.get("/v1/models/first-bad").json()
    assert (model["serving_version"], model["aliases"]) == (None, {"candidate": 1})
    assert [each["alias"] for each in api.get("/v1/models/first-bad/aliases").json()["items"]] == ["candidate"]
    shown = next(each for each in api.get("/v1/overview").json()["items"] if each["name"] == "first-bad")
    assert (shown["serving_version"], shown["candidate"]) == (None, 1)

    where, hint = "/v1/models/first-bad", "`lipserve models promote first-bad 1`"
    rows = {"t": [0.0], "q": [[0.1, 0.2]], "dq": [[0.0, 0.0]], "ddq": [[0.0, 0.0]], "tau": [[0.0, 0.0]]}
    for refused in (
        predict(api, "first-bad"),
        api.post(f"{where}/observations", json={"stream_id": "s", "sequence": 0, **rows}),
        api.get(f"{where}/export"),
    ):
        assert hint in error(refused, 409, "no_serving_version")["message"]
    error(api.post(f"{where}/aliases/serving/rollback", json={}), 409, "conflict")
    answer = api.post("/v2/models/first-bad/infer", json={"inputs": []})
    assert answer.status_code == 409
    assert hint in answer.json()["error"]

    assert api.delete(f"{where}/aliases/candidate").status_code == 204
    assert "only version" in error(api.delete(f"{where}/versions/1"), 409, "conflict")["message"]
    assert api.put(f"{where}/aliases/serving", json={"version": 1}).status_code == 200
    assert predict_json(api, "first-bad")["version"] == 1


def test_motion_unrelated_to_the_torque_does_not_serve(api):
    samples = stream(samples=ROWS, rate=10.0, seed=33)
    others = replace(samples, tau=stream(samples=ROWS, rate=10.0, seed=36).tau)
    train(api, "others", upload(api, others)["id"], holdout=HELD, promotion="ask")
    assert "The errors are no smaller than with the mean torque: joint1" in reason(api, "others", 1)


def test_versions_of_a_model_have_one_robot(api):
    difference = "its version 1 has joint_names joint1, joint2; this one has elbow, wrist"
    train(api, "kept", upload_recording(api, 41))
    other = stream(samples=ROWS, rate=10.0, seed=31)
    other = upload(api, replace(other, joint_names=("elbow", "wrist")))["id"]
    train(api, "of-other", other)
    service = service_of(api)
    with service.database.session() as session:
        folder = service.files.version_folder(session.get_one(VersionRow, ("of-other", 1)).folder)
    publish(service.database, service.files, folder, "kept", candidate=True)  # an earlier release allowed it
    body = {"model": "kept", "datasets": [other], "estimator": "lip-chain", "options": QUICK}
    for refused in (
        api.post("/v1/jobs", json=body),
        api.post("/v1/jobs/check", json=body),
        api.post("/v1/models/import?name=kept", content=exported(api, "of-other"), headers=TAR),
        api.put("/v1/models/kept/aliases/serving", json={"version": 2}),
        api.put("/v1/models/kept/aliases/spare", json={"version": 2}),
        api.post("/v1/models/kept/rollback", json={"version": 2}),
    ):
        assert difference in error(refused, 409, "conflict")["message"]
    assert api.get("/v1/models/kept").json()["serving_version"] == 1


@pytest.mark.slow
def test_versions_with_equal_held_out_rows_are_compared_by_their_scores(api):
    """Each row has what versions 1 and 2 hold out, and the reason that both get."""
    dataset = upload_recording(api, 37)
    fair, unfair = (
        "than those of version 1 (negative log density",
        "not compared with version 1, which was trained",
    )
    kept = {**HELD, "only": True}
    cases = [(HELD, HELD, fair), (kept, HELD, fair), (HELD, kept, fair), (kept, kept, fair)]
    cases += [(HELD, {"share": 0.4}, unfair), (None, HELD, unfair)]
    reasons = []
    for number, (before, now, expected) in enumerate(cases):
        for holdout in (before, now):
            train(api, f"again-{number}", dataset, holdout=holdout)
        reasons.append(reason(api, f"again-{number}", 2))
        assert expected in reasons[-1], (before, now)
    assert len(set(reasons[:4])) == 1  # the numbers do not depend on how they were computed


@pytest.mark.slow
def test_worse_retrained_version_is_a_candidate(api):
    dataset = upload_recording(api, 40)
    train(api, "worse", dataset, holdout=HELD)
    train(api, "worse", dataset, holdout=HELD, estimator="se", promotion="ask")
    assert "Its predictions of the held-out rows are worse than those of version 1" in reason(api, "worse", 2)
    assert api.get("/v1/models/worse").json()["serving_version"] == 1


@pytest.mark.parametrize(
    "change", [{"rows": [34]}, {"nlpd": [0.0]}, {"nmse": []}, {"rows": [0, 34]}, {"nlpd": ["1", 2]}]
)
def test_imported_scores_of_a_judged_fit_are_checked(change):
    blocks = {"rows": [10, 24], "nlpd": [1.0, 2.0], "nmse": [0.1, None]}
    assert HeldOutBlocks.model_validate(blocks).nmse[1] is None
    with pytest.raises(ValidationError):
        HeldOutBlocks.model_validate({**blocks, **change})


def test_version_is_a_candidate_if_the_serving_one_has_changed(api, judged_jobs):
    with service_of(api).database.session() as session:
        now = serving_version(session, "judged")
        good = Promotion(answers=True, serving=now + 1, reason="")
        found = settle(session, "judged", good, "ask")
        assert (found.answers, found.serving) == (False, now)
        assert f"not compared with version {now}" in found.reason
        assert settle(session, "judged", good, "always") is good
        assert settle(session, "judged", good.model_copy(update={"serving": now}), "ask").answers


def test_retry_keeps_the_promotion_option(api):
    job = queue(api, "again", upload_recording(api, 39), holdout={"guard_s": 30.0}, promotion="always")
    assert ended(api, job["id"])["state"] == "failed"
    again = api.post(f"/v1/jobs/{job['id']}/retry", json={})
    assert again.json()["promotion"] == "always"
    ended(api, again.json()["id"])
