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
    rng = np.random.default_rng(seed)
    tau = rng.standard_normal((count, N)) + push
    time, zeros = start + np.arange(count) / 100, np.zeros((count, N))
    rows = Rows(time, zeros, zeros + 0.1, zeros, tau, np.zeros(count, np.uint8), np.full(count, 0.1))
    every = np.ones(count, np.bool_)
    places = np.arange(0, count, 4)
    trained = BasePrediction(places, 4.0, zeros[places], zeros[places])
    seen = IntervalScores(time, np.abs(tau) / 1.96, None)
    return PredictedBatch(
        rows, slice(0, count), every, every, zeros, zeros, zeros, np.ones(N), 1, np.ones(N), trained, seen
    )


def judge_stream(pushes: list[float], **options: Any) -> list[Judgement]:
    """Return the judgements of a stream in batches of half a second."""
    stream, model, out = StreamRecord.start(N), ModelRecord(Innovations.empty(N)), []
    for place, push in enumerate(pushes):
        batch = predict_batch(0.5 * place, 50, push, seed=place)
        found = judge(batch, stream, model, JudgeOptions(**options), lambda: Record.empty(N), 0.5 * place + 0.5)
        stream, model = found.stream, found.model
        out.append(found)
    return out


def comparable(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return {
            each.name: comparable(getattr(value, each.name)) for each in fields(value) if each.name != "innovations"
        }
    if isinstance(value, np.ndarray):
        return value.tolist()
    return [comparable(each) for each in value] if isinstance(value, tuple) else value


COURSES = {
    "no change": ([0.0] * 12, {}),
    "paused by a change": ([0.0] * 6 + [30.0] * 8, {"on_change": "hold"}),
    "change is learnt": ([0.0] * 6 + [30.0] * 8, {"on_change": "adapt"}),
    "mismatched stream": ([30.0] * 6, {"on_change": "hold"}),
    "slow drift": ([0.3 * k for k in range(16)], {"on_change": "learn"}),
    "paused": ([0.0] * 6, {"enabled": False}),
    "without scale": ([0.0] * 6, {"adaptive_intervals": False}),
}


@pytest.mark.parametrize(("pushes", "options"), COURSES.values(), ids=COURSES.keys())
def test_follower_of_the_log_restores_the_state(pushes: list[float], options: dict[str, Any]) -> None:
    follower = ModelRecord(Innovations.empty(N))
    for judged in judge_stream(pushes, **options):
        report = json.loads(json.dumps(judged.logged.to_json()))
        record = None if judged.record is None else Record.from_json(json.loads(json.dumps(judged.record.to_json())))
        follower = follower.follow(LoggedJudgement.from_json(report), record, recent=True)
        assert comparable(follower) == comparable(judged.model)
        kept = StreamRecord.from_json(json.loads(json.dumps(judged.stream.to_json())), judged.stream.received)
        assert comparable(kept) == comparable(judged.stream)


def test_change_pauses_learning_until_a_decision() -> None:
    pushes, options = COURSES["paused by a change"]
    judged = judge_stream(pushes, **options)
    found = [place for place, each in enumerate(judged) if each.change is not None]
    assert len(found) == 1
    before, after = judged[: found[0]], judged[found[0] :]
    assert not any(each.logged.held for each in before)
    assert all(each.logged.held and each.rows.rejected() == {"change": 50} for each in after)
    assert [each.logged.waited for each in after] == [False, *[True] * (len(after) - 1)]
    (stream,) = {id(each.stream.opening) for each in after}
    assert stream == id(None)


def test_mismatched_stream_is_set_aside() -> None:
    pushes, options = COURSES["mismatched stream"]
    judged = judge_stream(pushes, **options)
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
