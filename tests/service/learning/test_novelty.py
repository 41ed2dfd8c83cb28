"""Motion beyond what a version can learn: it is told, a better version is trained, and it takes over unnoticed."""

import threading
from collections.abc import Callable, Iterator
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
from tests.service.learning.lessons import Pupil, answered
from tests.service.learning.lessons import school as opened

ROWS = 50
"""Rows of a batch."""
RATE = 100.0
OPTIONS = {"hyperparameter_samples": 30, "posterior_samples": 60, "max_iterations": 10}
"""Of a fit of about a second that gets both motions right."""


def slow() -> Samples:
    """What a version is trained on: at most 0.2 rad/s."""
    return stream(samples=120, speed=1.0, seed=1, n_sinusoids=20)


def fast(seed: int = 2) -> Samples:
    """What is observed: up to 0.7 rad/s, most of it beyond what the slow motion tells."""
    return stream(samples=20_000, speed=15.0, seed=seed, rate=RATE, n_sinusoids=20)


def batch(number: int) -> dict[str, Any]:
    """The batch of a number: ROWS rows of the fast motion."""
    rows = slice(number * ROWS, (number + 1) * ROWS)
    body = {name: getattr(fast(), name)[rows].tolist() for name in ("q", "dq", "ddq", "tau")}
    times = (np.arange(ROWS) + number * ROWS) / RATE
    return {"stream_id": "arm", "sequence": number, "t": times.tolist(), **body}


pytestmark = pytest.mark.slow
PAUSE_S = 0.01
"""Between two questions of the watcher: the learner needs the processor too."""


@contextmanager
def watched(pupil: Pupil, queries: dict[str, Any]) -> Iterator[list[Any]]:
    """Ask the same again and again in a thread of its own; all answers so far."""
    answers, end = [], threading.Event()

    def watch() -> None:
        while not end.wait(PAUSE_S):
            answers.append(pupil.client.post(pupil.url("predict"), json=queries))

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield answers
    finally:
        end.set()
        thread.join(DEADLINE)


@pytest.fixture(scope="module")
def story(tmp_path_factory):
    """What was seen from the first fast batch to the promotion."""
    with opened(tmp_path_factory.mktemp("novel"), tmp_path_factory.mktemp("unused")) as school:
        api, pupil = school.client, Pupil(school.client, "arm")
        dataset = upload(api, slow(), name="slow")
        train(api, "arm", dataset["id"], options=OPTIONS)
        queries = {name: getattr(fast(), name)[-5:].tolist() for name in ("q", "dq", "ddq")}
        sent = _teacher(pupil)

        def alarms_of(kind: str) -> list[dict[str, Any]]:
            return [each for each in pupil.get("alarms")["items"] if each["kind"] == kind]

        with watched(pupil, queries) as answers:
            eventually(lambda: sent() and alarms_of("novelty"))
            job = ended(api, alarms_of("novelty")[0]["evidence"]["job"])
            eventually(lambda: sent() and answers[-1].json()["version"] == 2)
        alarms = pupil.get("alarms")["items"]
        yield SimpleNamespace(pupil=pupil, school=school, dataset=dataset, job=job, answers=answers, alarms=alarms)


def test_novel_motion_is_told_and_a_candidate_trained_on_data_and_log(story):
    [alarm] = [each for each in story.alarms if each["kind"] == "novelty"]
    assert alarm["evidence"]["novel_share"] > alarm["evidence"]["threshold"] == 0.2
    assert alarm["evidence"]["version"] == 1
    assert f"{100 * alarm['evidence']['novel_share']:.0f} % of the last 2000 samples" in alarm["message"]
    refresh = story.job["refresh"]
    assert (story.job["state"], story.job["version"], refresh["version"]) == ("succeeded", 2, 1)
    assert refresh["trigger"] == "novelty"
    lineage = answered(story.pupil.client.get("/v1/models/arm/versions/2"))["lineage"]
    assert [each["id"] for each in lineage["datasets"]] == story.job["datasets"] == [story.dataset["id"]]
    assert lineage["refresh"].items() >= {**refresh, "left_out": []}.items()
    assert (lineage["log"]["through"], lineage["log"]["rows"]) == (refresh["through"], 50 * refresh["through"])


def test_the_candidate_predicts_better_and_is_promoted(story):
    [alarm] = [each for each in story.alarms if each["kind"] == "promotion"]
    evidence = alarm["evidence"]
    assert (evidence["serving"], evidence["candidate"], evidence["promoted"]) == (1, 2, True)
    assert evidence["blocks"] >= 20
    assert evidence["gain"] > 2 * evidence["standard_error"] > 0
    assert max(evidence["figures"]["candidate"]["nmse"]) < 0.02
    assert answered(story.pupil.client.get("/v1/models/arm"))["serving_version"] == 2
    unseen = fast(seed=5)
    query = {name: getattr(unseen, name)[:500].tolist() for name in ("q", "dq", "ddq")}
    errors = {}
    for version in (1, 2):
        model = lipcore.load(_folder(story, version))
        tau = model.predict(*query.values()).tau
        errors[version] = np.mean((tau - unseen.tau[:500]) ** 2)
    assert errors[2] < errors[1]


def test_no_answer_fails_and_versions_never_go_back(story):
    assert {answer.status_code for answer in story.answers} == {200}
    seen = [(answer.json()["version"], answer.json()["revision"]) for answer in story.answers]
    assert seen == sorted(seen)
    assert {version for version, _ in seen} == {1, 2}


def _teacher(pupil: Pupil) -> Callable[[], bool]:
    """Sends the next batch and waits until it is learnt: the motion must not end before a slow machine has seen it."""
    numbers = count()

    def sent() -> bool:
        pupil.post("observations", batch(next(numbers)))
        return eventually(lambda: pupil.get("learning")["status"]["lag_events"] == 0)

    return sent


def _folder(story: SimpleNamespace, version: int) -> Any:
    service = story.school.service
    return service.files.version_folder(registry.find(service.database, "arm", version).folder)
