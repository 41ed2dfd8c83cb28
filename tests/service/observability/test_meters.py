"""What is counted: in the right bucket, without labels that clients could make up, for the model that a stream asks."""

from time import perf_counter

import pytest

from service.foundation.settings import Settings
from service.telemetry.meters import BUCKET_BOUNDS_S, OTHER, Durations, Kind, Meters, RequestMeter, merge_durations
from tests.service.streams import LATE, frame
from tests.service.test_stream_session import Loaded, Model, reply, session


def test_a_duration_counts_up_to_its_bound():
    durations = Durations((0.1, 1.0))
    for seconds in (0.0, 0.1, 0.1000001, 1.0, 5.0):
        durations.add(seconds)
    assert durations.counts == [2, 2, 1]
    assert durations.total == pytest.approx(6.2000001)


def test_merged_durations_are_those_of_all():
    one, two = Durations(), Durations()
    one.add(BUCKET_BOUNDS_S[0])
    two.add(BUCKET_BOUNDS_S[0])
    two.add(1e9)
    both = merge_durations([one, two])
    assert (both.counts[0], both.counts[-1], both.total) == (2, 1, pytest.approx(1e9))


def test_models_beyond_the_most_are_taken_together():
    meter = RequestMeter(most_models=2)
    for name in ("a", "b", "c", "d", "a", ""):
        meter.find(Kind("GET", "/r", name, 200, ""), exists=True).add(0.1)
    assert {kind[2]: sum(each.counts) for kind, each in meter.known.items()} == {"a": 2, "b": 1, OTHER: 2, "": 1}


def test_streams_share_the_models_of_requests():
    meters = Meters(most_models=1)
    meters.requests.find(Kind("GET", "/r", "a", 200, ""), exists=True)
    assert meters.stream("b") is meters.stream("c")
    assert meters.stream("a") is not meters.stream("b")
    assert set(meters.streams()) == {"a", OTHER}


@pytest.fixture
def talk():
    return session(Loaded(v1=Model()), 1)[0]


def test_each_answer_is_timed_and_refused_frames_are_counted_by_code(talk):
    reply(talk)
    reply(talk, arrived=perf_counter() - 7.0)
    reply(talk, b"short")
    reply(talk, b"short")
    assert sum(talk._meter.durations.counts) == 2
    assert 7.0 <= talk._meter.durations.total < 60.0
    assert talk._meter.refused == {"invalid_request": 2}


def test_without_a_budget_the_setting_is_the_deadline(talk):
    assert talk._deadline == Settings().stream_deadline_s
    talk._deadline = 60.0
    reply(talk)
    assert talk._meter.late == 0
    seen = reply(talk, arrived=perf_counter() - 61.0)
    assert (talk._meter.late, seen.late) == (1, 0)  # the client named none: it does not hear of one


def test_what_is_late_is_flagged_counted_and_told_by_its_seconds(talk):
    """One definition: the time from the frame's arrival to its answer's departure is more than the deadline."""
    talk._deadline, late = 0.0, 0
    for budget, ago in ((60.0, 0.0), (5.0, 10.0), (60.0, 0.0), (5.0, 10.0), (60.0, 10.0)):
        seen = reply(talk, frame(budget=budget), perf_counter() - ago)
        assert bool(seen.flags & LATE) == (seen.seconds > budget) == (ago > budget)
        late += bool(seen.flags & LATE)
        assert seen.late == talk._meter.late == late
        talk.left = perf_counter() + 100.0  # how long the writing of it takes is no matter of this clock
    assert late == 2
