"""What is learnt is a function of the log: from a snapshot or not, in pages or at once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lipcore.vocabulary import CODES
from service.journal import snapshots
from service.learning.learner import course, learnt
from service.learning.learner import restore as restoring
from service.learning.learner.course import RewoundError
from service.learning.learner.learnt import LearntVersions
from service.learning.learner.restore import advance
from tests.service.learning.pendulums import (
    ARM,
    QUERIES,
    at_once,
    differ,
    predicted,
    record,
    rows,
    same,
    trained,
)

# learning


def test_the_rows_of_a_log_are_learnt_as_if_there_had_been_one_batch(arm, pages):
    arm.batches(*range(12))
    known = arm.restored()
    assert known.number == 12
    assert known.online.samples == pytest.approx(120)
    same(known.online, at_once(range(12)))
    assert differ(at_once(range(12)), at_once())


def test_nothing_is_learnt_from_an_empty_log(arm):
    known = arm.restored()
    assert known.number == 0
    same(known.online, predicted(trained()))


def test_rows_that_were_kept_out_teach_nothing_until_they_are_replayed(arm):
    told = rows(1)
    code = told.code.copy()
    code[3:6] = CODES.index("contact")
    arm.batch(0)
    arm.batch(1, rows=replace(told, code=code))
    same(arm.restored().online, at_once([0], [replace(told, code=code)]))
    arm.event("replay", replace(told, code=np.where(code == 0, 8, 0).astype(np.uint8)), event=2)
    same(arm.restored().online, at_once([0, 1]))


def test_a_version_learns_what_came_after_its_training(arm):
    arm.batches(0, 1, 2)
    arm.publish(candidate=True, start=2)
    arm.batches(3)
    found = restoring.restore(arm.database, arm.files, ARM, 2, arm.base)
    assert found.number == 4
    same(found.online, at_once([2, 3]))


def test_a_page_takes_no_more_rows_than_it_may_and_at_least_a_batch(arm, monkeypatch):
    monkeypatch.setattr(course, "PAGE_ROWS", 25)
    arm.batches(0, 1, 2)
    arm.batch(1, size=40, stream_id="other")
    known, seen = arm.restored(most_rows=0), []
    for _ in range(3):
        known = advance(arm.database, known, watch=lambda page: seen.append([each.event.number for each in page]))
    assert seen == [[1, 2], [3], [4]]
    assert advance(arm.database, known) is known


def test_restoring_can_stop_after_some_rows_and_go_on(arm, monkeypatch):
    monkeypatch.setattr(course, "PAGE_ROWS", 10)
    arm.batches(*range(6))
    known = arm.restored(most_rows=25)
    assert known.number == 3
    same(known.online, at_once(range(3)))
    same(arm.followed(known).online, at_once(range(6)))


# snapshots


@pytest.mark.parametrize("at", [1, 7, 12])
def test_a_snapshot_changes_nothing_but_the_time_it_takes(arm, pages, at, monkeypatch):
    arm.batches(*range(12))
    assert arm.snapshot(at_most=at) == at
    decoded, decode = [], restoring.decode
    monkeypatch.setattr(restoring, "decode", lambda payload: decoded.append(1) or decode(payload))
    found = arm.restored()
    assert (found.number, len(decoded)) == (12, 12 - at)
    same(found.online, at_once(range(12)))
    assert found.online.samples == pytest.approx(120)


def test_a_damaged_snapshot_gives_way_to_the_one_before(arm, caplog):
    arm.batches(0, 1)
    arm.snapshot()
    arm.batches(2, 3)
    arm.snapshot()
    with arm.database.session() as session:
        newest = snapshots.latest(session, ARM, 1, None)
    path = arm.files.learning / f"{newest.id}.safetensors"
    path.write_bytes(path.read_bytes()[:1000])
    same(arm.restored().online, at_once(range(4)))
    assert f"snapshot {newest.id} of version 1 of model 'arm' cannot be used" in caplog.text
    path.unlink()
    same(arm.restored().online, at_once(range(4)))


def test_a_snapshot_of_another_version_is_not_taken(arm):
    arm.batches(0, 1)
    arm.snapshot()
    arm.publish(candidate=True, start=1)
    found = restoring.restore(arm.database, arm.files, ARM, 2, arm.base)
    same(found.online, at_once([1]))


def test_who_is_overtaken_by_retention_goes_on_from_the_newest_snapshot(arm):
    arm.batches(*range(4))
    known = arm.restored(at_most=1)
    assert arm.snapshot() == 4
    arm.batches(4)
    with arm.database.transaction() as session:
        session.connection().exec_driver_sql("DELETE FROM events WHERE number <= 4")
    with pytest.raises(RewoundError) as rewound:
        advance(arm.database, known)
    assert rewound.value.number is None
    same(arm.restored(rewound=rewound.value).online, at_once(range(5)))


def test_where_that_snapshot_is_lost_what_is_left_of_the_log_is_learnt(arm):
    arm.batches(*range(4))
    arm.snapshot()
    arm.batches(4, 5)
    with arm.database.transaction() as session:
        session.connection().exec_driver_sql("DELETE FROM events WHERE number <= 4")
    for path in arm.files.learning.glob("*.safetensors"):
        path.unlink()
    found = arm.restored()
    assert found.number == 6
    same(found.online, at_once([4, 5]))


# for the process that serves


def test_little_is_learnt_where_a_version_is_loaded_and_the_rest_is_left_to_the_learner(arm, monkeypatch):
    assert LearntVersions(arm.database, arm.files).find(ARM, 1, arm.base) is None
    arm.batches(*range(6))
    found = LearntVersions(arm.database, arm.files).find(ARM, 1, arm.base)
    assert (found.revision, found.behind) == (6, False)
    same(found.model, at_once(range(6)))
    monkeypatch.setattr(course, "PAGE_ROWS", 10)
    monkeypatch.setattr(learnt, "MOST_ROWS", 20)
    found = LearntVersions(arm.database, arm.files).find(ARM, 1, arm.base)
    assert (found.revision, found.behind) == (2, True)
    same(found.model, at_once(range(2)))


def test_a_version_that_learns_no_more_has_learnt_what_its_last_snapshot_says(arm):
    arm.batches(0, 1, 2)
    arm.snapshot(at_most=2)
    arm.publish()
    arm.batches(3)
    found = LearntVersions(arm.database, arm.files).find(ARM, 1, arm.base)
    assert (found.revision, found.behind) == (2, False)
    same(found.model, at_once(range(2)))


def test_without_a_snapshot_such_a_version_is_as_trained(arm):
    arm.batches(0, 1)
    arm.publish()
    assert LearntVersions(arm.database, arm.files).find(ARM, 1, arm.base) is None


# the errors of the last seconds


def test_the_stated_uncertainty_is_not_below_the_errors_of_the_last_seconds(arm):
    arm.batch(0, received=100.0, record=record(3.0))
    for number in range(1, 5):
        arm.batch(number, received=110.0 + number, record=record(0.5))
    noise = trained().noise_std[0] ** 2
    floor = learnt.floor(arm.database, ARM, 1, 5, 2)
    np.testing.assert_allclose(floor, [0.25 - noise, 0.0], rtol=1e-9)
    assert learnt.floor(arm.database, ARM, 1, 1, 2)[0] == pytest.approx(9.0 - noise)
    assert learnt.floor(arm.database, ARM, 2, 5, 2).tolist() == [0.0, 0.0]
    assert learnt.floor(arm.database, ARM, 1, 0, 2).tolist() == [0.0, 0.0]
    found = LearntVersions(arm.database, arm.files).find(ARM, 1, arm.base)
    assert found.model.predict(*QUERIES).tau_std[:, 0].min() >= np.sqrt(0.25 - noise) * (1 - 1e-9)


def test_slow_streams_are_judged_by_enough_rows(arm):
    for number in range(4):
        arm.batch(number, received=100.0 + 60 * number, record=record(1.0 if number < 2 else 0.0))
    assert learnt.floor(arm.database, ARM, 1, 4, 2)[0] == 0.0  # 200 rows without error
    assert learnt.floor(arm.database, ARM, 1, 3, 2)[0] > 0.1
