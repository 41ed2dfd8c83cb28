"""Whether a trained version answers by itself: judged by what was held out of its training, unless it shall in any
case."""

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from service.contract.models import HeldOutBlocks, Promotion
from service.models.registry import serving_version
from service.storage.database import LearnerRow, VersionRow
from service.training.promotion import settle
from tests.service.archives.packing import TAR, exported
from tests.service.data import QUICK, ended, error, queue, service_of, stream, train, upload
from tests.service.learning.lessons import publish

ROWS, HELD = 120, {"share": 0.3}
QUERY = {"q": [0.1, 0.2], "dq": [0.0, 0.0], "ddq": [0.0, 0.0]}
CUT = 84
"""Rows of a recording that are learnt from."""


def recording(api, seed, spoilt=None, amount=5.0):
    """The id of a data set: a pendulum, with white noise of so many N·m on some of its torque."""
    samples = stream(samples=ROWS, rate=10.0, seed=seed)
    if spoilt is not None:
        tau = samples.tau.copy()
        tau[spoilt] += amount * np.random.default_rng(seed).standard_normal(tau[spoilt].shape)
        samples = replace(samples, tau=tau)
    return upload(api, samples)["id"]


def version(api, model, number):
    return api.get(f"/v1/models/{model}/versions/{number}").json()


def reason(api, model, number):
    return version(api, model, number)["promotion"]["reason"]


@pytest.fixture(scope="module")
def judged(api):
    """A model whose version 1 answers, and 2 to 4 were judged: what was held out of 2 is noisier than what it has
    learnt, as of 4, which was to answer in any case; 3 has learnt from noise, and is as unsure as it should be."""
    narrow, noisy = recording(api, 32, slice(CUT, None)), recording(api, 34, slice(0, CUT - 10), 20.0)
    train(api, "judged", recording(api, 31))
    jobs = [train(api, "judged", each, holdout=HELD, promotion="ask") for each in (narrow, noisy)]
    jobs.append(train(api, "judged", narrow, holdout=HELD, promotion="always"))
    return jobs


def outcome(api, number):
    found = version(api, "judged", number)["promotion"]
    return found["answers"], found["passed"], found["serving"]


def test_without_a_held_out_part_a_version_is_not_judged_and_answers_only_where_that_is_asked_for(api, judged):
    assert outcome(api, 1) == (True, None, None)
    assert reason(api, "judged", 1) == "not judged, as nothing was held out; it answers as was asked for"
    train(api, "unjudged", recording(api, 31), promotion="ask")
    found = version(api, "unjudged", 1)["promotion"]
    assert (found["answers"], found["passed"], found["reason"]) == (False, None, "not judged, as nothing was held out")


def test_a_version_whose_intervals_are_too_narrow_waits(api, judged):
    assert outcome(api, 2) == (False, False, 1)
    why = reason(api, "judged", 2)
    assert "the 95 % intervals hold less than 90 % of what was held out: joint1" in why
    assert "independent errors" in why
    assert judged[0]["history"][-1]["message"] == f"version 2 is trained and waits as candidate: {why}"


def test_a_version_that_predicts_worse_waits(api, judged):
    assert outcome(api, 3) == (False, False, 1)
    assert "it predicts what was held out worse than version 1" in reason(api, "judged", 3)
    assert min(version(api, "judged", 3)["lineage"]["holdout"]["coverage"]) > 0.9


def test_a_version_answers_where_that_is_asked_for(api, judged):
    assert judged[2]["promotion"] == "always"
    assert outcome(api, 4) == (True, False, 1)
    assert reason(api, "judged", 4).endswith("it answers as was asked for")


def test_the_newest_that_waits_has_the_alias_candidate_and_answers_once_it_is_let(api, judged):
    model = api.get("/v1/models/judged").json()
    assert (model["serving_version"], model["aliases"]) == (4, {"candidate": 3})
    for asked, answers in (({}, 4), ({"alias": "candidate"}, 3)):
        assert api.post("/v1/models/judged/predict", json=QUERY | asked).json()["version"] == answers
    with service_of(api).database.session() as session:
        roles = [session.get_one(LearnerRow, ("judged", number)).role for number in (2, 3)]
    assert roles == ["dismissed"] * 2  # in no contest

    moved = api.put("/v1/models/judged/aliases/serving", json={"alias": "candidate"})
    assert moved.status_code == 200, moved.text
    assert api.post("/v1/models/judged/predict", json=QUERY).json()["version"] == 3
    assert outcome(api, 3) == (False, False, 1)  # as it was once it was trained
    problem = error(api.delete("/v1/models/judged/versions/3"), 409, "conflict")
    assert "'candidate'" in problem["message"]
    assert api.delete("/v1/models/judged/versions/2").status_code == 204


def test_a_first_version_that_fails_waits_and_its_model_has_no_answer_until_it_is_promoted(api):
    train(api, "first-bad", recording(api, 35, slice(CUT, None)), holdout=HELD, promotion="ask")
    found = version(api, "first-bad", 1)["promotion"]
    assert (found["answers"], found["passed"], found["serving"]) == (False, False, None)
    model = api.get("/v1/models/first-bad").json()
    assert (model["serving_version"], model["aliases"]) == (None, {"candidate": 1})
    assert [each["alias"] for each in api.get("/v1/models/first-bad/aliases").json()["items"]] == ["candidate"]
    shown = next(each for each in api.get("/v1/overview").json()["items"] if each["name"] == "first-bad")
    assert (shown["serving_version"], shown["candidate"]) == (None, 1)

    where = "/v1/models/first-bad"
    rows = {"t": [0.0], "q": [[0.1, 0.2]], "dq": [[0.0, 0.0]], "ddq": [[0.0, 0.0]], "tau": [[0.0, 0.0]]}
    for refused in (
        api.post(f"{where}/predict", json=QUERY),
        api.post(f"{where}/observations", json={"stream_id": "s", "sequence": 0, **rows}),
        api.get(f"{where}/export"),
        api.post(f"{where}/aliases/serving/rollback", json={}),
    ):
        code = "conflict" if "rollback" in str(refused.request.url) else "no_serving_version"
        said = error(refused, 409, code)["message"]
        assert code == "conflict" or "`lipserve models promote first-bad 1`" in said
    answer = api.post("/v2/models/first-bad/infer", json={"inputs": []})
    assert answer.status_code == 409
    assert "`lipserve models promote first-bad 1`" in answer.json()["error"]

    assert api.delete(f"{where}/aliases/candidate").status_code == 204
    assert "only one" in error(api.delete(f"{where}/versions/1"), 409, "conflict")["message"]
    assert api.put(f"{where}/aliases/serving", json={"version": 1}).status_code == 200
    assert api.post(f"{where}/predict", json=QUERY).json()["version"] == 1


def test_what_is_no_motion_of_this_torque_does_not_answer(api):
    samples = stream(samples=ROWS, rate=10.0, seed=33)
    others = replace(samples, tau=stream(samples=ROWS, rate=10.0, seed=36).tau)
    train(api, "others", upload(api, others)["id"], holdout=HELD, promotion="ask")
    assert "its error is not below that of the mean torque: joint1" in reason(api, "others", 1)


def test_models_keep_their_robot(api):
    train(api, "kept", recording(api, 41))
    other = stream(samples=ROWS, rate=10.0, seed=31)
    other = upload(api, replace(other, joint_names=("elbow", "wrist")))["id"]
    body = {"model": "kept", "datasets": [other], "estimator": "lip-chain", "options": QUICK}
    for path in ("/v1/jobs", "/v1/jobs/check"):
        said = error(api.post(path, json=body), 409, "conflict")["message"]
        assert "joint_names of its version 1: joint1, joint2; of this one: elbow, wrist" in said

    train(api, "of-other", other)
    archive = exported(api, "of-other")
    said = error(api.post("/v1/models/import?name=kept", content=archive, headers=TAR), 409, "conflict")["message"]
    assert "of this one: elbow, wrist" in said
    service = service_of(api)
    with service.database.session() as session:
        folder = service.files.version_folder(session.get_one(VersionRow, ("of-other", 1)).folder)
    publish(service.database, service.files, folder, "kept", candidate=True)  # as an earlier release has let it in
    for move in (
        api.put("/v1/models/kept/aliases/serving", json={"version": 2}),
        api.put("/v1/models/kept/aliases/spare", json={"version": 2}),
        api.post("/v1/models/kept/rollback", json={"version": 2}),
    ):
        assert "of this one: elbow, wrist" in error(move, 409, "conflict")["message"]
    assert api.get("/v1/models/kept").json()["serving_version"] == 1


def test_versions_that_learnt_the_same_held_out_rows_are_compared_as_they_were_judged(api):
    """A row of the table: what version 1 holds out, what version 2 holds out, and what is said of both."""
    dataset = recording(api, 37)
    fair, unfair = "than version 1: negative log density", "not compared with version 1, which was trained on what was"
    kept = {**HELD, "only": True}
    cases = [(HELD, HELD, fair), (kept, HELD, fair), (HELD, kept, fair), (kept, kept, fair)]
    cases += [(HELD, {"share": 0.4}, unfair), (None, HELD, unfair)]
    said = []
    for number, (before, now, expected) in enumerate(cases):
        for holdout in (before, now):
            train(api, f"again-{number}", dataset, holdout=holdout)
        said.append(reason(api, f"again-{number}", 2))
        assert expected in said[-1], (before, now)
    assert len(set(said[:4])) == 1  # the very same numbers, however they are told


def test_a_retrained_version_that_is_worse_waits_though_the_serving_one_has_learnt_what_is_held_out(api):
    dataset = recording(api, 40)
    train(api, "worse", dataset, holdout=HELD)
    train(api, "worse", dataset, holdout=HELD, estimator="se", promotion="ask")
    assert "it predicts what was held out worse than version 1" in reason(api, "worse", 2)
    assert api.get("/v1/models/worse").json()["serving_version"] == 1


@pytest.mark.parametrize(
    "change", [{"rows": [34]}, {"nlpd": [0.0]}, {"nmse": []}, {"rows": [0, 34]}, {"nlpd": ["1", 2]}]
)
def test_scores_of_a_judged_fit_from_elsewhere_are_checked(change):
    blocks = {"rows": [10, 24], "nlpd": [1.0, 2.0], "nmse": [0.1, None]}
    assert HeldOutBlocks.model_validate(blocks).nmse[1] is None
    with pytest.raises(ValidationError):
        HeldOutBlocks.model_validate({**blocks, **change})


def test_a_version_waits_where_another_has_begun_to_answer_since_it_was_judged(api, judged):
    with service_of(api).database.session() as session:
        now = serving_version(session, "judged")
        good = Promotion(answers=True, passed=True, serving=now + 1, reason="")
        found = settle(session, "judged", good, "ask")
        assert (found.answers, found.serving) == (False, now)
        assert f"version {now} answers since it was judged" in found.reason
        assert settle(session, "judged", good, "always") is good
        assert settle(session, "judged", good.model_copy(update={"serving": now}), "ask").answers


@pytest.mark.parametrize("option", ["never", True])
def test_other_options_are_refused(api, option):
    body = {"model": "m", "datasets": [recording(api, 31)], "promotion": option}
    assert error(api.post("/v1/jobs", json=body), 422, "invalid_request")["detail"][0]["field"] == "promotion"


def test_a_retry_keeps_the_option(api):
    job = queue(api, "again", recording(api, 39), holdout={"guard_s": 30.0}, promotion="always")
    assert ended(api, job["id"])["state"] == "failed"
    again = api.post(f"/v1/jobs/{job['id']}/retry", json={})
    assert again.json()["promotion"] == "always"
    ended(api, again.json()["id"])
