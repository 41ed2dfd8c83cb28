"""Metrics: durations are counted in the right bucket, for the right model, without labels that clients invent."""

from time import perf_counter

import pytest

from service.foundation.settings import Settings
from service.telemetry.meters import BUCKET_BOUNDS_S, OTHER, Durations, Kind, Meters, RequestMeter, merge_durations
from tests.service.api.stream.test_session import FakeModel, FakeVersions, answer_frame, make_session
from tests.service.streams import LATE, frame


def test_durations_count_up_to_their_bucket_bound_also_merged():
    durations = Durations((0.1, 1.0))
    for seconds in (0.0, 0.1, 0.1000001, 1.0, 5.0):
        durations.add(seconds)
    assert (durations.counts, durations.total) == ([2, 2, 1], pytest.approx(6.2000001))
    one, two = Durations(), Durations()
    for part, seconds in ((one, BUCKET_BOUNDS_S[0]), (two, BUCKET_BOUNDS_S[0]), (two, 1e9)):
        part.add(seconds)
    both = merge_durations([one, two])
    assert (both.counts[0], both.counts[-1], both.total) == (2, 1, pytest.approx(1e9))


def test_models_beyond_the_max_share_a_label_of_requests_and_streams():
    meter = RequestMeter(most_models=2)
    for name in ("a", "b", "c", "d", "a", ""):
        meter.find(Kind("GET", "/r", name, 200, ""), exists=True).add(0.1)
    assert {kind[2]: sum(each.counts) for kind, each in meter.known.items()} == {"a": 2, "b": 1, OTHER: 2, "": 1}
    meters = Meters(most_models=1)
    meters.requests.find(Kind("GET", "/r", "a", 200, ""), exists=True)
    assert meters.stream("b") is meters.stream("c")
    assert meters.stream("a") is not meters.stream("b")
    assert set(meters.streams()) == {"a", OTHER}


def test_deleted_models_share_a_label_and_make_room_for_others():
    meters = Meters(most_models=2)

    def send_requests(*models):
        for name in models:
            meters.requests.find(Kind("GET", "/r", name, 200, ""), exists=True).add(0.1)

    def requests():
        return {kind.model: sum(each.counts) for kind, each in meters.requests.totals().items()}

    def streams():
        return {name: (sum(each.durations.counts), each.late, each.refused) for name, each in meters.streams().items()}

    send_requests("kept", "gone", "beyond")
    meters.stream("gone").durations.add(0.2)
    meters.stream("gone").count_late()
    meters.stream("gone").refuse("invalid_request")
    assert requests() == {"kept": 1, "gone": 1, OTHER: 1}
    meters.forget("gone")
    meters.forget("unknown")
    assert requests() == {"kept": 1, OTHER: 2}
    assert streams() == {OTHER: (1, 1, {"invalid_request": 1})}
    assert [meters.requests.label(name) for name in ("new", "gone")] == ["new", OTHER]
    meters.forget("new")
    send_requests("gone", "gone", "gone")  # created again
    meters.stream("gone").durations.add(0.2)
    assert requests() == {"kept": 1, OTHER: 2, "gone": 3}
    assert streams() == {OTHER: (1, 1, {"invalid_request": 1}), "gone": (1, 0, {})}
    meters.forget("gone")
    assert requests() == {"kept": 1, OTHER: 5}


@pytest.fixture
def stream_session():
    return make_session(FakeVersions(v1=FakeModel()), 1)[0]


def test_answers_are_timed_and_rejected_frames_counted_by_code(stream_session):
    answer_frame(stream_session)
    answer_frame(stream_session, arrived=perf_counter() - 7.0)
    answer_frame(stream_session, b"short")
    answer_frame(stream_session, b"short")
    assert sum(stream_session._meter.durations.counts) == 2
    assert 7.0 <= stream_session._meter.durations.total < 60.0
    assert stream_session._meter.refused == {"invalid_request": 2}


def test_default_deadline_applies_without_a_budget(stream_session):
    assert stream_session._deadline == Settings().stream_deadline_s
    stream_session._deadline = 60.0
    answer_frame(stream_session)
    assert stream_session._meter.late == 0
    seen = answer_frame(stream_session, arrived=perf_counter() - 61.0)
    assert (stream_session._meter.late, seen.late) == (1, 0)  # the client named no budget, so its answer has no flag


def test_late_answer_is_flagged_counted_and_timed(stream_session):
    """An answer is late if the time from the frame's arrival to the answer's departure exceeds the deadline."""
    stream_session._deadline, late = 0.0, 0
    for budget, ago in ((60.0, 0.0), (5.0, 10.0), (60.0, 0.0), (5.0, 10.0), (60.0, 10.0)):
        seen = answer_frame(stream_session, frame(budget=budget), perf_counter() - ago)
        assert bool(seen.flags & LATE) == (seen.seconds > budget) == (ago > budget)
        late += bool(seen.flags & LATE)
        assert seen.late == stream_session._meter.late == late
        stream_session.left = perf_counter() + 100.0  # this clock does not include the time to write it
    assert late == 2
