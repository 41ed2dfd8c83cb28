"""Held-out data: which rows are held out, how the version is evaluated on them, and that they stay held out."""

from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest

import lipcore
from lipcore.data.metrics import evaluate
from lipcore.data.samples import Samples
from lipcore.posterior.linalg import NotPositiveDefiniteError
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import inverse_dynamics
from service.models import registry
from service.storage.database import DatasetRow
from service.training import planned_fit
from service.training.holding_out import find_earlier_split
from service.training.material import load_datasets
from tests.service.data import QUICK, arrays, columns, csv, ended, npz, post, queue, service_of, stream, train, upload
from tests.service.models.archives.packing import exported, imported
from tests.service.training.conftest import assert_invalid, refresh, version_of
from tests.service.training.held_out import ENTRY, ROWS

TRAIN, HELD_OUT = slice(0, 82), slice(86, ROWS)
"""At 10 Hz the last 36 of 120 rows are held out; 0.25 s before and after the boundary is two rows on each side."""
FIGURES = ("nmse", "rmse", "coverage", "nlpd")
REPETITION = ("repeats_training", "period_s", "warnings")


def recording(seed=1):
    return stream(samples=ROWS, rate=10.0, seed=seed)


def post_evaluation(api, model, dataset, **request):
    return api.post(f"/v1/models/{model}/evaluate", json={"dataset": dataset, **request})


def evaluation(api, model, dataset, **request):
    return post_evaluation(api, model, dataset, **request).json()


def record_of(api, model, number=1):
    return version_of(api, model, number)["lineage"]["holdout"]


def assert_figures(found, expected):
    """Compare the scores of two JSON objects."""
    for name in FIGURES:
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-6)


def json_numbers(value):
    """Return the numbers of a JSON value in order, NaN for null."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        return [each for part in value for each in json_numbers(part)]
    return [] if isinstance(value, str) else [np.nan if value is None else value]


def row_indices(samples, part):
    """Return the rows' indices in a recording, found by their torques, which never repeat."""
    known = {row.tobytes(): index for index, row in enumerate(samples.tau)}
    return [known[row.tobytes()] for row in np.ascontiguousarray(part.tau)]


def load_split(api, *datasets, **holdout):
    """Return the learnt samples, those by which a job judges its version, and the record of the split."""
    service = service_of(api)
    request = {"datasets": list(datasets), "holdout": holdout, "joint_types": ["revolute"] * 2}
    result = load_datasets(service.database, service.files, request)
    return result.samples, result.held_out.thinned(ROWS * 10), result.lineage["holdout"]


@pytest.fixture(scope="module")
def dataset(api):
    """A data set of one episode."""
    return upload(api, recording(), name="whole")["id"]


@pytest.fixture(scope="module")
def jobs(api, dataset):
    """The jobs of two models that hold out the last 30 % of their data set; `kept-out` never learns these rows."""
    splits = {"held-out": {"share": 0.3}, "kept-out": {"share": 0.3, "only": True}}
    return {model: train(api, model, dataset, holdout=split) for model, split in splits.items()}


both_models = pytest.mark.parametrize(("model", "learnt"), [("held-out", True), ("kept-out", False)])


def test_split_leaves_a_guard_at_the_boundary(api, dataset):
    learnt, held, _ = load_split(api, dataset, share=0.3)
    assert row_indices(recording(), learnt) == list(range(ROWS))[TRAIN]
    assert row_indices(recording(), held) == list(range(ROWS))[HELD_OUT]


@both_models
def test_version_is_judged_without_the_held_out_rows_and_may_then_learn_them(api, jobs, dataset, model, learnt):
    found, split = version_of(api, model), jobs[model]["holdout"]
    only = {} if learnt else {"only": True}
    assert split == {"kind": "auto", "share": 0.3, "blocks": 10, "guard_s": None, "seed": 0} | only
    assert found["fit"]["samples_given"] == (ROWS if learnt else TRAIN.stop)
    record = found["lineage"]["holdout"]
    assert (record["split"], record["learnt"], record["judged_rows"]) == (split, learnt, TRAIN.stop)
    assert (record["rows"], record["guarded"], record["samples"], record["of"]) == (34, 4, 34, 34)
    (entry,) = record["datasets"]
    assert {**entry, **ENTRY, "id": dataset, "sha256": entry["sha256"]} == entry
    service, unseen = service_of(api), recording().rows(HELD_OUT)
    judged = lipcore.load(service.files.version_folder(registry.find(service.database, "kept-out", 1).folder))
    assert_figures(record, vars(evaluate(unseen.tau, *judged.predict(unseen.q, unseen.dq, unseen.ddq).interval)))


@both_models
def test_evaluation_and_trace_find_the_held_out_rows_again(api, jobs, dataset, model, learnt):
    fields = ("part", "samples", "samples_used", "in_training", "judged")
    part, entire = (evaluation(api, model, dataset, **choice) for choice in ({"part": "held_out"}, {}))
    assert [part[name] for name in fields] == ["held_out", 34, 34, False, learnt]
    assert_figures(part, record_of(api, model))
    assert [entire[name] for name in fields] == ["all", ROWS, ROWS, True, False]
    traced = api.post(f"/v1/models/{model}/trace", json={"dataset": dataset, "part": "held_out"}).json()
    assert (traced["samples"], traced["in_training"]) == (34, learnt)


def test_evaluation_of_the_judged_fit_is_complete(api, jobs, dataset):
    judged, computed = (evaluation(api, model, dataset, part="held_out") for model in jobs)
    for name in computed.keys() - {"model", "judged", "joint_names", "warnings", "verdict"}:
        if isinstance(computed[name], list) or name in ("reliability", "stretches", "outside"):
            np.testing.assert_allclose(json_numbers(judged[name]), json_numbers(computed[name]), rtol=1e-6)
        else:
            assert judged[name] == computed[name], name
    assert [judged[name] for name in ("joint_names", "warnings")] == [computed["joint_names"], computed["warnings"]]
    assert judged["verdict"]["level"] == computed["verdict"]["level"]


def resting_joint_recording():
    """Return a recording whose second joint rests until the held-out part."""
    samples, share = stream(samples=ROWS, rate=10.0, seed=11), np.ones((ROWS, 2))
    share[: HELD_OUT.start, 1] = 0.0
    motion = [share * each for each in (samples.q, samples.dq, samples.ddq)]
    tau = inverse_dynamics(load_robot("double-pendulum"), *motion)
    return replace(samples, q=motion[0], dq=motion[1], ddq=motion[2], tau=tau)


@pytest.mark.slow
def test_version_learns_motion_that_only_held_out_rows_have(api):
    dataset = upload(api, resting_joint_recording())["id"]
    other = upload(api, stream(samples=60, rate=10.0, seed=12))["id"]
    errors = {}
    for model, only in (("moves-late", False), ("never-moves", True)):
        train(api, model, dataset, holdout={"kind": "last", "share": 0.3, "only": only})
        errors[model] = evaluation(api, model, other)["nmse"]
    assert max(errors["moves-late"]) < 0.1 * max(errors["never-moves"])
    np.testing.assert_allclose(*(record_of(api, model)["nmse"] for model in errors), rtol=1e-6)


def test_failed_fit_on_all_rows_keeps_the_judged_model(api, dataset, run_here, monkeypatch):
    failure = NotPositiveDefiniteError("the matrix is\nsingular")
    monkeypatch.setattr(planned_fit, "refit", Mock(side_effect=failure))
    assert run_here(queue(api, "fails-late", dataset, holdout={"share": 0.3})["id"])["state"] == "succeeded"
    found = version_of(api, "fails-late")
    assert (found["fit"]["samples_given"], found["lineage"]["holdout"]["learnt"]) == (TRAIN.stop, False)
    assert found["warnings"][0] == (
        "The final fit, on all rows, failed (NotPositiveDefiniteError: the matrix is singular). "
        "The model has not learnt the held-out rows."
    )
    answer = evaluation(api, "fails-late", dataset, part="held_out")
    assert (answer["judged"], answer["in_training"]) == (False, False)


def test_equal_samples_uploaded_again_split_alike(api, jobs, dataset):
    again = upload(api, recording(), name="again")["id"]
    answer = evaluation(api, "held-out", again, part="held_out")
    assert (answer["samples"], answer["in_training"]) == (34, False)
    assert evaluation(api, "held-out", again)["in_training"] is True
    body = {"model": "m", "datasets": [dataset, again], "holdout": {}}  # otherwise equal samples would be in both parts
    assert_invalid(api.post("/v1/jobs", json=body), "datasets[1]")


def test_samples_that_were_not_held_out_are_rejected(api, jobs, trained):
    other = upload(api, recording(seed=9))["id"]
    missing = f"version 1 has no held-out rows of data set {other}"
    for model, part, message in (
        ("held-out", "held_out", missing),
        (trained.name, "held_out", missing),
        ("held-out", "most", ""),
    ):
        assert_invalid(post_evaluation(api, model, other, part=part), "part", message)


@pytest.mark.slow
def test_whole_data_sets_are_held_out_like_episodes(api):
    lengths = {}
    for length in (40, 60, 80, 50):
        lengths[upload(api, stream(samples=length, rate=10.0, seed=20 + length))["id"]] = length
    train(api, "whole-sets", *lengths, holdout={"kind": "episodes", "share": 0.3})
    found = version_of(api, "whole-sets")
    record = found["lineage"]["holdout"]
    held = {each["id"] for each in record["datasets"]}
    assert 0 < len(held) < 4
    assert all(each["whole"] for each in record["datasets"])
    assert (record["rows"], record["guarded"]) == (sum(lengths[name] for name in held), 0)
    assert record["judged_rows"] == sum(lengths.values()) - record["rows"]
    assert found["fit"]["samples_given"] == sum(lengths.values())
    for name, length in lengths.items():
        entire, part = evaluation(api, "whole-sets", name), post_evaluation(api, "whole-sets", name, part="held_out")
        assert (entire["samples"], entire["in_training"]) == (length, True)
        assert part.status_code == (200 if name in held else 422)
        assert name not in held or (part.json()["samples"], part.json()["judged"]) == (length, True)
    _, _, record = load_split(api, *reversed(lengths), kind="episodes", share=0.3)
    assert {each["id"] for each in record["datasets"]} == held


def test_data_set_without_times_has_a_guard_in_rows(api):
    table, samples = columns(recording(seed=4)), recording(seed=4)
    del table["t"]
    untimed = post(api, csv(table), "text/csv", joint_names="joint1,joint2").json()["id"]
    learnt, held, record = load_split(api, untimed, share=0.5)
    (entry,) = record["datasets"]
    assert (entry["guard"], entry["guard_unit"]) == (25.0, "rows")
    assert row_indices(samples, learnt) == list(range(35))
    assert row_indices(samples, held) == list(range(85, ROWS))
    body = {"model": "m", "datasets": [untimed], "holdout": {"guard_s": 0.1}}
    assert_invalid(api.post("/v1/jobs", json=body), "holdout.guard_s")


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
        ([[9, 9]], "holdout.stretches.{}", "first < last and last at most 120"),
        ([[50, 60], [40, 45]], "holdout.stretches.{}", "in increasing order"),
        ([[50, 121]], "holdout.stretches.{}", "at most 120"),
        ([[0, 100]], "holdout.stretches", "it leaves 20 samples"),
    ],
    ids=str,
)
def test_wrong_holdout_is_rejected(api, dataset, holdout, field, message):
    """A list stands for stretches of the data set."""
    if isinstance(holdout, list):
        holdout = {"kind": "stretches", "stretches": {dataset: holdout}}
    body = {"model": "m", "datasets": [dataset], "options": QUICK, "holdout": holdout}
    assert_invalid(api.post("/v1/jobs", json=body), field.format(dataset), message)


def test_named_rows_are_held_out_and_found_again(api, dataset):
    other = upload(api, recording(seed=7))["id"]
    holdout = {"kind": "stretches", "stretches": {dataset: [[30, 60], [100, 110]]}}
    learnt, held, _ = load_split(api, dataset, other, **holdout)
    assert row_indices(recording(), held) == [*range(32, 58), *range(102, 108)]
    assert len(learnt.t) == ROWS - 32 - 4 * 4 + ROWS
    job = train(api, "named-rows", dataset, other, holdout=holdout)
    assert job["holdout"]["stretches"] == holdout["stretches"]
    answer = evaluation(api, "named-rows", dataset, part="held_out")
    assert (answer["samples"], answer["in_training"]) == (32, False)


def test_split_without_training_rows_fails_the_job(api, dataset):
    seen = ended(api, queue(api, "left-nothing", dataset, holdout={"guard_s": 30.0})["id"])
    assert (seen["state"], seen["error"]["code"]) == ("failed", "cannot_hold_out")
    assert f"data set '{dataset}'" in seen["error"]["message"]
    assert "guard_s is 30.0, expected a smaller value" in seen["error"]["message"]


@pytest.mark.slow
def test_refresh_holds_out_the_same_samples(api):
    dataset = upload(api, recording(seed=6))["id"]
    train(api, "refreshed-held", dataset, holdout={"kind": "blocks", "share": 0.3, "blocks": 5})
    seen = refresh(api, "refreshed-held")
    before, after = (version_of(api, "refreshed-held", number) for number in (1, 2))
    for name in ("split", "datasets", "rows", "guarded", "judged_rows"):
        assert after["lineage"]["holdout"][name] == before["lineage"]["holdout"][name]
    assert after["fit"]["samples_given"] == before["fit"]["samples_given"] == ROWS
    compared = after["lineage"]["refresh"]["compared"]
    assert compared == "It was not compared with version 1, because too few rows are logged."
    assert seen["history"][-1]["message"] == f"version 2 is trained and is dismissed: {compared}"
    answer = evaluation(api, "refreshed-held", dataset, part="held_out", version=2)
    np.testing.assert_allclose(answer["nmse"], after["lineage"]["holdout"]["nmse"], rtol=1e-6)
    assert answer["in_training"] is False


def test_refresh_excludes_what_its_version_never_learns(api):
    train(api, "refreshed-kept", upload(api, recording(seed=13))["id"], holdout={"share": 0.3, "only": True})
    refresh(api, "refreshed-kept")
    after = version_of(api, "refreshed-kept", 2)
    assert (after["fit"]["samples_given"], after["lineage"]["holdout"]["learnt"]) == (TRAIN.stop, False)


def test_exported_version_includes_its_split(api, jobs, dataset):
    version = imported(api, exported(api, "held-out"), name="came")
    assert version["lineage"]["holdout"] == record_of(api, "held-out")
    assert evaluation(api, "came", dataset, part="held_out")["samples"] == 34


def test_guard_is_a_period_of_the_low_pass(api):
    """With velocities derived at 2 Hz, the filter spreads each sample over half a second."""
    fine: Samples = stream(samples=400, rate=50.0, seed=8)
    answer = post(api, npz(**arrays(fine, "t", "q", "tau"), joint_names=np.array(fine.joint_names)), cutoff=2)
    assert answer.status_code == 201, answer.text
    name = answer.json()["id"]
    with service_of(api).database.transaction() as session:
        row = session.query(DatasetRow).filter_by(id=name).one()
        row.report = {**row.report, "recipe": {"cutoff_hz": 2.0}}
    learnt, held, record = load_split(api, name, share=0.3)
    assert record["datasets"][0]["guard"] == 0.5
    assert held.t[0] - learnt.t[-1] > 1.0


def periodic(rows=600, seed=1):
    """Return motion at 20 Hz that repeats itself every 5 s."""
    return stream(samples=rows, rate=20.0, seed=seed, course="periodic", speed=2.0)


def test_held_out_rows_that_repeat_training_are_reported_with_period(api):
    """The lineage reports it for held-out rows, an evaluation also for other recordings that repeat."""
    dataset, again, other = (upload(api, each)["id"] for each in (periodic(), periodic(rows=200), recording(seed=3)))
    train(api, "periodic", dataset, holdout={"kind": "last", "share": 0.3})
    record = record_of(api, "periodic")
    assert record["datasets"][0]["stretches"] is None
    assert record["repeats_training"] > 0.9
    assert record["period_s"] == pytest.approx(5.0, rel=0.02)
    assert "repeat motion of the training, which repeats every 5 s" in record["warnings"][0]
    held, inside = (evaluation(api, "periodic", dataset, part=part) for part in ("held_out", "all"))
    assert [held[name] for name in REPETITION] == [record[name] for name in REPETITION]
    assert (inside["in_training"], inside["repeats_training"], inside["warnings"]) == (True, None, [])
    assert evaluation(api, "periodic", again)["repeats_training"] > 0.9
    answer = evaluation(api, "periodic", other)
    assert answer["repeats_training"] < 0.3
    assert answer["warnings"] == []


def test_automatic_split_holds_out_a_part_without_repetition(api):
    """The motion is aperiodic first and periodic later, so the last part repeats earlier rows."""
    free, again = stream(samples=200, rate=20.0, seed=2, speed=20.0), periodic(500)
    names = ("q", "dq", "ddq", "tau")
    both = {name: np.concatenate([getattr(each, name) for each in (free, again)]) for name in names}
    samples = Samples(free.joint_names, np.arange(700) / 20.0, np.zeros(700, np.int64), **both)
    dataset = upload(api, samples)["id"]
    _, held, record = load_split(api, dataset, share=0.3)
    ((first, last),) = record["datasets"][0]["stretches"]
    assert first == 0
    assert last == pytest.approx(200, abs=100)  # a period
    assert row_indices(samples, held) == list(range(last - 5))  # a quarter of a second of guard
    split = find_earlier_split(DatasetRow(id=dataset, sha256="?"), {"holdout": record})
    assert np.flatnonzero(split.held_out(samples.episode, samples.t)).tolist() == list(range(last - 5))
    _, _, record = load_split(api, dataset, share=0.3, kind="last")
    assert record["datasets"][0]["stretches"] is None
