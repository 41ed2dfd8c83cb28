"""`lipserve stream`: a motion in real time, and what the model makes of it."""

from __future__ import annotations

import json
import signal

import numpy as np
import pytest

from service.cli.playing import Tally, recorded
from service.cli.simulate import write_recording
from service.client.stream import StreamClient
from service.stream.exchange import StreamAnswer
from tests.service.data import stream, train, upload


def lines(said):
    return [json.loads(line) for line in said.splitlines()]


def test_a_simulated_robot_is_played_and_taught(lipserve, server):
    train(server.client, "cli-taught", upload(server.client, stream())["id"])
    code, said, err = lipserve(
        *("stream", "cli-taught", "--simulate", "double-pendulum", "--seconds", 1.2, "--rate", 50, "--fast"),
        *("--learn", "--stream-id", "cell", "--url", server.url, "--json"),
    )
    assert code == 0, err
    assert "60 rows in 1.18 s (50 Hz) to cli-taught version 1, which it learns from as stream cell" in err
    *seconds, last = lines(said)
    assert [each["second"] for each in seconds] == [1, 2]
    assert sum(each["rows"] for each in seconds) == last["summary"]["rows"] == 60
    learnt = last["summary"]["learnt"]
    assert learnt["accepted"] + sum(learnt["kept_out"].values()) == 60
    assert [each["joint"] for each in last["summary"]["joints"]] == ["joint1", "joint2"]
    assert last["summary"]["rmse"] > 0
    observed = server.client.get("/v1/models/cli-taught/observations", params={"stream_id": "cell"}).json()["items"]
    assert sum(each["rows"] for each in observed) == 60


def test_a_recording_is_played(lipserve, arm, server, tmp_path):
    path = tmp_path / "motion.csv"
    write_recording(path, stream(samples=20, rate=40.0, seed=85))
    code, said, _ = lipserve("stream", arm[0], path, "--url", server.url)
    assert code == 0
    assert "in all  20 rows; round trip p50 " in said
    assert "in the 95 % band" in said
    code, said, err = lipserve("stream", "panda-sim", path, "--url", server.url)
    assert (code, said) == (1, "")
    assert "the motion has 2 joints (joint1, joint2), expected the model's 7" in err


def test_ctrl_c_ends_a_stream_with_its_figures(lipserve, arm, server, monkeypatch):
    asked, ask = [], StreamClient.ask

    def ask_and_press(self, *arguments, **options):
        asked.append(arguments)
        if len(asked) == 5:
            signal.raise_signal(signal.SIGINT)
        return ask(self, *arguments, **options)

    monkeypatch.setattr(StreamClient, "ask", ask_and_press)
    before = signal.getsignal(signal.SIGINT)
    code, said, _ = lipserve("stream", arm[0], "--simulate", "double-pendulum", "--url", server.url, "--json")
    assert (code, len(asked)) == (130, 5)
    assert lines(said)[-1]["summary"]["rows"] == 5
    assert signal.getsignal(signal.SIGINT) is before


def test_recordings_are_prepared_as_uploads_are(tmp_path):
    path, samples = tmp_path / "motion.npz", stream(samples=40, rate=20.0, seed=86)
    write_recording(path, samples)
    found = recorded(path)
    np.testing.assert_array_equal(found.tau, samples.tau)
    assert (found.joint_names, found.step) == (samples.joint_names, pytest.approx(0.05))
    assert len(recorded(path, seconds=0.5)) == 11
    turned, named = found.ordered(samples.joint_names[::-1])
    assert named
    np.testing.assert_array_equal(turned.q, samples.q[:, ::-1])
    assert not found.ordered(("shoulder", "elbow"))[1]


def test_figures_are_those_of_all_rows():
    rng = np.random.default_rng(87)
    noise, tau = np.array([0.1, 0.2]), rng.normal(size=(40, 2)) * 3
    mean, std = tau + rng.normal(size=(40, 2)) * 0.3, rng.uniform(0.1, 0.3, size=(40, 2))
    whole = Tally(noise)
    for first in (0, 25):
        part = Tally(noise)
        for row in range(first, 25 if first == 0 else 40):
            answer = StreamAnswer(row, mean[row], std[row], 1, 0, row % 10 == 0, 0, 0.0)
            part.add(answer, tau[row], seconds=row / 1e3, behind_s=row / 1e2)
        whole.merge(part)
    shown, error = whole.figures(), tau - mean
    inside = np.abs(error) <= 1.959963984540054 * np.hypot(std, noise)
    assert (shown["rows"], shown["late"], shown["behind_s"]) == (40, 4, 0.39)
    assert shown["rmse"] == pytest.approx(np.sqrt((error**2).mean()))
    assert shown["coverage"] == pytest.approx(inside.mean())
    assert shown["round_trip_ms"]["p50"] == pytest.approx(19.5)
    for at, joint in enumerate(whole.joints(("a", "b"))):
        assert joint["nmse"] == pytest.approx((error[:, at] ** 2).mean() / tau[:, at].var())
        assert joint["coverage"] == pytest.approx(inside[:, at].mean())
    assert Tally(noise).figures()["rmse"] is None
    assert Tally(noise).joints(("a", "b")) == []
