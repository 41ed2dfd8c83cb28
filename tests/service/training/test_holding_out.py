"""Held-out data: which rows are held out, how the version is evaluated on them, and that they stay held out."""

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

import lipcore
from lipcore.data.metrics import evaluate
from lipcore.data.samples import Samples
from lipcore.posterior.linalg import NotPositiveDefiniteError
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import inverse_dynamics
from service.models import registry
from service.models.archive_lineage import Lineage
from service.models.lineage import describe_datasets, learnt_from
from service.storage.database import DatasetRow
from service.training import planned_fit, worker
from service.training.holding_out import CannotHoldOutError, find_earlier_split
from service.training.material import load_datasets
from tests.service.data import (
    QUICK,
    arrays,
    columns,
    csv,
    ended,
    error,
    npz,
    post,
    queue,
    service_of,
    stream,
    train,
    upload,
)
from tests.service.models.archives.packing import exported, import_archive

ROWS = 120
TRAIN, HELD_OUT = slice(0, 82), slice(86, ROWS)
"""At 10 Hz the last 36 of 120 rows are held out; 0.25 s before and after the boundary is two rows on each side."""
FIGURES = ("nmse", "rmse", "coverage", "nlpd")


def recording(seed=1):
    return stream(samples=ROWS, rate=10.0, seed=seed)


def post_evaluation(api, model, dataset, **request):
    return api.post(f"/v1/models/{model}/evaluate", json={"dataset": dataset, **request})


def version(api, model, number=1):
    return api.get(f"/v1/models/{model}/versions/{number}").json()


def json_numbers(value):
    """Return the numbers of a JSON value in order, NaN for null."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        return [each for part in value for each in json_numbers(part)]
    return [] if isinstance(value, str) else [np.nan if value is None else value]


def row_indices(samples, result):
    """Return the rows' indices in a recording, found by their torques, which never repeat."""
    known = {row.tobytes(): index for index, row in enumerate(samples.tau)}
    return [known[row.tobytes()] for row in np.ascontiguousarray(result.tau)]


def load_split(api, *datasets, **holdout):
    service = service_of(api)
    request = {"datasets": list(datasets), "holdout": holdout, "joint_types": ["revolute"] * 2}
    return load_datasets(service.database, service.files, request)


def held_out(result):
    """Return the rows by which a job judges its version."""
    return result.held_out.thinned(ROWS * 10)


@pytest.fixture(scope="module")
def dataset(api):
    """A data set of one episode."""
    return upload(api, recording(), name="whole")["id"]


@pytest.fixture(scope="module")
def held_out_model(api, dataset):
    """A model whose training held out the last 30 % of its data set: its name and the job."""
    return "held-out", train(api, "held-out", dataset, holdout={"share": 0.3})


@pytest.fixture(scope="module")
def excluding_model(api, dataset):
    """The name of a model whose version never learns its held-out rows."""
    job = train(api, "kept-out", dataset, holdout={"share": 0.3, "only": True})
    assert job["holdout"]["only"] is True
    return "kept-out"


def test_rest_is_judged_first_and_then_all_rows_are_learnt(api, held_out_model, excluding_model, dataset):
    assert held_out_model[1]["holdout"] == {"kind": "auto", "share": 0.3, "blocks": 10, "guard_s": None, "seed": 0}
    for model, rows, learnt in ((held_out_model[0], ROWS, True), (excluding_model, TRAIN.stop, False)):
        found = version(api, model)
        assert found["fit"]["samples_given"] == rows
        assert (found["lineage"]["holdout"]["learnt"], found["lineage"]["holdout"]["judged_rows"]) == (
            learnt,
            TRAIN.stop,
        )
    result = load_split(api, dataset, share=0.3)
    assert row_indices(recording(), result.samples) == list(range(ROWS))[TRAIN]
    assert row_indices(recording(), held_out(result)) == list(range(ROWS))[HELD_OUT]


def test_lineage_keeps_the_split_and_the_scores(api, held_out_model, dataset):
    reply = version(api, held_out_model[0])["lineage"]["holdout"]
    (entry,) = reply["datasets"]
    assert reply["split"] == held_out_model[1]["holdout"]
    assert (reply["rows"], reply["guarded"], reply["samples"], reply["of"]) == (34, 4, 34, 34)
    assert (entry["id"], entry["whole"], entry["rows"], entry["guarded"]) == (dataset, False, 34, 4)
    assert (entry["guard"], entry["guard_unit"]) == (0.25, "s")


def test_scores_are_of_a_model_without_the_held_out_rows(api, held_out_model, excluding_model):
    service, unseen = service_of(api), recording().rows(HELD_OUT)
    model = lipcore.load(service.files.version_folder(registry.find(service.database, excluding_model, 1).folder))
    metrics = evaluate(unseen.tau, *model.predict(unseen.q, unseen.dq, unseen.ddq).interval)
    for each in (held_out_model[0], excluding_model):
        reply = version(api, each)["lineage"]["holdout"]
        for name in FIGURES:
            np.testing.assert_allclose(reply[name], getattr(metrics, name), rtol=1e-6)


@pytest.mark.parametrize("model", ["held-out", "kept-out"])
def test_evaluation_finds_the_held_out_rows_again(api, held_out_model, excluding_model, dataset, model):
    reply, answer = (
        version(api, model)["lineage"]["holdout"],
        post_evaluation(api, model, dataset, part="held_out").json(),
    )
    assert [answer[name] for name in ("part", "samples", "samples_used", "in_training")] == ["held_out", 34, 34, False]
    assert answer["judged"] is (model == "held-out")
    for name in FIGURES:
        np.testing.assert_allclose(answer[name], reply[name], rtol=1e-6)
    answer = post_evaluation(api, model, dataset).json()
    assert (answer["part"], answer["samples"], answer["in_training"], answer["judged"]) == ("all", ROWS, True, False)


def test_evaluation_of_the_judged_fit_is_complete(api, held_out_model, excluding_model, dataset):
    judged, computed = (
        post_evaluation(api, model, dataset, part="held_out").json() for model in ("held-out", "kept-out")
    )
    for name in computed.keys() - {"model", "judged"}:
        if name in ("coverages", "reliability", "stretches"):
            np.testing.assert_allclose(json_numbers(judged[name]), json_numbers(computed[name]), rtol=1e-6)
        elif isinstance(computed[name], list) and name not in ("joint_names", "warnings"):
            np.testing.assert_allclose(judged[name], computed[name], rtol=1e-6)
        else:
            assert judged[name] == computed[name], name


def test_trace_of_held_out_rows_says_if_they_were_learnt(api, held_out_model, excluding_model, dataset):
    for model, learnt in ((held_out_model[0], True), (excluding_model, False)):
        answer = api.post(f"/v1/models/{model}/trace", json={"dataset": dataset, "part": "held_out"}).json()
        assert (answer["samples"], answer["in_training"]) == (34, learnt)


def resting_joint_recording():
    """Return a recording whose second joint rests until the held-out part."""
    samples, share = stream(samples=ROWS, rate=10.0, seed=11), np.ones((ROWS, 2))
    share[: HELD_OUT.start, 1] = 0.0
    motion = [share * each for each in (samples.q, samples.dq, samples.ddq)]
    tau = inverse_dynamics(load_robot("double-pendulum"), *motion)
    return replace(samples, q=motion[0], dq=motion[1], ddq=motion[2], tau=tau)


@pytest.mark.slow
def test_version_learns_motion_that_only_held_out_rows_have(api):
    dataset, other = (
        upload(api, each)["id"] for each in (resting_joint_recording(), stream(samples=60, rate=10.0, seed=12))
    )
    errors = {}
    for model, only in (("moves-late", False), ("never-moves", True)):
        train(api, model, dataset, holdout={"kind": "last", "share": 0.3, "only": only})
        errors[model] = post_evaluation(api, model, other).json()["nmse"]
    assert max(errors["moves-late"]) < 0.1 * max(errors["never-moves"])
    reply = [version(api, model)["lineage"]["holdout"]["nmse"] for model in errors]
    np.testing.assert_allclose(*reply, rtol=1e-6)


def test_failed_fit_on_all_rows_keeps_the_judged_model(api, dataset, monkeypatch):
    service = service_of(api)
    monkeypatch.setattr(service.jobs, "submit", lambda job: None)

    def fails(model, task):
        raise NotPositiveDefiniteError("the matrix is\nsingular")

    monkeypatch.setattr(planned_fit, "refit", fails)
    name = queue(api, "fails-late", dataset, holdout={"share": 0.3})["id"]
    worker.run(service.settings, name)
    assert ended(api, name)["state"] == "succeeded"
    found = version(api, "fails-late")
    assert found["fit"]["samples_given"] == TRAIN.stop
    assert found["lineage"]["holdout"]["learnt"] is False
    assert found["warnings"][0] == (
        "The final fit, on all rows, failed (NotPositiveDefiniteError: the matrix is singular). "
        "The model has not learnt the held-out rows."
    )
    answer = post_evaluation(api, "fails-late", dataset, part="held_out").json()
    assert (answer["judged"], answer["in_training"]) == (False, False)


def test_equal_samples_uploaded_again_split_alike(api, held_out_model, dataset):
    again = upload(api, recording(), name="again")["id"]
    answer = post_evaluation(api, held_out_model[0], again, part="held_out").json()
    assert (answer["samples"], answer["in_training"]) == (34, False)
    assert post_evaluation(api, held_out_model[0], again).json()["in_training"] is True
    body = {"model": "m", "datasets": [dataset, again], "holdout": {}}  # otherwise equal samples would be in both parts
    problem = error(api.post("/v1/jobs", json=body), 422, "invalid_request")
    assert problem["detail"][0]["field"] == "datasets[1]"


def test_samples_that_were_not_held_out_are_rejected(api, held_out_model, trained):
    other = upload(api, recording(seed=9))["id"]
    for model in (held_out_model[0], trained.name):
        reply = error(post_evaluation(api, model, other, part="held_out"), 422, "invalid_request")
        assert reply["detail"][0]["field"] == "part"
        assert f"version 1 has no held-out rows of data set {other}" in reply["message"]
    assert (
        error(post_evaluation(api, held_out_model[0], other, part="most"), 422, "invalid_request")["detail"][0]["field"]
        == "part"
    )


@pytest.mark.slow
def test_whole_data_sets_are_held_out_like_episodes(api):
    lengths = (40, 60, 80, 50)
    recorded_ = [stream(samples=length, rate=10.0, seed=20 + length) for length in lengths]
    names = [upload(api, each)["id"] for each in recorded_]
    train(api, "whole-sets", *names, holdout={"kind": "episodes", "share": 0.3})
    reply = version(api, "whole-sets")["lineage"]["holdout"]
    held = [each["id"] for each in reply["datasets"]]
    assert 0 < len(held) < 4
    assert all(each["whole"] for each in reply["datasets"])
    assert reply["rows"] == sum(length for name, length in zip(names, lengths, strict=True) if name in held)
    assert reply["guarded"] == 0
    assert reply["judged_rows"] == sum(lengths) - reply["rows"]
    assert version(api, "whole-sets")["fit"]["samples_given"] == sum(lengths)
    for name, length in zip(names, lengths, strict=True):
        answer = post_evaluation(api, "whole-sets", name).json()
        assert (answer["samples"], answer["in_training"]) == (length, True)
        part = post_evaluation(api, "whole-sets", name, part="held_out")
        assert part.status_code == (200 if name in held else 422)
        if name in held:
            assert (part.json()["samples"], part.json()["judged"]) == (length, True)

    result = load_split(api, *reversed(names), kind="episodes", share=0.3)
    assert {each["id"] for each in result.lineage["holdout"]["datasets"]} == set(held)


def test_data_set_without_times_has_a_guard_in_rows(api):
    table = columns(recording(seed=4))
    del table["t"]
    untimed = post(api, csv(table), "text/csv", joint_names="joint1,joint2").json()["id"]
    result = load_split(api, untimed, share=0.5)
    (entry,) = result.lineage["holdout"]["datasets"]
    assert (entry["guard"], entry["guard_unit"]) == (25.0, "rows")
    assert row_indices(recording(seed=4), result.samples) == list(range(35))
    assert row_indices(recording(seed=4), held_out(result)) == list(range(85, ROWS))
    body = {"model": "m", "datasets": [untimed], "holdout": {"guard_s": 0.1}}
    reply = error(api.post("/v1/jobs", json=body), 422, "invalid_request")
    assert reply["detail"][0]["field"] == "holdout.guard_s"


@pytest.mark.parametrize(
    ("holdout", "field", "message"),
    [
        ({"kind": "rows"}, "holdout.kind", "'episodes', 'last' or 'blocks'"),
        ({"kind": "episodes"}, "holdout.kind", "the data set has only one episode"),
        ({"share": 1.0}, "holdout.share", "less than 1"),
        ({"share": 0.9}, "holdout.share", "it leaves 12 samples to train on, at least 30"),
        ({"blocks": 1}, "holdout.blocks", "greater than or equal to 2"),
        ({"guard": 1}, "holdout.guard", ""),
        ({"kind": "stretches"}, "holdout.stretches", "required if `holdout.kind` is stretches"),
        ({"stretches": {"ds_1": [[0, 9]]}}, "holdout.stretches", "not allowed otherwise"),
        ({"kind": "stretches", "stretches": {"ds_1": [[0, 9]]}}, "holdout.stretches.ds_1", "one of the data sets"),
    ],
)
def test_wrong_holdout_is_rejected(api, dataset, holdout, field, message):
    body = {"model": "m", "datasets": [dataset], "options": QUICK, "holdout": holdout}
    reply = error(api.post("/v1/jobs", json=body), 422, "invalid_request")
    assert reply["detail"][0]["field"] == field
    assert message in reply["message"]


@pytest.mark.parametrize(
    ("stretches", "field", "message"),
    [
        ([[9, 9]], "holdout.stretches.{}", "first < last and last at most 120"),
        ([[50, 60], [40, 45]], "holdout.stretches.{}", "in increasing order"),
        ([[50, 121]], "holdout.stretches.{}", "at most 120"),
        ([[0, 100]], "holdout.stretches", "it leaves 20 samples"),
    ],
)
def test_wrong_holdout_range_is_rejected(api, dataset, stretches, field, message):
    holdout = {"kind": "stretches", "stretches": {dataset: stretches}}
    body = {"model": "m", "datasets": [dataset], "options": QUICK, "holdout": holdout}
    reply = error(api.post("/v1/jobs", json=body), 422, "invalid_request")
    assert reply["detail"][0]["field"] == field.format(dataset)
    assert message in reply["message"]


def test_named_rows_are_held_out_and_found_again(api, dataset):
    other = upload(api, recording(seed=7))["id"]
    holdout = {"kind": "stretches", "stretches": {dataset: [[30, 60], [100, 110]]}}
    result = load_split(api, dataset, other, **holdout)
    assert row_indices(recording(), held_out(result)) == [*range(32, 58), *range(102, 108)]
    assert len(result.samples.t) == ROWS - 32 - 4 * 4 + ROWS
    job = train(api, "named-rows", dataset, other, holdout=holdout)
    assert job["holdout"]["stretches"] == holdout["stretches"]
    answer = post_evaluation(api, "named-rows", dataset, part="held_out").json()
    assert answer["samples"] == 32
    assert answer["in_training"] is False


def test_split_without_training_rows_fails_the_job(api, dataset):
    seen = ended(api, queue(api, "left-nothing", dataset, holdout={"guard_s": 30.0})["id"])
    assert (seen["state"], seen["error"]["code"]) == ("failed", "cannot_hold_out")
    assert f"data set '{dataset}'" in seen["error"]["message"]
    assert "guard_s is 30.0, expected a smaller value" in seen["error"]["message"]


@pytest.mark.slow
def test_refresh_holds_out_the_same_samples(api):
    dataset = upload(api, recording(seed=6))["id"]
    train(api, "refreshed-held", dataset, holdout={"kind": "blocks", "share": 0.3, "blocks": 5})
    before = version(api, "refreshed-held")
    answer = api.post("/v1/models/refreshed-held/refresh", json={})
    assert answer.status_code == 202, answer.text
    seen = ended(api, answer.json()["id"])
    assert seen["state"] == "succeeded", seen
    after = version(api, "refreshed-held", 2)
    for name in ("split", "datasets", "rows", "guarded", "judged_rows"):
        assert after["lineage"]["holdout"][name] == before["lineage"]["holdout"][name]
    assert after["fit"]["samples_given"] == before["fit"]["samples_given"] == ROWS
    compared = after["lineage"]["refresh"]["compared"]
    assert compared == "not compared with version 1, because too few rows are logged"
    assert seen["history"][-1]["message"] == f"version 2 is trained and is dismissed: {compared}"
    answer = post_evaluation(api, "refreshed-held", dataset, part="held_out", version=2).json()
    np.testing.assert_allclose(answer["nmse"], after["lineage"]["holdout"]["nmse"], rtol=1e-6)
    assert answer["in_training"] is False


def test_refresh_excludes_what_its_version_never_learns(api):
    dataset = upload(api, recording(seed=13))["id"]
    train(api, "refreshed-kept", dataset, holdout={"share": 0.3, "only": True})
    seen = ended(api, api.post("/v1/models/refreshed-kept/refresh", json={}).json()["id"])
    assert seen["state"] == "succeeded", seen
    after = version(api, "refreshed-kept", 2)
    assert (after["fit"]["samples_given"], after["lineage"]["holdout"]["learnt"]) == (TRAIN.stop, False)


def test_exported_version_includes_its_split(api, held_out_model, dataset):
    answer = import_archive(api, exported(api, held_out_model[0]), name="came")
    assert answer.status_code == 201, answer.text
    assert answer.json()["lineage"]["holdout"] == version(api, held_out_model[0])["lineage"]["holdout"]
    assert post_evaluation(api, "came", dataset, part="held_out").json()["samples"] == 34


def test_guard_is_a_period_of_the_low_pass(api):
    """With velocities derived at 2 Hz, the filter spreads each sample over half a second."""
    fine: Samples = stream(samples=400, rate=50.0, seed=8)
    answer = post(api, npz(**arrays(fine, "t", "q", "tau"), joint_names=np.array(fine.joint_names)), cutoff=2)
    assert answer.status_code == 201, answer.text
    service, name = service_of(api), answer.json()["id"]
    with service.database.transaction() as session:
        row = session.query(DatasetRow).filter_by(id=name).one()
        row.report = {**row.report, "recipe": {"cutoff_hz": 2.0}}
    result = load_split(api, name, share=0.3)
    assert result.lineage["holdout"]["datasets"][0]["guard"] == 0.5
    assert held_out(result).t[0] - result.samples.t[-1] > 1.0


def periodic(rows=600, seed=1):
    """Return motion at 20 Hz that repeats itself every 5 s."""
    return stream(samples=rows, rate=20.0, seed=seed, course="periodic", speed=2.0)


def test_held_out_rows_that_repeat_training_are_reported_with_period(api):
    """The lineage reports it for held-out rows, an evaluation also for other recordings that repeat."""
    dataset = upload(api, periodic())["id"]
    train(api, "periodic", dataset, holdout={"kind": "last", "share": 0.3})
    reply = version(api, "periodic")["lineage"]["holdout"]
    assert reply["datasets"][0]["stretches"] is None
    assert reply["repeats_training"] > 0.9
    assert reply["period_s"] == pytest.approx(5.0, rel=0.02)
    assert "repeat motion of the training, which repeats every 5 s" in reply["warnings"][0]
    held, again, other = (
        post_evaluation(api, "periodic", name, **part).json()
        for name, part in (
            (dataset, {"part": "held_out"}),
            (upload(api, periodic(rows=200))["id"], {}),
            (upload(api, recording(seed=3))["id"], {}),
        )
    )
    assert {name: held[name] for name in ("repeats_training", "period_s", "warnings")} == {
        name: reply[name] for name in ("repeats_training", "period_s", "warnings")
    }
    assert again["repeats_training"] > 0.9
    assert other["repeats_training"] < 0.3
    assert other["warnings"] == []
    inside = post_evaluation(api, "periodic", dataset).json()
    assert (inside["in_training"], inside["repeats_training"], inside["warnings"]) == (True, None, [])


def test_automatic_split_holds_out_a_part_without_repetition(api):
    """The motion is aperiodic first and periodic later, so the last part repeats earlier rows."""
    free, again = stream(samples=200, rate=20.0, seed=2, speed=20.0), periodic(500)
    names = ("q", "dq", "ddq", "tau")
    both = {name: np.concatenate([getattr(each, name) for each in (free, again)]) for name in names}
    samples = Samples(free.joint_names, np.arange(700) / 20.0, np.zeros(700, np.int64), **both)
    dataset = upload(api, samples)["id"]
    result = load_split(api, dataset, share=0.3)
    (entry,) = result.lineage["holdout"]["datasets"]
    ((first, last),) = entry["stretches"]
    assert first == 0
    assert last == pytest.approx(200, abs=100)  # a period
    assert row_indices(samples, held_out(result)) == list(range(last - 5))  # a quarter of a second of guard
    split = find_earlier_split(DatasetRow(id=dataset, sha256="?"), result.lineage)
    assert np.flatnonzero(split.held_out(samples.episode, samples.t)).tolist() == list(range(last - 5))
    assert load_split(api, dataset, share=0.3, kind="last").lineage["holdout"]["datasets"][0]["stretches"] is None


ENTRY = {"id": "ds_1", "sha256": "s", "whole": False, "guard": 0.25, "guard_unit": "s", "rows": 34, "guarded": 4}
HOLDOUT = {"split": {"share": 0.3}, "datasets": [ENTRY], "rows": 34, "guarded": 4, "nmse": [0.1]}
EPISODE, TIMES = np.zeros(120, dtype=np.int64), np.arange(120) / 10


def test_lineage_names_the_data_preparation():
    report = {"rows": 5, "recipe": {"cutoff_hz": 4.0}, "steps": [{"step": "trim", "text": "5 rows cut off"}]}
    row = DatasetRow(id="ds_1", name="n", sha256="s", rows=5, report=report)
    record = {"id": "ds_1", "name": "n", "sha256": "s", "rows": 5}
    assert describe_datasets([row]) == [{**record, "recipe": report["recipe"], "steps": report["steps"]}]
    assert describe_datasets([DatasetRow(id="ds_1", name="n", sha256="s", rows=5, report={"rows": 5})]) == [record]


def test_data_sets_without_learnt_rows_are_not_in_training():
    datasets = [{"id": "ds_1", "sha256": "s"}, {"id": "ds_2", "sha256": "r"}]
    assert learnt_from({"datasets": datasets, "holdout": HOLDOUT}) == {"ds_1", "s", "ds_2", "r"}
    entire = {**HOLDOUT, "datasets": [{**ENTRY, "whole": True}]}
    assert learnt_from({"datasets": datasets, "holdout": entire}) == {"ds_2", "r"}
    assert learnt_from({"datasets": datasets, "holdout": {**entire, "learnt": True}}) == {"ds_1", "s", "ds_2", "r"}
    assert learnt_from({}) == frozenset()


@pytest.mark.parametrize("row", [DatasetRow(id="ds_1", sha256="?"), DatasetRow(id="ds_9", sha256="s")])
def test_data_set_is_recognised_by_id_or_samples(row):
    assert find_earlier_split(DatasetRow(id="ds_9", sha256="?"), {"holdout": HOLDOUT}) is None
    assert find_earlier_split(row, {}) is None
    split = find_earlier_split(row, {"holdout": HOLDOUT})
    assert np.flatnonzero(split.held_out(EPISODE, TIMES)).tolist() == list(range(86, 120))


@pytest.mark.parametrize("counts", [{"rows": 35}, {"guarded": 3}, {"stretches": [[0, 30]]}])
def test_inconsistent_split_in_a_lineage_is_rejected(counts):
    """If the counts do not match, the samples may not be the held-out ones."""
    reply = {**HOLDOUT, "datasets": [{**ENTRY, **counts}]}
    with pytest.raises(CannotHoldOutError, match="cannot be split as before"):
        find_earlier_split(DatasetRow(id="ds_1", sha256="s"), {"holdout": reply}).held_out(EPISODE, TIMES)


@pytest.mark.parametrize(
    "holdout",
    [
        {**HOLDOUT, "split": {"kind": "rows"}},
        {**HOLDOUT, "datasets": [{**ENTRY, "guard": -1.0}]},
        {**HOLDOUT, "datasets": [{**ENTRY, "rows": "3"}]},
        {**HOLDOUT, "datasets": [{**ENTRY, "stretches": [[0, 3, 4]]}]},
        {**HOLDOUT, "datasets": [{**ENTRY, "stretches": [[-1, 3]]}]},
        3,
    ],
)
def test_holdout_of_an_imported_lineage_is_checked(holdout):
    Lineage.model_validate({"holdout": HOLDOUT})
    with pytest.raises(ValidationError):
        Lineage.model_validate({"holdout": holdout})
