"""Tests that the log of judgements restores the judge's state exactly."""

import json
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
import pytest

from lipcore.online.batch import Placement, Rows
from lipcore.online.judgement import Innovations, LoggedJudgement, ModelRecord
from lipcore.online.judging import Judgement, JudgeOptions, judge
from lipcore.online.record import Record
from lipcore.online.screening import BasePrediction, IntervalScores, PredictedBatch
from lipcore.online.stream import StreamRecord

N = 2


def predict_batch(start: float, count: int, push: float = 0.0, seed: int = 0) -> PredictedBatch:
    """Return rows at 100 Hz from `start`, s, predicted within the noise except for a push, N·m."""
    tau = np.random.default_rng(seed).standard_normal((count, N)) + push
    time, zeros, one = start + np.arange(count) / 100, np.zeros((count, N)), np.ones(N)
    rows = Rows(time, zeros, zeros + 0.1, zeros, tau, np.zeros(count, np.uint8), np.full(count, 0.1))
    every, places = np.ones(count, np.bool_), np.arange(0, count, 4)
    trained = BasePrediction(places, 4.0, zeros[places], zeros[places])
    seen = IntervalScores(time, np.abs(tau) / 1.96, None)
    return PredictedBatch(rows, slice(0, count), every, every, zeros, zeros, zeros, one, 1, one, trained, seen)


def judge_stream(course: str) -> list[Judgement]:
    """Return the judgements of a stream in batches of half a second. course: of COURSES."""
    pushes, options = COURSES[course]
    stream, model, out = StreamRecord.start(N), ModelRecord(Innovations.empty(N)), []
    for place, push in enumerate(pushes):
        batch = predict_batch(0.5 * place, 50, push, seed=place)
        found = judge(batch, stream, model, JudgeOptions(**options), lambda: Record.empty(N), 0.5 * place + 0.5)
        stream, model = found.stream, found.model
        out.append(found)
    return out


def stored(value: Any) -> Any:
    """Return the JSON that is read back from a log."""
    return json.loads(json.dumps(value.to_json()))


def comparable(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        names = [each.name for each in fields(value) if each.name != "innovations"]
        return {name: comparable(getattr(value, name)) for name in names}
    if isinstance(value, np.ndarray):
        return value.tolist()
    return [comparable(each) for each in value] if isinstance(value, tuple) else value


COURSES: dict[str, tuple[list[float], dict[str, Any]]] = {
    "no change": ([0.0] * 12, {}),
    "paused by a change": ([0.0] * 6 + [30.0] * 8, {"on_change": "hold"}),
    "change is learnt": ([0.0] * 6 + [30.0] * 8, {"on_change": "adapt"}),
    "mismatched stream": ([30.0] * 6, {"on_change": "hold"}),
    "slow drift": ([0.3 * k for k in range(16)], {"on_change": "learn"}),
    "paused": ([0.0] * 6, {"enabled": False}),
    "without scale": ([0.0] * 6, {"adaptive_intervals": False}),
}


@pytest.mark.parametrize("course", COURSES)
def test_follower_of_the_log_restores_the_state(course: str) -> None:
    follower = ModelRecord(Innovations.empty(N))
    for judged in judge_stream(course):
        record = None if judged.record is None else Record.from_json(stored(judged.record))
        follower = follower.follow(LoggedJudgement.from_json(stored(judged.logged)), record, recent=True)
        assert comparable(follower) == comparable(judged.model)
        kept = StreamRecord.from_json(stored(judged.stream), judged.stream.received)
        assert comparable(kept) == comparable(judged.stream)


def test_change_pauses_learning_until_a_decision() -> None:
    judged = judge_stream("paused by a change")
    [found] = [place for place, each in enumerate(judged) if each.change is not None]
    before, after = judged[:found], judged[found:]
    assert not any(each.logged.held for each in before)
    assert all(each.logged.held and each.rows.rejected() == {"change": 50} for each in after)
    assert [each.logged.waited for each in after] == [False, *[True] * (len(after) - 1)]
    assert all(each.stream.opening is None for each in after)


def test_mismatched_stream_is_set_aside() -> None:
    judged = judge_stream("mismatched stream")
    assert [each.opened is not None for each in judged].count(True) == 1
    assert judged[-1].stream.doubted
    assert judged[-1].logged.aside


def test_placement_is_stored_exactly() -> None:
    derived = {"ddq": {"delay_s": 0.04, "window": 4, "rate_hz": 100.0, "carried": 0}}
    for place, entry in (
        (Placement((0, 5), (1.0, 2.0)), None),
        (Placement((3, 8), None, 4), derived),
        (Placement((0, 3), None, None, ((0, 1), (4, 4))), None),
    ):
        report = json.loads(json.dumps(place.to_json() | {"derived": entry}))
        assert Placement.from_json(report) == place
