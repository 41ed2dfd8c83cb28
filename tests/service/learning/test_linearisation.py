"""A learnt arm that stands on little: rows of more motion move it, and a version is trained that is linear there."""

from __future__ import annotations

import pytest

import lipcore
from lipcore.model.warnings import linearisation_error
from lipcore.robots.library import random_arm
from lipcore.robots.simulation import Stream, simulate
from service.models import registry
from tests.service.data import DEADLINE, ended, eventually, train, upload
from tests.service.learning.lessons import Pupil, answered
from tests.service.learning.lessons import school as opened
from tests.service.learning.motions import RATE, batch

pytestmark = pytest.mark.slow
ARM = random_arm(4, joints=3)
FRICTION, NOISE = 0.3, 0.3
BATCHES = 30
"""That are learnt before refreshes are wanted."""
LEARNING = {"contact_threshold": 1e6, "on_change": "learn"}


@pytest.fixture(scope="module")
def refreshed(tmp_path_factory):
    """The model, its alarms, and the job that refreshed it."""
    settings = {"promotion_rows": 600, "refresh_pause_s": 1e6}
    little = simulate(ARM, Stream(60, 10.0, 20, speed=5.0, noise=NOISE, viscous=FRICTION), seed=1)
    much = simulate(ARM, Stream(20_000, RATE, 50, "full", 10.0, NOISE, FRICTION), seed=2)
    with opened(tmp_path_factory.mktemp("arm"), tmp_path_factory.mktemp("unused"), **settings) as school:
        api, pupil, sent = school.client, Pupil(school.client, "learnt"), 0
        options = {"search_seconds": 10.0, "posterior_samples": 200}
        train(api, "learnt", upload(api, little)["id"], estimator="rigid-body", options=options)
        pupil.put("learning", LEARNING | {"auto_refresh": False})
        first = pupil.get("learning")["status"]["linearisation_error"]

        def alarms(kind):
            """One batch more, and the alarms of a kind, newest first."""
            nonlocal sent
            pupil.post("observations", batch(sent, moved=much))
            sent += 1
            eventually(lambda: pupil.get("learning")["status"]["lag_events"] == 0)
            return [each for each in pupil.get("alarms")["items"] if each["kind"] == kind]

        [advice] = [alarms("linearisation") for _ in range(BATCHES)][-1]
        pupil.put("learning", LEARNING)
        found = eventually(lambda: (seen := alarms("linearisation"))[1:] and seen[0])
        before = pupil.get("learning")["status"]["linearisation_error"]
        job = ended(api, found["evidence"]["job"])
        [promotion] = eventually(lambda: alarms("promotion"), 2 * DEADLINE)
        service, version = school.service, answered(api.get("/v1/models/learnt/versions/2"))
        folder = service.files.version_folder(registry.find(service.database, "learnt", 2).folder)
        after = linearisation_error(lipcore.load(folder))
        yield {
            "advice": advice,
            "alarm": found,
            "job": job,
            "promotion": promotion,
            "errors": (first, before, after),
            "version": version,
        }


def test_the_alarm_says_how_far_the_arm_has_moved(refreshed):
    evidence, (first, before, _) = refreshed["alarm"]["evidence"], refreshed["errors"]
    assert first is None
    assert refreshed["advice"]["message"].endswith("a refresh would help")
    assert refreshed["alarm"]["message"].endswith("it is refreshed")
    assert max(evidence["linearisation_error"]) > evidence["threshold"] == 0.5
    assert max(before) > 0.5


def test_it_is_trained_anew_where_it_has_moved_to(refreshed):
    assert refreshed["job"]["state"] == "succeeded"
    assert refreshed["job"]["refresh"]["trigger"] == "linearisation"
    assert refreshed["version"]["lineage"]["refresh"]["trigger"] == "linearisation"
    assert refreshed["promotion"]["evidence"]["promoted"]
    assert refreshed["errors"][2].max() < 0.1
