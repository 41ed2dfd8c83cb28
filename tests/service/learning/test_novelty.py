"""Motion beyond what a version can learn: it is told, a better version is trained, and it takes over unnoticed."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import count
from typing import Any

import numpy as np
import pytest

import lipcore
from service.journal import log
from service.learning.learner import learnt
from service.learning.learner.restore import restore
from service.models import registry
from tests.service.data import DEADLINE, ended, eventually, train, upload
from tests.service.learning.lessons import Pupil, School, answered
from tests.service.learning.lessons import school as opened
from tests.service.learning.motions import OPTIONS, batch, fast, slow

pytestmark = pytest.mark.slow
PAUSE_S = 0.01
"""Between two questions of the watcher: the learner needs the processor too."""
SETTINGS = {"novelty_rows": 400, "promotion_rows": 600, "refresh_pause_s": 0.0}


@dataclass
class Watcher:
    """Asks the same query again and again in a thread of its own; keeps every answer."""

    pupil: Pupil
    queries: dict[str, Any]
    answers: list[Any] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._watch)

    def _watch(self) -> None:
        while not self._end.wait(PAUSE_S):
            self.answers.append(self.pupil.client.post(self.pupil.url("predict"), json=self.queries))

    def __enter__(self) -> Watcher:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join(DEADLINE)


@dataclass(frozen=True)
class Story:
    """What was seen from the first fast batch to the promotion."""

    pupil: Pupil
    school: School
    dataset: dict[str, Any]
    job: dict[str, Any]
    before: dict[str, Any]
    answers: list[Any]
    alarms: list[dict[str, Any]]


@pytest.fixture(scope="module")
def story(tmp_path_factory):
    with opened(tmp_path_factory.mktemp("novel"), tmp_path_factory.mktemp("unused"), **SETTINGS) as school:
        api, pupil = school.client, Pupil(school.client, "arm")
        dataset = upload(api, slow(), name="slow")
        train(api, "arm", dataset["id"], options=OPTIONS)
        queries = {name: getattr(fast(), name)[-5:].tolist() for name in ("q", "dq", "ddq")}
        sent = _teacher(pupil)

        def told(kind: str) -> list[dict[str, Any]]:
            return [each for each in pupil.get("alarms")["items"] if each["kind"] == kind]

        with Watcher(pupil, queries) as watcher:
            eventually(lambda: sent() and told("novelty"))
            job = ended(api, told("novelty")[0]["evidence"]["job"])
            before = answered(api.get("/v1/models/arm"))
            eventually(lambda: sent() and told("promotion"))
            eventually(lambda: sent() and watcher.answers[-1].json()["version"] == 2)
        yield Story(pupil, school, dataset, job, before, watcher.answers, pupil.get("alarms")["items"])


def test_novel_motion_is_told_with_its_share(story):
    [alarm] = [each for each in story.alarms if each["kind"] == "novelty"]
    assert alarm["evidence"]["novel_share"] > alarm["evidence"]["threshold"] == 0.2
    assert alarm["evidence"]["version"] == 1
    assert f"{alarm['evidence']['novel_share']:.0%} of the last 400 samples" in alarm["message"]


def test_a_refresh_is_queued_and_makes_a_candidate_that_does_not_answer_yet(story):
    assert (story.job["state"], story.job["version"]) == ("succeeded", 2)
    assert story.job["refresh"]["version"] == 1
    assert story.job["refresh"]["trigger"] == "novelty"
    assert story.job["datasets"] == [story.dataset["id"]]
    assert (story.before["latest_version"], story.before["serving_version"]) == (2, 1)


def test_the_lineage_names_data_and_log(story):
    lineage = answered(story.pupil.client.get("/v1/models/arm/versions/2"))["lineage"]
    assert [each["id"] for each in lineage["datasets"]] == [story.dataset["id"]]
    assert lineage["refresh"] == {**story.job["refresh"], "left_out": []}
    through = story.job["refresh"]["through"]
    assert (lineage["log"]["through"], lineage["log"]["rows"]) == (through, 50 * through)


def test_the_candidate_predicts_better_and_is_promoted(story):
    [alarm] = [each for each in story.alarms if each["kind"] == "promotion"]
    evidence = alarm["evidence"]
    assert (evidence["serving"], evidence["candidate"], evidence["promoted"]) == (1, 2, True)
    assert evidence["rows"] >= SETTINGS["promotion_rows"]
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


def test_every_answer_is_whole_one_version_and_revision(story):
    """Against states made anew from the log, at the turn from one version to the other and evenly elsewhere."""
    answers = [answer.json() for answer in story.answers]
    turn = next(index for index, answer in enumerate(answers) if answer["version"] == 2)
    chosen = {turn - 1, turn, len(answers) - 1, *range(0, len(answers), max(1, len(answers) // 10))}
    service, queries = story.school.service, _queries()
    for answer in (answers[index] for index in sorted(chosen)):
        version = answer["version"]
        base = lipcore.load(_folder(story, version))
        with service.database.session() as session:
            number = log.start_of(session, "arm", version) + answer["revision"]
        online = restore(service.database, service.files, "arm", version, base, number).online
        expected = online.model(learnt.floor(service.database, "arm", version, number, 2)).predict(*queries)
        np.testing.assert_allclose(answer["tau"], expected.tau, rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(answer["tau_std"], expected.tau_std, rtol=1e-5, atol=1e-8)


def test_a_worse_candidate_is_not_promoted(story):
    """The one that serves knows the fast motion, the other one the slow one alone; both learn on."""
    service, pupil = story.school.service, Pupil(story.pupil.client, "steady")
    for number, samples in enumerate((fast(seed=7).rows(slice(0, 4000, 40)), slow()), start=1):
        model = lipcore.train(samples, ["revolute"] * 2, "lip-chain", lipcore.FitOptions(**OPTIONS))
        with service.files.new_version(f"mv_steady{number}") as target:
            manifest = lipcore.save(model, target, {})
        with service.database.transaction() as session:
            registry.publish(session, pupil.model, f"mv_steady{number}", manifest, None, candidate=number == 2)
    pupil.put("learning", {"contact_threshold": 1e6, "on_change": "learn", "auto_refresh": False})
    sent = _teacher(pupil)
    [alarm] = eventually(lambda: sent() and pupil.get("alarms")["items"], 2 * DEADLINE)
    assert (alarm["kind"], alarm["evidence"]["verdict"], alarm["evidence"]["promoted"]) == (
        "promotion",
        "dismiss",
        False,
    )
    assert alarm["evidence"]["gain"] < 0
    assert alarm["evidence"]["rows"] >= 2 * SETTINGS["promotion_rows"]
    assert answered(pupil.client.get("/v1/models/steady"))["serving_version"] == 1


def _teacher(pupil: Pupil) -> Callable[[], bool]:
    """Sends the next batch and waits until it is learnt: the motion must not end before a slow machine has seen it."""
    numbers = count()

    def sent() -> bool:
        pupil.post("observations", batch(next(numbers)))
        return eventually(lambda: pupil.get("learning")["status"]["lag_events"] == 0)

    return sent


def _queries() -> list[np.ndarray]:
    return [getattr(fast(), name)[-5:] for name in ("q", "dq", "ddq")]


def _folder(story: Story, version: int) -> Any:
    service = story.school.service
    return service.files.version_folder(registry.find(service.database, "arm", version).folder)
