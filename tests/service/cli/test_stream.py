"""`lipserve stream` and `lipserve bench`."""

import json
import signal
from itertools import count

import numpy as np
import pytest
import typer

from lipserve import StreamClient, StreamError
from lipserve.exchange import StreamAnswer, StreamRefusal
from service.cli.playing import Tally, recorded, refused_figures
from service.cli.simulate import app as simulating
from service.cli.stream import app as streaming_app
from tests.service.data import eventually, stream, train, upload


def lines(text):
    return [json.loads(line) for line in text.splitlines()]


@pytest.mark.slow
def test_simulated_robot_is_played_and_learnt(lipserve, server):
    train(server.client, "cli-taught", upload(server.client, stream())["id"])
    code, out, err = lipserve(
        *("stream", "cli-taught", "--simulate", "double-pendulum", "--seconds", 1.2, "--rate", 50, "--fast"),
        *("--learn", "--stream-id", "cell", "--url", server.url, "--json"),
    )
    assert code == 0, err
    assert "60 rows in 1.18 s (50 Hz) to cli-taught version 1, learning from stream cell" in err
    *seconds, last = lines(out)
    assert [each["second"] for each in seconds] == [1, 2]
    assert sum(each["rows"] for each in seconds) == last["summary"]["rows"] == 60
    learnt = last["summary"]["learnt"]
    assert learnt["accepted"] + sum(learnt["kept_out"].values()) == 60
    assert [each["joint"] for each in last["summary"]["joints"]] == ["joint1", "joint2"]
    assert last["summary"]["rmse"] > 0
    observed = server.client.get("/v1/models/cli-taught/observations", params={"stream_id": "cell"}).json()["items"]
    assert sum(each["rows"] for each in observed) == 60


def test_stream_and_simulate_have_the_same_simulation_options():
    """Except for the number of samples and the output."""
    commands = [typer.main.get_command(each) for each in (simulating, streaming_app)]
    simulate, stream_ = ({each.name: each for each in command.params} for command in commands)
    for name in simulate.keys() - {"robot", "output", "samples", "as_json"}:
        assert stream_[name].opts == simulate[name].opts
        assert stream_[name].help == simulate[name].help
        assert name == "rate" or stream_[name].default == simulate[name].default


@pytest.fixture
def steady(server, arm):
    """Name of a model with default learning options and a contact threshold of eight standard deviations."""
    name = f"cli-steady-{next(NUMBERS)}"
    train(server.client, name, arm[1], estimator="rigid-body")
    return name


NUMBERS = count()
PLAYED = ("--simulate", "double-pendulum", "--seconds", 1.5, "--rate", 100)


@pytest.mark.slow
def test_misfitting_stream_is_reported_and_not_learnt(lipserve, server, steady):
    before = server.client.post(f"/v1/models/{steady}/predict", json=QUERY).json()["tau"]
    off = (*PLAYED, "--viscous", 1, "--coulomb", 1, "--url", server.url, "--json")
    code, out, err = lipserve("stream", steady, *off, "--learn", "--stream-id", "other-arm")
    assert code == 1
    assert f"of the stream's first second is inside the 95 % interval of {steady}: learning is paused" in err
    assert f"`lipserve learning decide {steady} ignore --replay`" in err
    assert lines(out)[-1]["summary"]["learnt"]["kept_out"]["change"] > 0
    alarm = json.loads(lipserve("alarms", steady, "--url", server.url, "--json")[1])[0]
    assert "Stream other-arm does not fit the model: " in alarm["message"]
    assert "learning is paused until you decide" in lipserve("learning", "show", steady, "--url", server.url)[1]
    code, out, err = lipserve("stream", steady, *off, "--learn", "--stream-id", "another")
    assert (code, f"learning of {steady} is paused: rows are stored but not learnt" in err) == (1, True)
    assert f"of this stream's first second is inside the 95 % interval of {steady}, too" in err
    assert "Learning is already paused" in lipserve("alarms", steady, "--url", server.url)[1]
    seen = eventually(lambda: settled(server, steady))
    assert seen == pytest.approx(before, abs=1e-9)
    code, out, err = lipserve("stream", steady, *off)
    assert (code, "of the first second is inside the model's 95 % interval" in err) == (0, True)
    code, out, err = lipserve("learning", "decide", steady, "ignore", "--replay", "--url", server.url)
    assert (code, "learning resumed" in out) == (0, True)
    assert "learning is active" in lipserve("learning", "show", steady, "--url", server.url)[1]
    assert (
        "the decision must be adapt or ignore, got 'go'"
        in lipserve("learning", "decide", steady, "go", "--url", server.url)[2]
    )


def settled(server, model):
    """Return the answer to QUERY if it includes the whole log, else None."""
    status = server.client.get(f"/v1/models/{model}/learning").json()["status"]
    answer = server.client.post(f"/v1/models/{model}/predict", json=QUERY).json()
    return answer["tau"] if answer["revision"] >= status["revision"] else None


QUERY = {"q": [0.3, -0.4], "dq": [0.5, 0.2], "ddq": [0.1, -0.3]}


@pytest.mark.slow
def test_misfitting_stream_is_learnt_with_yes_learn(lipserve, server, steady):
    off = (*PLAYED, "--viscous", 1, "--coulomb", 1, "--url", server.url, "--json")
    code, _, err = lipserve("stream", steady, *off, "--learn", "--yes-learn")
    assert code == 0, err
    assert "learning anyway (--yes-learn)" in err
    assert (
        json.loads(lipserve("learning", "show", steady, "--url", server.url, "--json")[1])["learning"]["status"]["held"]
        is None
    )


def test_fitting_stream_is_learnt_without_warning(lipserve, server, steady):
    code, out, err = lipserve("stream", steady, *PLAYED, "--url", server.url, "--json", "--learn")
    assert (code, "interval" in err) == (0, False)
    assert lines(out)[-1]["summary"]["learnt"]["accepted"] > 0
    assert lipserve("alarms", steady, "--url", server.url)[1] == f"no alarms of {steady}\n"


def test_recording_is_played(run_command, run_rejected_command, arm, recording):
    path = recording(85, "motion.csv", samples=20, rate=40.0)
    text = run_command("stream", arm[0], path)
    assert "total   20 rows; round trip p50 " in text
    assert " late, " in text
    assert "(95 % interval)" in text
    mismatch = "the motion has 2 joints (joint1, joint2), but the model has 7"
    assert mismatch in run_rejected_command("stream", "panda-sim", path)


def test_ctrl_c_ends_stream_and_prints_figures(lipserve, arm, server, monkeypatch):
    sent, send = [], StreamClient.send

    def send_and_interrupt(self, *arguments, **options):
        sent.append(arguments)
        if len(sent) == 5:
            signal.raise_signal(signal.SIGINT)
        return send(self, *arguments, **options)

    monkeypatch.setattr(StreamClient, "send", send_and_interrupt)
    before = signal.getsignal(signal.SIGINT)
    code, out, _ = lipserve("stream", arm[0], "--simulate", "double-pendulum", "--url", server.url, "--json")
    assert (code, len(sent)) == (130, 5)
    assert lines(out)[-1]["summary"]["rows"] == 5
    assert signal.getsignal(signal.SIGINT) is before


def test_stream_closed_by_the_service_prints_figures(lipserve, arm, server, monkeypatch):
    sent, send = [], StreamClient.send

    def send_or_close(self, *arguments, **options):
        sent.append(arguments)
        if len(sent) == 5:
            raise StreamError("the service closed the stream: the service stops", "closed")
        return send(self, *arguments, **options)

    monkeypatch.setattr(StreamClient, "send", send_or_close)
    code, out, err = lipserve("stream", arm[0], "--simulate", "double-pendulum", "--url", server.url, "--json")
    assert (code, lines(out)[-1]["summary"]["rows"]) == (1, 4)
    assert "error: the service closed the stream: the service stops (closed)" in err
    assert "hint: open the stream again when the service is back" in err


def test_recordings_are_prepared_like_uploads(recording):
    path, samples = recording(86, samples=40, rate=20.0), stream(samples=40, rate=20.0, seed=86)
    motion = recorded(path)
    np.testing.assert_array_equal(motion.tau, samples.tau)
    assert (motion.joint_names, motion.step) == (samples.joint_names, pytest.approx(0.05))
    assert len(recorded(path, seconds=0.5)) == 11
    turned, named = motion.ordered(samples.joint_names[::-1])
    assert named
    np.testing.assert_array_equal(turned.q, samples.q[:, ::-1])
    assert not motion.ordered(("shoulder", "elbow"))[1]


def test_tally_matches_figures_of_all_rows():
    rng = np.random.default_rng(87)
    noise, tau = np.array([0.1, 0.2]), rng.normal(size=(40, 2)) * 3
    mean, std = tau + rng.normal(size=(40, 2)) * 0.3, rng.uniform(0.1, 0.3, size=(40, 2))
    tally = Tally(noise)
    for first in (0, 25):
        part = Tally(noise)
        for row in range(first, 25 if first == 0 else 40):
            answer = StreamAnswer(row, mean[row], std[row], 1, 0, False, 0, 0.03 if row % 10 == 0 else 0.0)
            part.add(answer, tau[row], seconds=row / 1e3, behind_s=row / 1e2, deadline=0.0295)
        tally.merge(part)
    figures, error = tally.figures(), tau - mean
    inside = np.abs(error) <= 1.959963984540054 * np.hypot(std, noise)
    assert (figures["rows"], figures["late"], figures["behind_s"]) == (40, 4, 0.39)
    assert figures["received_late"] == 10
    assert figures["rmse"] == pytest.approx(np.sqrt((error**2).mean()))
    assert figures["coverage"] == pytest.approx(inside.mean())
    assert figures["round_trip_ms"]["p50"] == pytest.approx(19.5)
    for at, joint in enumerate(tally.joints(("a", "b"))):
        assert joint["nmse"] == pytest.approx((error[:, at] ** 2).mean() / tau[:, at].var())
        assert joint["coverage"] == pytest.approx(inside[:, at].mean())
    own = tally.opening(1.0)
    assert (own.rows, own.coverage) == (10.0, pytest.approx(inside.mean(axis=0)))
    assert Tally(noise).figures()["rmse"] is None
    assert Tally(noise).joints(("a", "b")) == []


@pytest.mark.slow
def test_latency_is_measured_over_stream_and_http(lipserve, streaming):
    arguments = ["latency", "pendulum", "--queries", 30, "--url", streaming.server.url, "--json"]
    code, out, err = lipserve("bench", *arguments)
    assert code == 0, err
    timed = json.loads(out)
    assert timed["model"] == "pendulum"
    for figures in timed["milliseconds"].values():
        assert 0 < figures["p50"] <= figures["p99"] <= figures["largest"]
    assert set(timed["milliseconds"]) == {"stream", "HTTP"}


def test_consecutive_refusals_for_one_reason_are_merged():
    off, full = ("busy", "too much waits"), ("storage_full", "the disk is full")
    given = [(1, 11, off), (12, 20, off), (21, 22, full), (30, 31, full), (32, 40, off)]
    told = refused_figures([StreamRefusal(first, through, *why, []) for first, through, why in given])
    assert [(each["first"], each["through"], each["code"]) for each in told] == [
        (1, 20, off[0]),
        (21, 22, full[0]),
        (30, 31, full[0]),
        (32, 40, off[0]),
    ]
