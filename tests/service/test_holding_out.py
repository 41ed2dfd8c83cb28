"""Holding data out of training: what is left out, how the version does on it, and that it stays left out."""

from __future__ import annotations

import numpy as np
import pytest

import lipcore
from lipcore.data.metrics import evaluate
from lipcore.data.samples import Samples
from service.models import registry
from service.storage.database import DatasetRow, JobRow
from service.training.material import recorded
from tests.service.data import (
    QUICK,
    arrays,
    columns,
    csv,
    ended,
    error,
    job,
    npz,
    post,
    queue,
    service_of,
    stream,
    train,
    upload,
)

ROWS = 120
TRAIN, HELD_OUT = slice(0, 82), slice(86, ROWS)
"""At 10 Hz the last 36 of 120 rows are held out, and 0.25 s before and after the boundary is two rows on each side."""
FIGURES = ("nmse", "rmse", "coverage", "nlpd")


def recording(seed=1):
    return stream(samples=ROWS, rate=10.0, seed=seed)


def upload_episodes(api, samples, episode):
    body = npz(**arrays(samples), episode=np.asarray(episode), joint_names=np.array(samples.joint_names))
    answer = post(api, body)
    assert answer.status_code == 201, answer.text
    return answer.json()["id"]


def ask(api, model, dataset, **request):
    return api.post(f"/v1/models/{model}/evaluate", json={"dataset": dataset, **request})


def version(api, model, number=1):
    return api.get(f"/v1/models/{model}/versions/{number}").json()


def rows_of(samples, found):
    """Which rows of a recording these are, by their torques, which never repeat."""
    known = {row.tobytes(): index for index, row in enumerate(samples.tau)}
    return [known[row.tobytes()] for row in np.ascontiguousarray(found.tau)]


def material(api, *datasets, **holdout):
    service = service_of(api)
    request = {"datasets": list(datasets), "holdout": holdout}
    return recorded(service.settings, service.database, service.files, request)


@pytest.fixture(scope="module")
def dataset(api):
    """A data set of one episode."""
    return upload(api, recording(), name="whole")["id"]


@pytest.fixture(scope="module")
def held(api, dataset):
    """A model whose training held out the last 30 % of its data set; its name and the job."""
    return "held-out", train(api, "held-out", dataset, holdout={"share": 0.3})


def test_a_job_says_what_it_holds_out(held):
    assert held[1]["holdout"] == {"kind": "last", "share": 0.3, "blocks": 10, "guard_s": None, "seed": 0}


def test_only_the_rest_is_trained_on(api, held, dataset):
    assert version(api, held[0])["fit"]["samples_given"] == TRAIN.stop
    found = material(api, dataset, share=0.3)
    assert rows_of(recording(), found.samples) == list(range(ROWS))[TRAIN]
    assert rows_of(recording(), found.held_out[0]) == list(range(ROWS))[HELD_OUT]


def test_the_lineage_keeps_the_split_and_the_figures(api, held, dataset):
    said = version(api, held[0])["lineage"]["holdout"]
    (entry,) = said["datasets"]
    assert said["split"] == held[1]["holdout"]
    assert (said["rows"], said["guarded"], said["samples"], said["of"]) == (34, 4, 34, 34)
    assert (entry["id"], entry["whole"], entry["rows"], entry["guarded"]) == (dataset, False, 34, 4)
    assert (entry["guard"], entry["guard_unit"]) == (0.25, "s")

    service, unseen = service_of(api), recording().rows(HELD_OUT)
    model = lipcore.load(service.files.version_folder(registry.find(service.database, held[0], 1).folder))
    answer = model.predict(unseen.q, unseen.dq, unseen.ddq)
    metrics = evaluate(unseen.tau, answer.tau, answer.tau_std, answer.noise_std)
    for name in FIGURES:
        np.testing.assert_allclose(said[name], getattr(metrics, name), rtol=1e-6)


def test_an_evaluation_finds_the_same_samples_again(api, held, dataset):
    said, answer = version(api, held[0])["lineage"]["holdout"], ask(api, held[0], dataset, part="held_out").json()
    assert (answer["part"], answer["samples"], answer["samples_used"], answer["in_training"]) == (
        "held_out",
        34,
        34,
        False,
    )
    for name in FIGURES:
        np.testing.assert_allclose(answer[name], said[name], rtol=1e-6)


def test_the_whole_data_set_is_still_in_training(api, held, dataset):
    answer = ask(api, held[0], dataset).json()
    assert (answer["part"], answer["samples"], answer["in_training"]) == ("all", ROWS, True)


def test_the_same_samples_uploaded_again_split_alike(api, held):
    again = upload(api, recording(), name="again")["id"]
    answer = ask(api, held[0], again, part="held_out").json()
    assert (answer["samples"], answer["in_training"]) == (34, False)
    assert ask(api, held[0], again).json()["in_training"] is True


def test_what_was_not_held_out_cannot_be_asked_for(api, held, trained):
    other = upload(api, recording(seed=9))["id"]
    for model in (held[0], trained.name):
        said = error(ask(api, model, other, part="held_out"), 422, "invalid_request")
        assert said["detail"][0]["field"] == "part"
        assert f"version 1 has held nothing out of data set {other}" in said["message"]
    assert error(ask(api, held[0], other, part="most"), 422, "invalid_request")["detail"][0]["field"] == "part"


@pytest.mark.parametrize("kind", ["episodes", "last", "blocks"])
def test_sides_are_apart_in_every_kind(api, kind):
    """Twelve episodes of one recording without pauses, as gaps leave them: rows within 0.25 s are on no two sides."""
    samples, episode = recording(), np.arange(ROWS) // 10
    found = material(api, upload_episodes(api, samples, episode), kind=kind, share=0.4, blocks=6)
    learnt, held = rows_of(samples, found.samples), rows_of(samples, found.held_out[0])
    assert not set(learnt) & set(held)
    assert min(abs(first - second) for first in learnt for second in held) == 5
    assert 24 <= len(held) <= 48
    if kind == "episodes":
        assert not set(episode[learnt]) & set(episode[held])
    # where rows are missing between, a new episode begins: differences across it would be no noise
    for part in (found.samples, found.held_out[0]):
        steps = np.diff(rows_of(samples, part))
        np.testing.assert_array_equal(steps[np.diff(part.episode) == 0], 1)


def test_whole_data_sets_stand_for_episodes(api):
    lengths = (40, 60, 80, 50)
    recorded_ = [stream(samples=length, rate=10.0, seed=20 + length) for length in lengths]
    names = [upload(api, each)["id"] for each in recorded_]
    train(api, "whole-sets", *names, holdout={"kind": "episodes", "share": 0.3})
    said = version(api, "whole-sets")["lineage"]["holdout"]
    held = [each["id"] for each in said["datasets"]]
    assert 0 < len(held) < 4
    assert all(each["whole"] for each in said["datasets"])
    assert said["rows"] == sum(length for name, length in zip(names, lengths, strict=True) if name in held)
    assert said["guarded"] == 0
    assert version(api, "whole-sets")["fit"]["samples_given"] == sum(lengths) - said["rows"]
    for name, length in zip(names, lengths, strict=True):
        answer = ask(api, "whole-sets", name).json()
        assert (answer["samples"], answer["in_training"]) == (length, name not in held)
        part = ask(api, "whole-sets", name, part="held_out")
        assert part.status_code == (200 if name in held else 422)

    found = material(api, *reversed(names), kind="episodes", share=0.3)
    assert {each["id"] for each in found.lineage["holdout"]["datasets"]} == set(held)


def test_a_data_set_of_one_episode_beside_larger_ones_is_learnt(api, dataset):
    many = upload_episodes(api, recording(seed=3), np.arange(ROWS) // 20)
    found = material(api, dataset, many, kind="episodes", share=0.3)
    assert [each["id"] for each in found.lineage["holdout"]["datasets"]] == [many]
    assert len(found.samples) + len(found.held_out[0]) + found.lineage["holdout"]["guarded"] == 2 * ROWS


def test_a_data_set_without_times_has_a_guard_in_rows(api):
    table = columns(recording(seed=4))
    del table["t"]
    untimed = post(api, csv(table), "text/csv", joint_names="joint1,joint2").json()["id"]
    found = material(api, untimed, share=0.5)
    (entry,) = found.lineage["holdout"]["datasets"]
    assert (entry["guard"], entry["guard_unit"]) == (25.0, "rows")
    assert rows_of(recording(seed=4), found.samples) == list(range(35))
    assert rows_of(recording(seed=4), found.held_out[0]) == list(range(85, ROWS))
    body = {"model": "m", "datasets": [untimed], "holdout": {"guard_s": 0.1}}
    said = error(api.post("/v1/jobs", json=body), 422, "invalid_request")
    assert said["detail"][0]["field"] == "holdout.guard_s"


@pytest.mark.parametrize(
    ("holdout", "field", "message"),
    [
        ({"kind": "rows"}, "holdout.kind", "'episodes', 'last' or 'blocks'"),
        ({"kind": "episodes"}, "holdout.kind", "the data set is one episode"),
        ({"share": 0}, "holdout.share", "greater than 0"),
        ({"share": 1.0}, "holdout.share", "less than 1"),
        ({"share": 0.9}, "holdout.share", "it leaves 12 samples to train on, at least 30"),
        ({"blocks": 1}, "holdout.blocks", "greater than or equal to 2"),
        ({"guard_s": -1}, "holdout.guard_s", "greater than or equal to 0"),
        ({"guard": 1}, "holdout.guard", ""),
        (0.3, "holdout", ""),
    ],
)
def test_holdouts_that_are_refused(api, dataset, holdout, field, message):
    body = {"model": "m", "datasets": [dataset], "options": QUICK, "holdout": holdout}
    said = error(api.post("/v1/jobs", json=body), 422, "invalid_request")
    assert said["detail"][0]["field"] == field
    assert message in said["message"]


def test_the_same_samples_may_not_be_on_both_sides(api, dataset):
    twin = upload(api, recording())["id"]
    body = {"model": "m", "datasets": [dataset, twin], "holdout": {}}
    said = error(api.post("/v1/jobs", json=body), 422, "invalid_request")
    assert said["detail"][0]["field"] == "datasets[1]"


def test_a_split_that_leaves_nothing_fails_the_job(api, dataset):
    seen = ended(api, queue(api, "left-nothing", dataset, holdout={"guard_s": 30.0})["id"])
    assert (seen["state"], seen["error"]["code"]) == ("failed", "cannot_hold_out")
    assert f"data set '{dataset}'" in seen["error"]["message"]
    assert "further than 30 s" in seen["error"]["message"]


def test_a_repeated_job_holds_out_the_same(no_worker):
    dataset = upload(no_worker, recording())["id"]
    options = {"hyperparameter_samples": 20, "posterior_samples": 30, "max_iterations": 2}
    before = queue(no_worker, "repeated", dataset, options=options, holdout={"kind": "blocks", "seed": 3})
    no_worker.post(f"/v1/jobs/{before['id']}/cancel")
    again = no_worker.post(f"/v1/jobs/{before['id']}/retry").json()
    assert again["holdout"] == before["holdout"]
    assert again["holdout"]["seed"] == 3
    no_worker.post(f"/v1/jobs/{again['id']}/cancel")

    # a job of an earlier release, which knew of no such thing
    with service_of(no_worker).database.transaction() as session:
        row = session.get_one(JobRow, session.query(JobRow.seq).filter_by(id=again["id"]).scalar())
        row.request = {name: value for name, value in row.request.items() if name != "holdout"}
    assert job(no_worker, again["id"])["holdout"] is None
    old = no_worker.post(f"/v1/jobs/{again['id']}/retry").json()
    assert (old["retry_of"], old["holdout"]) == (again["id"], None)
    no_worker.post(f"/v1/jobs/{old['id']}/cancel")


def test_a_refresh_leaves_the_same_samples_out(api):
    dataset = upload(api, recording(seed=6))["id"]
    train(api, "refreshed-held", dataset, holdout={"kind": "blocks", "share": 0.3, "blocks": 5})
    before = version(api, "refreshed-held")
    answer = api.post("/v1/models/refreshed-held/refresh", json={})
    assert answer.status_code == 202, answer.text
    seen = ended(api, answer.json()["id"])
    assert seen["state"] == "succeeded", seen
    after = version(api, "refreshed-held", 2)
    for name in ("split", "datasets", "rows", "guarded"):
        assert after["lineage"]["holdout"][name] == before["lineage"]["holdout"][name]
    assert after["fit"]["samples_given"] == before["fit"]["samples_given"] < ROWS
    answer = ask(api, "refreshed-held", dataset, part="held_out", version=2).json()
    np.testing.assert_allclose(answer["nmse"], after["lineage"]["holdout"]["nmse"], rtol=1e-6)
    assert answer["in_training"] is False


def test_an_exported_version_takes_its_split_with_it(api, held, dataset):
    archive = api.get(f"/v1/models/{held[0]}/export").content
    answer = api.post(
        "/v1/models/import", params={"name": "came"}, content=archive, headers={"content-type": "application/x-tar"}
    )
    assert answer.status_code == 201, answer.text
    assert answer.json()["lineage"]["holdout"] == version(api, held[0])["lineage"]["holdout"]
    assert ask(api, "came", dataset, part="held_out").json()["samples"] == 34


def test_the_guard_is_a_period_of_the_low_pass_that_was_used(api):
    """Velocities derived at 2 Hz: each sample was spread over half a second."""
    fine: Samples = stream(samples=400, rate=50.0, seed=8)
    answer = post(api, npz(**arrays(fine, "t", "q", "tau"), joint_names=np.array(fine.joint_names)), cutoff=2)
    assert answer.status_code == 201, answer.text
    service, name = service_of(api), answer.json()["id"]
    with service.database.transaction() as session:
        row = session.query(DatasetRow).filter_by(id=name).one()
        row.report = {**row.report, "recipe": {"cutoff_hz": 2.0}}
    found = material(api, name, share=0.3)
    assert found.lineage["holdout"]["datasets"][0]["guard"] == 0.5
    assert found.held_out[0].t[0] - found.samples.t[-1] > 1.0
