"""Novel motion: it raises an alarm, and a better version is trained and promoted without interruption."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import lipcore
from lipcore.data.samples import Samples
from service.models import registry
from tests.service.data import DEADLINE, ended, eventually, stream, train, upload
from tests.service.learning.learning_models import LearningModel, read_json, start_service

BATCH_ROWS = 50
"""Rows of a batch."""
RATE = 100.0
OPTIONS = {"hyperparameter_samples": 30, "posterior_samples": 60, "max_iterations": 10}
"""Options of a fit of about one second that predicts both motions well."""


def slow_recording() -> Samples:
    """Return the training recording, with at most 0.2 rad/s."""
    return stream(samples=120, speed=1.0, seed=1, n_sinusoids=20)


def fast_recording(seed: int = 2) -> Samples:
    """Return the observed recording, with up to 0.7 rad/s, mostly beyond the training range."""
    return stream(samples=20_000, speed=15.0, seed=seed, rate=RATE, n_sinusoids=20)


def fast_batch(number: int) -> dict[str, Any]:
    """Return a batch of consecutive rows of the fast recording."""
    rows = slice(number * BATCH_ROWS, (number + 1) * BATCH_ROWS)
    body = {name: getattr(fast_recording(), name)[rows].tolist() for name in ("q", "dq", "ddq", "tau")}
    times = (np.arange(BATCH_ROWS) + number * BATCH_ROWS) / RATE
    return {"stream_id": "arm", "sequence": number, "t": times.tolist(), **body}


pytestmark = pytest.mark.slow


@contextmanager
def repeat_predictions(learning_model: LearningModel, queries: dict[str, Any]) -> Iterator[list[Any]]:
    """Repeat a prediction in a thread; yield the list of responses."""
    answers, end = [], threading.Event()

    def watch() -> None:
        while not end.wait(0.01):  # the learner needs the processor too
            answers.append(learning_model.client.post(learning_model.url("predict"), json=queries))

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield answers
    finally:
        end.set()
        thread.join(DEADLINE)


def list_alarms(learning_model: LearningModel, kind: str) -> list[dict[str, Any]]:
    return [each for each in learning_model.get("alarms")["items"] if each["kind"] == kind]


@pytest.fixture(scope="module")
def refresh_run(tmp_path_factory):
    """Everything observed from the first fast batch to the promotion."""
    with start_service(tmp_path_factory.mktemp("novel"), tmp_path_factory.mktemp("unused")) as learning_service:
        api, learning_model = learning_service.client, LearningModel(learning_service.client, "arm")
        dataset = upload(api, slow_recording(), name="slow")
        train(api, "arm", dataset["id"], options=OPTIONS)
        queries = {name: getattr(fast_recording(), name)[-5:].tolist() for name in ("q", "dq", "ddq")}
        numbers = count()

        def send() -> bool:
            """Send the next batch and wait until it is learnt, so that a slow machine does not run out of batches."""
            learning_model.post("observations", fast_batch(next(numbers)))
            return eventually(lambda: learning_model.get("learning")["status"]["lag_events"] == 0)

        with repeat_predictions(learning_model, queries) as answers:
            alarm = eventually(lambda: send() and next(iter(list_alarms(learning_model, "novelty")), None))
            job = ended(api, alarm["evidence"]["job"])
            eventually(lambda: send() and answers[-1].json()["version"] == 2)
        service = learning_service.service
        yield SimpleNamespace(learning_model=learning_model, service=service, dataset=dataset, job=job, answers=answers)


def test_novel_motion_raises_alarm_and_trains_candidate(refresh_run):
    [alarm] = list_alarms(refresh_run.learning_model, "novelty")
    assert alarm["evidence"]["novel_share"] > alarm["evidence"]["threshold"] == 0.2
    assert alarm["evidence"]["version"] == 1
    assert f"{100 * alarm['evidence']['novel_share']:.0f} % of the last 2000 samples" in alarm["message"]
    refresh = refresh_run.job["refresh"]
    assert (refresh_run.job["state"], refresh_run.job["version"], refresh["version"]) == ("succeeded", 2, 1)
    assert refresh["trigger"] == "novelty"
    lineage = read_json(refresh_run.learning_model.client.get("/v1/models/arm/versions/2"))["lineage"]
    assert [each["id"] for each in lineage["datasets"]] == refresh_run.job["datasets"] == [refresh_run.dataset["id"]]
    assert lineage["refresh"].items() >= {**refresh, "left_out": []}.items()
    assert (lineage["log"]["through"], lineage["log"]["rows"]) == (refresh["through"], 50 * refresh["through"])


def test_better_candidate_is_promoted(refresh_run):
    [alarm] = list_alarms(refresh_run.learning_model, "promotion")
    evidence = alarm["evidence"]
    assert (evidence["serving"], evidence["candidate"], evidence["promoted"]) == (1, 2, True)
    assert evidence["blocks"] >= 20
    assert evidence["gain"] > 2 * evidence["standard_error"] > 0
    assert max(evidence["figures"]["candidate"]["nmse"]) < 0.02
    assert read_json(refresh_run.learning_model.client.get("/v1/models/arm"))["serving_version"] == 2
    unseen = fast_recording(seed=5)
    query = {name: getattr(unseen, name)[:500].tolist() for name in ("q", "dq", "ddq")}
    errors = []
    for version in (1, 2):
        folder = registry.find(refresh_run.service.database, "arm", version).folder
        tau = lipcore.load(refresh_run.service.files.version_folder(folder)).predict(*query.values()).tau
        errors.append(np.mean((tau - unseen.tau[:500]) ** 2))
    assert errors[1] < errors[0]


def test_predictions_never_fail_and_versions_never_decrease(refresh_run):
    assert {answer.status_code for answer in refresh_run.answers} == {200}
    seen = [(answer.json()["version"], answer.json()["revision"]) for answer in refresh_run.answers]
    assert seen == sorted(seen)
    assert {version for version, _ in seen} == {1, 2}
