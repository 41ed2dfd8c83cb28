"""Comparison of a refreshed version with the serving one, on logged rows that neither has learnt."""

from dataclasses import replace

import numpy as np
import pytest

from lipcore.data.samples import Samples
from lipcore.online.learner import OnlineModel
from service.contract.verdict import Thresholds
from service.models import registry, verdicts
from service.training import refresh_data, refreshed
from service.training.refresh_data import ComparisonRows
from tests.service.learning.pendulums import ARM, Arm, make_rows, trained_model

SECOND_ROWS = 100
"""Rows of a batch of one second."""
TRAINED_EVENTS = 4


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    """Model with 26 s of observations of a robot that has more friction than in the training."""
    arm = Arm.open(tmp_path_factory.mktemp("refreshed"))
    for number in range(26):
        arm.log_batch(number, size=SECOND_ROWS)
    yield arm
    arm.database.close()


def make_comparison_rows(*numbers: int) -> ComparisonRows:
    """Return the rows of these seconds in one stream."""
    every = make_rows(0).concatenate([make_rows(number, SECOND_ROWS) for number in numbers])
    episode = np.zeros(len(every), np.int64)
    samples = Samples(trained_model().joint_names, every.time, episode, every.q, every.dq, every.ddq, every.tau)
    return ComparisonRows(TRAINED_EVENTS, samples)


ERRORS = np.array([0.1, 0.15])
"""Errors of the model after 14 s, N·m: the friction is not linear, as the model takes it to be."""


def learn_seconds(seconds: int, floor=None):
    """Return the model that has learnt these seconds. floor: variance of its errors, (N·m)², (n,)."""
    online = OnlineModel.start(trained_model())
    for number in range(seconds):
        online = online.learn(make_rows(number, SECOND_ROWS))
    return online.model(floor)


def compare_model(arm, seconds, rows):
    """Compare the model that has learnt these seconds with version 1."""
    serving = registry.find(arm.database, ARM, 1)
    return refreshed.compare(arm.database, arm.files, serving, learn_seconds(seconds), rows)


@pytest.mark.parametrize(
    ("seconds", "passed", "words"),
    [
        (14, True, "better than those of version 1"),  # more data of the robot than version 1 had after 4 s
        (0, False, "no better than those of version 1"),  # as trained: the wrong friction
        (TRAINED_EVENTS, False, "no better than those of version 1"),  # the same as version 1
    ],
)
def test_candidate_is_accepted_if_it_predicts_newest_rows_better(arm, seconds, passed, words):
    found = compare_model(arm, seconds, make_comparison_rows(*range(TRAINED_EVENTS, 26)))
    assert (found.better, words in found.reason) == (passed, True)
    assert (found.evidence["rows"], found.evidence["blocks"]) == (22 * SECOND_ROWS, 22)
    better = found.evidence["gain"] > 2 * found.evidence["standard_error"]
    assert better == passed
    assert set(found.evidence["figures"]) == {"serving", "candidate"}


@pytest.mark.parametrize(("seconds", "max_error", "level"), [(14, 0.9, "usable"), (14, 1e-9, "wrong"), (0, 0.9, "")])
def test_refresh_serves_if_it_is_better_and_usable(arm, seconds, max_error, level):
    registry.set_thresholds(arm.database, ARM, Thresholds(max_error=max_error))
    serving, lineage = registry.find(arm.database, ARM, 1), {"refresh": {"version": 1}}
    rows = make_comparison_rows(*range(TRAINED_EVENTS, 26))
    trained = learn_seconds(seconds, ERRORS**2 if seconds else None)
    decided = refreshed.judge(arm.database, arm.files, serving, trained, rows, lineage)
    shown = verdicts.of_version(
        {**serving.manifest, "lineage": lineage}, registry.verdict_options(arm.database, [ARM])[ARM]
    )
    assert (shown.judged_on, lineage["judged"]["of"]) == ("stream", 22 * SECOND_ROWS)
    assert shown.level.startswith(level)
    assert decided.answers == (level == "usable")
    assert shown.reason in decided.reason if level == "wrong" else "version 1" in decided.reason


def test_too_few_rows_give_no_verdict(arm):
    for rows in (None, make_comparison_rows(4, 5, 6)):
        found = compare_model(arm, 14, rows)
        assert (found.better, found.evidence) == (False, {})
        assert found.reason == "It was not compared with version 1, because too few rows are logged."


def test_newest_third_of_learnt_rows_is_compared(arm):
    with arm.database.session() as session:
        scope = refresh_data.scope_of(session, ARM, 24)
        assert refresh_data.newest_part(session, ARM, scope, 0) == 16
        assert refresh_data.newest_part(session, ARM, scope, 20) == 20  # the version contains these by training
        assert refresh_data.newest_part(session, ARM, replace(scope, since=make_rows(18, SECOND_ROWS).time[0]), 0) == 22
