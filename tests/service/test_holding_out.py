"""Holding data out of training: what is left out, how the version does on it, and that it stays left out."""

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
from tests.service.archives.packing import exported, send
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

ROWS = 120
TRAIN, HELD_OUT = slice(0, 82), slice(86, ROWS)
"""At 10 Hz the last 36 of 120 rows are held out, and 0.25 s before and after the boundary is two rows on each side."""
FIGURES = ("nmse", "rmse", "coverage", "nlpd")


def recording(seed=1):
    return stream(samples=ROWS, rate=10.0, seed=seed)


def ask(api, model, dataset, **request):
    return api.post(f"/v1/models/{model}/evaluate", json={"dataset": dataset, **request})


def version(api, model, number=1):
    return api.get(f"/v1/models/{model}/versions/{number}").json()


def numbers(value):
    """The numbers of a JSON value in order, NaN for null."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        return [each for part in value for each in numbers(part)]
    return [] if isinstance(value, str) else [np.nan if value is None else value]


def rows_of(samples, result):
    """Which rows of a recording these are, by their torques, which never repeat."""
    known = {row.tobytes(): index for index, row in enumerate(samples.tau)}
    return [known[row.tobytes()] for row in np.ascontiguousarray(result.tau)]


def material(api, *datasets, **holdout):
    service = service_of(api)
    request = {"datasets": list(datasets), "holdout": holdout, "joint_types": ["revolute"] * 2}
    return load_datasets(service.database, service.files, request)


def held_out(result):
    """The rows that a job judges by."""
    return result.held_out.thinned(ROWS * 10)


@pytest.fixture(scope="module")
def dataset(api):
    """A data set of one episode."""
    return upload(api, recording(), name="whole")["id"]


@pytest.fixture(scope="module")
def held(api, dataset):
    """A model whose training held out the last 30 % of its data set; its name and the job."""
    return "held-out", train(api, "held-out", dataset, holdout={"share": 0.3})


@pytest.fixture(scope="module")
def kept(api, dataset):
    """A model whose version never learns what was held out; its name."""
    job = train(api, "kept-out", dataset, holdout={"share": 0.3, "only": True})
    assert job["holdout"]["only"] is True
    return "kept-out"


def test_only_the_rest_is_judged_and_then_all_is_learnt(api, held, kept, dataset):
    assert held[1]["holdout"] == {"kind": "auto", "share": 0.3, "blocks": 10, "guard_s": None, "seed": 0}
    for model, rows, learnt in ((held[0], ROWS, True), (kept, TRAIN.stop, False)):
        found = version(api, model)
        assert found["fit"]["samples_given"] == rows
        assert (found["lineage"]["holdout"]["learnt"], found["lineage"]["holdout"]["judged_rows"]) == (
            learnt,
            TRAIN.stop,
        )
    result = material(api, dataset, share=0.3)
    assert rows_of(recording(), result.samples) == list(range(ROWS))[TRAIN]
    assert rows_of(recording(), held_out(result)) == list(range(ROWS))[HELD_OUT]


def test_the_lineage_keeps_the_split_and_the_figures(api, held, dataset):
    reply = version(api, held[0])["lineage"]["holdout"]
    (entry,) = reply["datasets"]
    assert reply["split"] == held[1]["holdout"]
    assert (reply["rows"], reply["guarded"], reply["samples"], reply["of"]) == (34, 4, 34, 34)
    assert (entry["id"], entry["whole"], entry["rows"], entry["guarded"]) == (dataset, False, 34, 4)
    assert (entry["guard"], entry["guard_unit"]) == (0.25, "s")


def test_the_figures_are_those_of_a_model_that_has_not_learnt_what_was_held_out(api, held, kept):
    service, unseen = service_of(api), recording().rows(HELD_OUT)
    model = lipcore.load(service.files.version_folder(registry.find(service.database, kept, 1).folder))
    metrics = evaluate(unseen.tau, *model.predict(unseen.q, unseen.dq, unseen.ddq).interval)
    for each in (held[0], kept):
        reply = version(api, each)["lineage"]["holdout"]
        for name in FIGURES:
            np.testing.assert_allclose(reply[name], getattr(metrics, name), rtol=1e-6)


@pytest.mark.parametrize("model", ["held-out", "kept-out"])
def test_an_evaluation_finds_the_same_samples_again(api, held, kept, dataset, model):
    reply, answer = version(api, model)["lineage"]["holdout"], ask(api, model, dataset, part="held_out").json()
    assert [answer[name] for name in ("part", "samples", "samples_used", "in_training")] == ["held_out", 34, 34, False]
    assert answer["judged"] is (model == "held-out")
    for name in FIGURES:
        np.testing.assert_allclose(answer[name], reply[name], rtol=1e-6)
    answer = ask(api, model, dataset).json()
    assert (answer["part"], answer["samples"], answer["in_training"], answer["judged"]) == ("all", ROWS, True, False)


def test_an_evaluation_of_the_judged_fit_is_complete(api, held, kept, dataset):
    judged, computed = (ask(api, model, dataset, part="held_out").json() for model in ("held-out", "kept-out"))
    for name in computed.keys() - {"model", "judged"}:
        if name in ("coverages", "reliability", "stretches"):
            np.testing.assert_allclose(numbers(judged[name]), numbers(computed[name]), rtol=1e-6)
        elif isinstance(computed[name], list) and name not in ("joint_names", "warnings"):
            np.testing.assert_allclose(judged[name], computed[name], rtol=1e-6)
        else:
            assert judged[name] == computed[name], name


def test_a_trace_of_what_was_held_out_says_whether_it_was_learnt(api, held, kept, dataset):
    for model, learnt in ((held[0], True), (kept, False)):
        answer = api.post(f"/v1/models/{model}/trace", json={"dataset": dataset, "part": "held_out"}).json()
        assert (answer["samples"], answer["in_training"]) == (34, learnt)


def resting():
    """A recording whose second joint rests until the part that is held out."""
    samples, share = stream(samples=ROWS, rate=10.0, seed=11), np.ones((ROWS, 2))
    share[: HELD_OUT.start, 1] = 0.0
    motion = [share * each for each in (samples.q, samples.dq, samples.ddq)]
    tau = inverse_dynamics(load_robot("double-pendulum"), *motion)
    return replace(samples, q=motion[0], dq=motion[1], ddq=motion[2], tau=tau)


def test_a_version_has_learnt_motion_that_only_the_held_out_part_has(api):
    dataset, other = (upload(api, each)["id"] for each in (resting(), stream(samples=60, rate=10.0, seed=12)))
    errors = {}
    for model, only in (("moves-late", False), ("never-moves", True)):
        train(api, model, dataset, holdout={"kind": "last", "share": 0.3, "only": only})
        errors[model] = ask(api, model, other).json()["nmse"]
    assert max(errors["moves-late"]) < 0.1 * max(errors["never-moves"])
    reply = [version(api, model)["lineage"]["holdout"]["nmse"] for model in errors]
    np.testing.assert_allclose(*reply, rtol=1e-6)


def test_a_fit_on_all_rows_that_fails_leaves_the_judged_model(api, dataset, monkeypatch):
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
        "The last fit, on all rows, failed (NotPositiveDefiniteError: the matrix is singular). "
        "The model has not learnt the rows held out."
    )
    answer = ask(api, "fails-late", dataset, part="held_out").json()
    assert (answer["judged"], answer["in_training"]) == (False, False)


def test_the_same_samples_uploaded_again_split_alike(api, held, dataset):
    again = upload(api, recording(), name="again")["id"]
    answer = ask(api, held[0], again, part="held_out").json()
    assert (answer["samples"], answer["in_training"]) == (34, False)
    assert ask(api, held[0], again).json()["in_training"] is True
    body = {"model": "m", "datasets": [dataset, again], "holdout": {}}  # which would be on both sides
    problem = error(api.post("/v1/jobs", json=body), 422, "invalid_request")
    assert problem["detail"][0]["field"] == "datasets[1]"


def test_what_was_not_held_out_cannot_be_asked_for(api, held, trained):
    other = upload(api, recording(seed=9))["id"]
    for model in (held[0], trained.name):
        reply = error(ask(api, model, other, part="held_out"), 422, "invalid_request")
        assert reply["detail"][0]["field"] == "part"
        assert f"version 1 has held nothing out of data set {other}" in reply["message"]
    assert error(ask(api, held[0], other, part="most"), 422, "invalid_request")["detail"][0]["field"] == "part"


def test_whole_data_sets_stand_for_episodes(api):
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
        answer = ask(api, "whole-sets", name).json()
        assert (answer["samples"], answer["in_training"]) == (length, True)
        part = ask(api, "whole-sets", name, part="held_out")
        assert part.status_code == (200 if name in held else 422)
        if name in held:
            assert (part.json()["samples"], part.json()["judged"]) == (length, True)

    result = material(api, *reversed(names), kind="episodes", share=0.3)
    assert {each["id"] for each in result.lineage["holdout"]["datasets"]} == set(held)


def test_a_data_set_without_times_has_a_guard_in_rows(api):
    table = columns(recording(seed=4))
    del table["t"]
    untimed = post(api, csv(table), "text/csv", joint_names="joint1,joint2").json()["id"]
    result = material(api, untimed, share=0.5)
    (entry,) = result.lineage["holdout"]["datasets"]
    assert (entry["guard"], entry["guard_unit"]) == (25.0, "rows")
    assert rows_of(recording(seed=4), result.samples) == list(range(35))
    assert rows_of(recording(seed=4), held_out(result)) == list(range(85, ROWS))
    body = {"model": "m", "datasets": [untimed], "holdout": {"guard_s": 0.1}}
    reply = error(api.post("/v1/jobs", json=body), 422, "invalid_request")
    assert reply["detail"][0]["field"] == "holdout.guard_s"


@pytest.mark.parametrize(
    ("holdout", "field", "message"),
    [
        ({"kind": "rows"}, "holdout.kind", "'episodes', 'last' or 'blocks'"),
        ({"kind": "episodes"}, "holdout.kind", "the data set is one episode"),
        ({"share": 1.0}, "holdout.share", "less than 1"),
        ({"share": 0.9}, "holdout.share", "it leaves 12 samples to train on, at least 30"),
        ({"blocks": 1}, "holdout.blocks", "greater than or equal to 2"),
        ({"guard": 1}, "holdout.guard", ""),
        ({"kind": "stretches"}, "holdout.stretches", "rows, where `kind` is stretches"),
        ({"stretches": {"ds_1": [[0, 9]]}}, "holdout.stretches", "and only there"),
        ({"kind": "stretches", "stretches": {"ds_1": [[0, 9]]}}, "holdout.stretches.ds_1", "one of the data sets"),
    ],
)
def test_holdouts_that_are_refused(api, dataset, holdout, field, message):
    body = {"model": "m", "datasets": [dataset], "options": QUICK, "holdout": holdout}
    reply = error(api.post("/v1/jobs", json=body), 422, "invalid_request")
    assert reply["detail"][0]["field"] == field
    assert message in reply["message"]


@pytest.mark.parametrize(
    ("stretches", "field", "message"),
    [
        ([[9, 9]], "holdout.stretches.{}", "a first and a larger last row, at most 120"),
        ([[50, 60], [40, 45]], "holdout.stretches.{}", "in order"),
        ([[50, 121]], "holdout.stretches.{}", "at most 120"),
        ([[0, 100]], "holdout.stretches", "it leaves 20 samples"),
    ],
)
def test_stretches_that_are_refused(api, dataset, stretches, field, message):
    holdout = {"kind": "stretches", "stretches": {dataset: stretches}}
    body = {"model": "m", "datasets": [dataset], "options": QUICK, "holdout": holdout}
    reply = error(api.post("/v1/jobs", json=body), 422, "invalid_request")
    assert reply["detail"][0]["field"] == field.format(dataset)
    assert message in reply["message"]


def test_rows_that_are_named_are_held_out_and_found_again(api, dataset):
    other = upload(api, recording(seed=7))["id"]
    holdout = {"kind": "stretches", "stretches": {dataset: [[30, 60], [100, 110]]}}
    result = material(api, dataset, other, **holdout)
    assert rows_of(recording(), held_out(result)) == [*range(32, 58), *range(102, 108)]
    assert len(result.samples.t) == ROWS - 32 - 4 * 4 + ROWS
    job = train(api, "named-rows", dataset, other, holdout=holdout)
    assert job["holdout"]["stretches"] == holdout["stretches"]
    answer = ask(api, "named-rows", dataset, part="held_out").json()
    assert answer["samples"] == 32
    assert answer["in_training"] is False


def test_a_split_that_leaves_nothing_fails_the_job(api, dataset):
    seen = ended(api, queue(api, "left-nothing", dataset, holdout={"guard_s": 30.0})["id"])
    assert (seen["state"], seen["error"]["code"]) == ("failed", "cannot_hold_out")
    assert f"data set '{dataset}'" in seen["error"]["message"]
    assert "further than 30 s" in seen["error"]["message"]


def test_a_refresh_leaves_the_same_samples_out(api):
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
    assert compared == "too few rows are logged to compare it with version 1"
    assert seen["history"][-1]["message"] == f"version 2 is trained and is dismissed: {compared}"
    answer = ask(api, "refreshed-held", dataset, part="held_out", version=2).json()
    np.testing.assert_allclose(answer["nmse"], after["lineage"]["holdout"]["nmse"], rtol=1e-6)
    assert answer["in_training"] is False


def test_a_refresh_keeps_out_what_its_version_never_learns(api):
    dataset = upload(api, recording(seed=13))["id"]
    train(api, "refreshed-kept", dataset, holdout={"share": 0.3, "only": True})
    seen = ended(api, api.post("/v1/models/refreshed-kept/refresh", json={}).json()["id"])
    assert seen["state"] == "succeeded", seen
    after = version(api, "refreshed-kept", 2)
    assert (after["fit"]["samples_given"], after["lineage"]["holdout"]["learnt"]) == (TRAIN.stop, False)


def test_an_exported_version_takes_its_split_with_it(api, held, dataset):
    answer = send(api, exported(api, held[0]), name="came")
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
    result = material(api, name, share=0.3)
    assert result.lineage["holdout"]["datasets"][0]["guard"] == 0.5
    assert held_out(result).t[0] - result.samples.t[-1] > 1.0


def periodic(rows=600, seed=1):
    """Motion at 20 Hz that repeats itself every 5 s."""
    return stream(samples=rows, rate=20.0, seed=seed, course="periodic", speed=2.0)


def test_what_repeats_the_training_is_said_to_with_its_period(api):
    """In the lineage and in an evaluation, of what was held out and of another recording; motion of another kind is
    not."""
    dataset = upload(api, periodic())["id"]
    train(api, "periodic", dataset, holdout={"kind": "last", "share": 0.3})
    reply = version(api, "periodic")["lineage"]["holdout"]
    assert reply["datasets"][0]["stretches"] is None
    assert reply["repeats_training"] > 0.9
    assert reply["period_s"] == pytest.approx(5.0, rel=0.02)
    assert "repeat motion that was trained on, which repeats every 5 s" in reply["warnings"][0]
    held, again, other = (
        ask(api, "periodic", name, **part).json()
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
    inside = ask(api, "periodic", dataset).json()
    assert (inside["in_training"], inside["repeats_training"], inside["warnings"]) == (True, None, [])


def test_by_itself_a_part_is_held_out_that_repeats_nothing_and_is_found_again(api):
    """Motion that goes on, then periods: the last part repeats what comes before."""
    free, again = stream(samples=200, rate=20.0, seed=2, speed=20.0), periodic(500)
    names = ("q", "dq", "ddq", "tau")
    both = {name: np.concatenate([getattr(each, name) for each in (free, again)]) for name in names}
    samples = Samples(free.joint_names, np.arange(700) / 20.0, np.zeros(700, np.int64), **both)
    dataset = upload(api, samples)["id"]
    result = material(api, dataset, share=0.3)
    (entry,) = result.lineage["holdout"]["datasets"]
    ((first, last),) = entry["stretches"]
    assert first == 0
    assert last == pytest.approx(200, abs=100)  # a period
    assert rows_of(samples, held_out(result)) == list(range(last - 5))  # a quarter of a second of guard
    split = find_earlier_split(DatasetRow(id=dataset, sha256="?"), result.lineage)
    assert np.flatnonzero(split.held_out(samples.episode, samples.t)).tolist() == list(range(last - 5))
    assert material(api, dataset, share=0.3, kind="last").lineage["holdout"]["datasets"][0]["stretches"] is None


ENTRY = {"id": "ds_1", "sha256": "s", "whole": False, "guard": 0.25, "guard_unit": "s", "rows": 34, "guarded": 4}
HOLDOUT = {"split": {"share": 0.3}, "datasets": [ENTRY], "rows": 34, "guarded": 4, "nmse": [0.1]}
EPISODE, TIMES = np.zeros(120, dtype=np.int64), np.arange(120) / 10


def test_lineages_name_how_data_were_prepared():
    report = {"rows": 5, "recipe": {"cutoff_hz": 4.0}, "steps": [{"step": "trim", "text": "5 rows cut off"}]}
    row = DatasetRow(id="ds_1", name="n", sha256="s", rows=5, report=report)
    record = {"id": "ds_1", "name": "n", "sha256": "s", "rows": 5}
    assert describe_datasets([row]) == [{**record, "recipe": report["recipe"], "steps": report["steps"]}]
    assert describe_datasets([DatasetRow(id="ds_1", name="n", sha256="s", rows=5, report={"rows": 5})]) == [record]


def test_data_sets_that_nothing_was_learnt_of_are_not_in_training():
    datasets = [{"id": "ds_1", "sha256": "s"}, {"id": "ds_2", "sha256": "r"}]
    assert learnt_from({"datasets": datasets, "holdout": HOLDOUT}) == {"ds_1", "s", "ds_2", "r"}
    entire = {**HOLDOUT, "datasets": [{**ENTRY, "whole": True}]}
    assert learnt_from({"datasets": datasets, "holdout": entire}) == {"ds_2", "r"}
    assert learnt_from({"datasets": datasets, "holdout": {**entire, "learnt": True}}) == {"ds_1", "s", "ds_2", "r"}
    assert learnt_from({}) == frozenset()


@pytest.mark.parametrize("row", [DatasetRow(id="ds_1", sha256="?"), DatasetRow(id="ds_9", sha256="s")])
def test_a_data_set_is_known_by_its_id_or_its_samples(row):
    assert find_earlier_split(DatasetRow(id="ds_9", sha256="?"), {"holdout": HOLDOUT}) is None
    assert find_earlier_split(row, {}) is None
    split = find_earlier_split(row, {"holdout": HOLDOUT})
    assert np.flatnonzero(split.held_out(EPISODE, TIMES)).tolist() == list(range(86, 120))


@pytest.mark.parametrize("counts", [{"rows": 35}, {"guarded": 3}, {"stretches": [[0, 30]]}])
def test_a_lineage_that_splits_otherwise_is_not_believed(counts):
    """Counts that do not fit: the samples may not be those that were held out."""
    reply = {**HOLDOUT, "datasets": [{**ENTRY, **counts}]}
    with pytest.raises(CannotHoldOutError, match="does not split as it did"):
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
def test_holdouts_of_lineages_from_elsewhere_are_checked(holdout):
    Lineage.model_validate({"holdout": HOLDOUT})
    with pytest.raises(ValidationError):
        Lineage.model_validate({"holdout": holdout})
