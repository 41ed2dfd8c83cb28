"""Frames of streams are timed, and those that are late or wrong counted, for the model that they ask."""

from __future__ import annotations

from time import perf_counter

from service.foundation.settings import Settings
from tests.service.streams import frame
from tests.service.test_stream_session import Loaded, Model, reply, session


def meter(talk):
    return talk._meter


def test_each_answer_is_timed():
    talk, _ = session(Loaded(v1=Model()), 1)
    reply(talk)
    reply(talk, arrived=perf_counter() - 7.0)
    assert sum(meter(talk).durations.counts) == 2
    assert 7.0 <= meter(talk).durations.total < 60.0


def test_without_a_budget_the_setting_is_the_deadline():
    talk, _ = session(Loaded(v1=Model()), 1)
    talk._deadline = 60.0
    reply(talk)
    assert meter(talk).late == 0
    seen = reply(talk, arrived=perf_counter() - 61.0)
    assert (meter(talk).late, seen.late) == (1, 0)  # the client named none: it is not told of one
    assert Settings().stream_deadline_s == session(Loaded(v1=Model()), 1)[0]._deadline


def test_a_budget_is_the_deadline_of_its_frame():
    talk, _ = session(Loaded(v1=Model()), 1)
    talk._deadline = 0.0
    reply(talk, frame(budget=60.0))
    assert meter(talk).late == 0
    reply(talk, frame(budget=5.0), perf_counter() - 10.0)
    assert meter(talk).late == 1


def test_an_answer_that_was_not_read_in_time_is_late():
    talk, _ = session(Loaded(v1=Model()), 1)
    reply(talk, frame(budget=60.0))
    talk.left = perf_counter() + 100.0
    reply(talk, frame(budget=60.0))
    assert meter(talk).late == 1


def test_refused_frames_are_counted_by_code_and_not_timed():
    talk, _ = session(Loaded(v1=Model()), 1)
    reply(talk, b"short")
    reply(talk, b"short")
    assert meter(talk).refused == {"invalid_request": 2}
    assert sum(meter(talk).durations.counts) == 0
