"""A refreshed version against the one that serves, on logged rows that neither has learnt."""

from dataclasses import replace

import numpy as np
import pytest

from lipcore.data.samples import Samples
from lipcore.online.learner import OnlineModel
from service.models import registry
from service.training import refresh_data, refreshed
from service.training.refresh_data import ComparisonRows
from tests.service.learning.pendulums import ARM, Arm, rows, trained

SECOND = 100
"""Rows of a batch of a second."""
AFTER = 4


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    """A model that has observed 26 s of a robot with more friction than it was trained with."""
    arm = Arm.open(tmp_path_factory.mktemp("refreshed"))
    for number in range(26):
        arm.batch(number, size=SECOND)
    yield arm
    arm.database.close()


def unlearnt(*numbers: int) -> ComparisonRows:
    """Rows of these seconds, in one stream."""
    every = rows(0).concatenate([rows(number, SECOND) for number in numbers])
    episode = np.zeros(len(every), np.int64)
    samples = Samples(trained().joint_names, every.time, episode, every.q, every.dq, every.ddq, every.tau)
    return ComparisonRows(AFTER, samples)


def learnt(seconds: int):
    online = OnlineModel.start(trained())
    for number in range(seconds):
        online = online.learn(rows(number, SECOND))
    return online.model()


@pytest.mark.parametrize(
    ("seconds", "passed", "words"),
    [
        (14, True, "better than version 1"),  # knows more of the robot than version 1 did after 4 s
        (0, False, "no better than version 1"),  # as trained: the wrong friction
        (AFTER, False, "no better than version 1"),  # the same
    ],
)
def test_the_one_that_predicts_the_newest_rows_better_is_accepted(arm, seconds, passed, words):
    serving = registry.find(arm.database, ARM, 1)
    found = refreshed.compare(arm.database, arm.files, serving, learnt(seconds), unlearnt(*range(AFTER, 26)))
    assert (found.acceptance.passed, words in found.acceptance.reason) == (passed, True)
    assert (found.evidence["rows"], found.evidence["blocks"]) == (22 * SECOND, 22)
    better = found.evidence["gain"] > 2 * found.evidence["standard_error"]
    assert better == passed
    assert set(found.evidence["figures"]) == {"serving", "candidate"}


def test_few_rows_tell_nothing(arm):
    serving = registry.find(arm.database, ARM, 1)
    for few in (None, unlearnt(4, 5, 6)):
        found = refreshed.compare(arm.database, arm.files, serving, learnt(14), few)
        assert (found.acceptance.passed, found.acceptance.reason) == (
            None,
            "too few rows are logged to compare it with version 1",
        )


def test_the_newest_third_of_what_teaches_is_compared(arm):
    with arm.database.session() as session:
        scope = refresh_data.scope_of(session, ARM, 24)
        assert refresh_data.newest_part(session, ARM, scope, 0) == 16
        assert refresh_data.newest_part(session, ARM, scope, 20) == 20  # which the version contains by training
        assert refresh_data.newest_part(session, ARM, replace(scope, since=rows(18, SECOND).time[0]), 0) == 22
