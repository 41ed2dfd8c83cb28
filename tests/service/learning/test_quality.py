"""Prequential quality of rows predicted before they were learnt, as a route and as metrics."""

import math
import os
import signal
from pathlib import Path

import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families as parse

from lipcore.online.record import Record
from lipcore.online.scale import IntervalCoverage
from lipcore.online.window import Window
from lipcore.vocabulary import CODES
from service.learning.control import status
from service.learning.ingest.monitor import WINDOWS_S
from service.models import verdicts
from tests.service.data import eventually
from tests.service.learning.learning_models import observation_batch


def compute_figures(batches, answers):
    """Return the four figures of all rows against earlier predictions, computed from their definitions."""
    tau = np.vstack([batch["tau"] for batch in batches])
    mean, std = (np.vstack([answer[name] for answer in answers]) for name in ("tau", "tau_std"))
    noise = np.array(answers[0]["noise_std"])
    error, total = tau - mean, np.sqrt(std**2 + noise**2)
    density = np.exp(-(error**2) / (2 * total**2)) / np.sqrt(2 * math.pi * total**2)
    return {
        "nmse": (error**2).mean(0) / ((tau - tau.mean(0)) ** 2).mean(0),
        "rmse": np.sqrt((error**2).mean(0)),
        "coverage": (np.abs(error) <= 1.959963984540054 * total).mean(0),
        "nlpd": -np.log(density).mean(0),
    }


@pytest.mark.slow
def test_rows_are_predicted_before_they_are_learnt(learning_model):
    batches, answers = [observation_batch(number) for number in range(3)], []
    queries = [{name: batch[name] for name in ("q", "dq", "ddq")} for batch in batches]
    for number, query in enumerate(queries):
        answers.append(learning_model.predict(query))
        assert answers[-1]["revision"] == number
        learning_model.send_batches(number)
    expected = compute_figures(batches, answers)
    seen = learning_model.get("quality")
    assert (seen["model"], seen["version"], seen["revision"], seen["level"]) == (learning_model.name, 1, 3, 0.95)
    assert seen["joint_names"] == ["joint1", "joint2"]
    assert [window["seconds"] for window in seen["windows"]] == list(WINDOWS_S)
    assert seen["verdict"]["judged_on"] == "stream"
    for window in seen["windows"]:
        assert (window["rows"], window["accepted"], window["rejected"]) == (30, 30, {})
        for name, figures in expected.items():
            assert window[name] == pytest.approx(figures, rel=1e-9), name
    after = learning_model.predict(queries[0])
    late, early = (np.abs(np.subtract(answer["tau"], batches[0]["tau"])).mean() for answer in (after, answers[0]))
    assert late < early  # predictions after learning would flatter


def test_quality_windows_slide():
    seen = Window(60.0, 1)
    for at, value in ((1000.0, 1.0), (1050.0, 3.0)):
        record = Record.of(np.full((4, 1), value), np.zeros((4, 1)), np.zeros((4, 1)), np.ones(1))
        seen.add(record, {"learnt": 4, "contact": 1}, at)
    whole, half, none = (status.summarise_window(seen, now) for now in (1055.0, 1065.0, 1200.0))
    assert (whole.rows, whole.accepted, whole.rejected) == (8, 8, {"contact": 2})
    assert whole.rmse == pytest.approx([math.sqrt((1 + 9) / 2)])
    assert (half.rows, half.rmse, half.nmse) == (4, [3.0], [None])
    assert (none.rows, none.accepted, none.rejected, none.rmse) == (0, 0, {}, [None])


MANIFEST = {"joint_names": ["hip", "knee"], "joint_types": ["revolute", "revolute"], "lineage": {}}


def fill_window(error, seconds=60, torque=3.0):
    """Return a window of rows of two joints with these errors; std and noise_std are 0.3 and 0.4 N·m."""
    window, rng = Window(60.0, 2), np.random.default_rng(1)
    for second in range(seconds):
        mean = torque * rng.standard_normal((100, 2))
        tau = mean + error * rng.standard_normal((100, 2))
        window.add(Record.of(tau, mean, np.full((100, 2), 0.3), np.full(2, 0.4)), {}, 1000.5 + second)
    return window


@pytest.mark.parametrize(
    ("window", "level", "words"),
    [
        (fill_window([0.5, 0.5]), "usable_in_range", "predicts the present motion"),
        (fill_window([0.5, 5.0], torque=1.5), "wrong", "knee 5"),
        (fill_window([0.5, 1.0]), "wrong", "too narrow: knee 67 %"),
        (fill_window([0.5, 0.5], torque=0.05), "not_judged", "not larger than its noise"),
        (fill_window([0.5, 0.5], seconds=2), "not_judged", ""),
        (Window(60.0, 2), "not_judged", ""),
    ],
    ids=["good", "error", "narrow", "at rest", "short", "empty"],
)
def test_latest_rows_decide_the_verdict_on_the_responses(window, level, words):
    found = verdicts.of_window(window, 1060.0, MANIFEST)
    assert (found.level, found.judged_on) == (level, "stream" if found.joints else "nothing")
    assert words in found.reason, found.reason
    faulty = {**MANIFEST, "lineage": {"datasets": [{"id": "ds_1", "faults": ["The torque of hip is mirrored."]}]}}
    assert verdicts.of_window(window, 1060.0, faulty).level == "wrong"


def test_scale_of_the_intervals_counts_for_the_verdict():
    window = Window(60.0, 2)
    for second in range(60):
        answered = IntervalCoverage(100, np.array([95.0, 60.0]), np.array([100.0, 300.0]))
        record = Record.of(np.eye(2), np.zeros((2, 2)), np.full((2, 2), 0.3), np.full(2, 0.4))
        window.add(record, {}, 1000.5 + second, IntervalCoverage.from_json(answered.to_json()))
    joints = verdicts.of_window(window, 1060.0, MANIFEST).joints
    assert [each.coverage for each in joints] == pytest.approx([0.95, 0.6])
    assert [each.interval_width for each in joints] == pytest.approx([1.96, 3 * 1.96], rel=1e-3)
    assert [each.effective_samples for each in joints] == [60, 60]


def scrape_metrics(learning_service, model):
    """Return the metrics of one model as {(name, *other labels): value}."""
    answer = learning_service.client.get("/metrics")
    assert answer.status_code == 200
    assert answer.headers["content-type"].startswith("text/plain")
    samples = {}
    for family in parse(answer.text):
        assert family.documentation
        for sample in family.samples:
            if sample.labels.pop("model", None) == model:
                samples[sample.name, *sorted(sample.labels.items())] = sample.value
    return samples


def test_metrics_match_the_quality_route(learning_service, learning_model):
    learning_model.send_batches(0, 1)
    samples, seen = scrape_metrics(learning_service, learning_model.name), learning_model.get("quality")
    for window in seen["windows"]:
        for name in ("nmse", "coverage", "nlpd"):
            for joint, value in zip(seen["joint_names"], window[name], strict=True):
                key = (f"lipserve_quality_{name}", ("joint", joint), ("window", f"{window['seconds']:g}"))
                assert samples[key] == pytest.approx(value, rel=1e-12)
    assert samples["lipserve_revision", ("version", "1")] == 2
    assert (samples["lipserve_learning_lag_rows",], samples["lipserve_learning_lag_seconds",]) == (0, 0)
    assert samples["lipserve_novel_share",] == learning_model.get("learning")["status"]["novel_share"]


def test_row_outcomes_are_counted_and_unknown_figures_left_out(learning_service, learning_model):
    body = observation_batch(0)
    body["tau"] = [[row[0], 0.25] for row in body["tau"]]  # constant torque has no NMSE
    body["q"][2][0], body["q"][5][1], body["dq"][7][0] = None, 1000.0, 1000.0
    learning_model.send_batches(0, **{name: body[name] for name in ("q", "dq", "tau")})
    learning_model.post("observations", body)  # duplicates count no rows
    for window in learning_model.get("quality")["windows"]:
        assert (window["rows"], window["accepted"], window["rejected"]) == (7, 7, {"non_finite": 1, "limit": 2})
        assert [value is None for value in window["nmse"]] == [False, True]
        assert None not in window["rmse"] + window["coverage"] + window["nlpd"]
    samples = scrape_metrics(learning_service, learning_model.name)
    metric = "lipserve_observations_total"
    counted = {dict(labels)["outcome"]: samples[name, *labels] for name, *labels in samples if name == metric}
    assert counted == dict.fromkeys(CODES, 0) | {"learnt": 7, "non_finite": 1, "limit": 2}
    assert {dict(labels)["joint"] for name, *labels in samples if name == "lipserve_quality_nmse"} == {"joint1"}


@pytest.mark.skipif(not Path("/proc/self/stat").is_file(), reason="reads /proc")
def test_lag_counts_rows_not_learnt_yet(learning_service, learning_model):
    learning_model.send_batches(0)
    learner = learning_service.service.learners.process.pid
    with learning_service.service.database.transaction():  # a learner stopped in its own would block all writes
        os.kill(learner, signal.SIGSTOP)
        eventually(lambda: Path(f"/proc/{learner}/stat").read_text().rpartition(")")[2].split()[0] == "T")
    try:
        for number in (1, 2):
            learning_model.post("observations", observation_batch(number))
        samples = scrape_metrics(learning_service, learning_model.name)
        status = learning_model.get("learning")["status"]
    finally:
        os.kill(learner, signal.SIGCONT)
    assert samples["lipserve_learning_lag_rows",] == status["lag_rows"] == 20
    assert 0 < samples["lipserve_learning_lag_seconds",] <= status["lag_s"]
    learning_model.wait_for_revision(3)
    after = eventually(lambda: not (now := learning_model.get("learning")["status"])["lag_rows"] and now)
    assert after["lag_s"] == 0.0
