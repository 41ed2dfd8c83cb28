"""A model that is followed live: its events over HTTP."""

from __future__ import annotations

import numpy as np
import pytest

from service.learning.control.schema import LiveRows, LiveStatus
from tests.service.data import error, eventually, service_of
from tests.service.learning.following import following
from tests.service.learning.lessons import LESSON, lesson
from tests.service.server import Server
from tests.service.streams import TAU, dial, frame, hello


def test_rows_are_told_with_what_was_predicted_before_they_were_learnt(school):
    pupil = school.enrol("seen")
    sent = lesson(0)
    model = school.service.loaded.get("seen", None).model
    before = model.predict(*(np.array(sent[name]) for name in ("q", "dq", "ddq")))
    with following(school.client, "seen") as listener:
        assert listener.status == 200
        assert listener.events[0][0] == "status"
        said = pupil.teach(0)
        eventually(lambda: listener.rows() == LESSON)
        (part,) = listener.parts()
        LiveRows.model_validate({"parts": [part]})
        assert (part["stream_id"], part["version"], part["revision"]) == ("arm", 1, 0)
        assert part["counts"] == {"learnt": LESSON}
        shown = len(part["time"])
        assert 1 <= shown <= LESSON
        places = [int(np.abs(np.array(sent["tau"]) - row).sum(axis=1).argmin()) for row in np.array(part["tau"])]
        assert places == sorted(set(places))
        for name, expected in (("tau", np.array(sent["tau"])), ("mean", before.tau), ("std", before.tau_std)):
            assert np.allclose(part[name], expected[places], atol=1e-6), name
        assert np.allclose(part["q"], np.array(sent["q"])[places[-1]], atol=1e-6)
        assert part["noise_std"] == model.noise_std.tolist()
        total = np.sqrt(before.tau_std**2 + model.noise_std**2)
        worst = (np.abs(np.array(sent["tau"]) - before.tau) / total).max(axis=0)
        assert np.allclose(part["worst"], worst, atol=2e-3)
        status = eventually(lambda: (last := listener.of("status")[-1])["revision"] == said["revision"] and last)
        LiveStatus.model_validate(status)
        assert status["counts"]["learnt"] == LESSON
        assert status["counts"]["batches"] == 1
        assert status["windows"][0]["rows"] == status["windows"][0]["accepted"] == LESSON
        assert (status["learns"], status["held"], status["alarms"], status["failure"]) == (True, None, [], None)
    assert service_of(school.client).learners.live.open == 0


def test_rows_that_are_kept_out_are_counted_and_shown_with_their_code(school):
    pupil = school.enrol("kept-out", contact_threshold=8.0)
    body = lesson(0)
    body["tau"][2] = [1e3, 1e3]
    body["tau"][3] = [None, 0.0]
    with following(school.client, "kept-out") as listener:
        pupil.post("observations", body)
        eventually(lambda: listener.rows() == LESSON)
        (part,) = listener.parts()
        assert part["counts"] == {"learnt": LESSON - 2, "contact": 1, "non_finite": 1}
        assert set(part["code"]) - {"learnt"}
        for code, tau, mean, std in zip(part["code"], part["tau"], part["mean"], part["std"], strict=True):
            assert (None in mean) == (None in std) == (code == "non_finite")
            assert code != "non_finite" or tau[0] is None
        assert max(part["worst"]) > 8


def test_a_change_that_waits_for_a_decision_is_told(school):
    pupil = school.enrol("changed-live", contact_threshold=8.0, on_change="hold")
    with following(school.client, "changed-live") as listener:
        for number in range(40):
            body = lesson(number)
            body["tau"] = (np.array(body["tau"]) + 20.0).tolist()
            if pupil.post("observations", body)["held"]:
                break
        status = eventually(lambda: (last := listener.of("status")[-1])["held"] and last)
        assert status["alarms"][0]["kind"] == "change"
        assert status["held"]["evidence"]["stream_id"] == "arm"
        assert status["on_change"] == "hold"
        pupil.post("learning/change", {"decision": "adapt"})
        eventually(lambda: listener.of("status")[-1]["held"] is None)


def test_readers_share_what_is_told_and_nothing_is_kept_without_them(school):
    pupil = school.enrol("shared")
    feed = school.service.learners.live
    pupil.post("observations", lesson(0))
    assert "shared" not in feed._followed
    with following(school.client, "shared") as one, following(school.client, "shared") as other:
        assert feed.open == 2
        pupil.post("observations", lesson(1))
        eventually(lambda: one.rows() == other.rows() == LESSON)
        assert one.of("rows") == other.of("rows")
        assert list(feed._followed) == ["shared"]
    assert feed.open == 0
    assert not feed._followed


def test_following_ends_when_the_model_is_deleted(school):
    school.enrol("short-lived")
    with following(school.client, "short-lived") as listener:
        assert school.client.delete("/v1/models/short-lived").status_code == 204
        eventually(lambda: listener.ended)
    error(school.client.get("/v1/models/short-lived/live"), 404, "not_found")


def test_no_more_readers_than_may_be(school, monkeypatch):
    school.enrol("crowded")
    monkeypatch.setattr(school.service.learners.live, "open", school.service.settings.max_live_followers)
    answer = school.client.get("/v1/models/crowded/live")
    error(answer, 429, "busy")
    assert int(answer.headers["retry-after"]) > 0


@pytest.mark.slow
def test_a_service_that_is_told_to_stop_ends_the_events(home):
    """In a process of its own, with a stream: its answers are told too."""
    with Server(home) as server:
        model = "/v1/models/panda-sim"
        with (
            dial(server, f"{model}/stream?stream_id=arm") as stream,
            server.client.stream("GET", f"{model}/live", timeout=30) as answer,
        ):
            assert answer.headers["content-type"].startswith("text/event-stream")
            lines = answer.iter_lines()
            assert next(lines) == "event: status"
            hello(stream)
            stream.send(frame(np.full((3, 7), 0.1), tau=np.resize(TAU, 7)))
            assert any(line == "event: rows" for line in lines)
            assert any('"answers":{' in line and '"count":1' in line for line in lines)
            server.process.terminate()
            for _ in lines:
                pass
        eventually(lambda: server.process.poll() is not None)
