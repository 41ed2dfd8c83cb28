"""`lipserve stream` and `lipserve bench`."""

import json
import signal
from itertools import count

import numpy as np
import pytest
import typer

from lipserve import StreamClient, StreamError
from lipserve.answers import StreamAnswer, StreamRefusal
from service.cli.playing import Tally, recorded, refused_figures
from service.cli.simulate import app as simulating
from service.cli.stream import app as streaming_app
from tests.service.cli.conftest import lacking
from tests.service.data import eventually, stream, train, upload


@pytest.fixture
def play(run_on_server):
    """Stream a simulated double pendulum to a model; return exit code, printed objects and error output."""

    def run(model, *options):
        code, out, err = run_on_server("stream", model, "--simulate", "double-pendulum", *options, "--json")
        return code, [json.loads(line) for line in out.splitlines()], err

    return run


@pytest.mark.slow
def test_simulated_robot_is_played_and_learnt(play, server):
    train(server.client, "cli-taught", upload(server.client, stream())["id"])
    options = ("--seconds", 1.2, "--rate", 50, "--fast", "--learn", "--stream-id", "cell")
    code, (*seconds, last), err = play("cli-taught", *options)
    assert code == 0, err
    assert "60 rows in 1.18 s (50 Hz) to cli-taught version 1, learning from stream cell" in err
    summary = last["summary"]
    assert [each["second"] for each in seconds] == [1, 2]
    assert sum(each["rows"] for each in seconds) == summary["rows"] == 60
    assert summary["learnt"]["accepted"] + sum(summary["learnt"]["kept_out"].values()) == 60
    assert [each["joint"] for each in summary["joints"]] == ["joint1", "joint2"]
    assert summary["rmse"] > 0
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
PLAYED = ("--seconds", 1.5, "--rate", 100)
OFF = (*PLAYED, "--viscous", 1, "--coulomb", 1)
"""Options of a stream that fits, and of one that does not."""


@pytest.mark.slow
def test_misfitting_stream_is_reported_and_not_learnt(play, run_command, run_rejected_command, server, steady):
    before = server.client.post(f"/v1/models/{steady}/predict", json=QUERY).json()["tau"]
    code, printed, err = play(steady, *OFF, "--learn", "--stream-id", "other-arm")
    parts = (
        f"of the stream's first second is inside the 95 % interval of {steady}: learning is paused",
        f"`lipserve learning decide {steady} ignore --replay`",
    )
    assert (code, lacking(err, *parts)) == (1, [])
    assert printed[-1]["summary"]["learnt"]["kept_out"]["change"] > 0
    alarm = run_command("alarms", steady, "--json")[0]
    assert "Stream other-arm does not fit the model: " in alarm["message"]
    assert "learning is paused until you decide" in run_command("learning", "show", steady)
    code, _, err = play(steady, "--seconds", 4, *OFF[2:], "--learn", "--stream-id", "another")
    parts = (
        f"learning of {steady} is paused: rows are stored but not learnt",
        f"of this stream's first second is inside the 95 % interval of {steady}, too",
    )
    assert (code, lacking(err, *parts), err.count(parts[1])) == (1, [], 1)
    assert "Learning is already paused" in run_command("alarms", steady)
    seen = eventually(lambda: settled(server, steady))
    assert seen == pytest.approx(before, abs=1e-9)
    code, _, err = play(steady, *OFF)
    assert (code, "of the first second is inside the model's 95 % interval" in err) == (0, True)
    assert "learning resumed" in run_command("learning", "decide", steady, "ignore", "--replay")
    assert "learning is active" in run_command("learning", "show", steady)
    message = run_rejected_command("learning", "decide", steady, "go")
    assert "the decision must be adapt or ignore, got 'go'" in message


def settled(server, model):
    """Return the answer to QUERY if it includes the whole log, else None."""
    status = server.client.get(f"/v1/models/{model}/learning").json()["status"]
    answer = server.client.post(f"/v1/models/{model}/predict", json=QUERY).json()
    return answer["tau"] if answer["revision"] >= status["revision"] else None


QUERY = {"q": [0.3, -0.4], "dq": [0.5, 0.2], "ddq": [0.1, -0.3]}


@pytest.mark.slow
def test_misfitting_stream_is_learnt_with_yes_learn(play, run_command, steady):
    code, _, err = play(steady, *OFF, "--learn", "--yes-learn")
    assert (code, "learning anyway (--yes-learn)" in err) == (0, True), err
    assert run_command("learning", "show", steady, "--json")["learning"]["status"]["held"] is None


def test_fitting_stream_is_learnt_without_warning(play, run_command, steady):
    code, printed, err = play(steady, *PLAYED, "--learn")
    assert (code, "interval" in err) == (0, False)
    assert printed[-1]["summary"]["learnt"]["accepted"] > 0
    assert run_command("alarms", steady) == f"no alarms of {steady}\n"


def test_recording_is_played(run_command, run_rejected_command, arm, recording):
    path = recording(85, "motion.csv", samples=20, rate=40.0)
    text = run_command("stream", arm[0], path)
    assert lacking(text, "total   20 rows; round trip p50 ", " late, ", "(95 % interval)") == []
    mismatch = "the motion has 2 joints (joint1, joint2), but the model has 7"
    assert mismatch in run_rejected_command("stream", "panda-sim", path)


def close_stream():
    raise StreamError("the service closed the stream: the service stops", "closed")


CLOSED = (
    "error: the service closed the stream: the service stops (closed)",
    "hint: open the stream again when the service is back",
)


@pytest.mark.parametrize(
    ("end", "code", "rows", "parts"),
    [(lambda: signal.raise_signal(signal.SIGINT), 130, 5, ()), (close_stream, 1, 4, CLOSED)],
    ids=["Ctrl-C", "closed by the service"],
)
def test_ended_stream_prints_figures(play, arm, monkeypatch, end, code, rows, parts):
    """The stream ends at its fifth row."""
    sent, send, handler = [], StreamClient.send, signal.getsignal(signal.SIGINT)

    def send_or_end(self, *arguments, **options):
        sent.append(arguments)
        if len(sent) == 5:
            end()
        return send(self, *arguments, **options)

    monkeypatch.setattr(StreamClient, "send", send_or_end)
    result, printed, err = play(arm[0])
    assert (result, len(sent), printed[-1]["summary"]["rows"]) == (code, 5, rows)
    assert lacking(err, *parts) == []
    assert signal.getsignal(signal.SIGINT) is handler


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
    assert (timed["model"], set(timed["milliseconds"])) == ("pendulum", {"stream", "HTTP"})
    for figures in timed["milliseconds"].values():
        assert 0 < figures["p50"] <= figures["p99"] <= figures["largest"]


def test_consecutive_refusals_for_one_reason_are_merged():
    off, full = ("conflict", "frame {} was sent before"), ("storage_full", "the disk is full")
    given = [(1, 11, off), (12, 20, off), (21, 22, full), (30, 31, full), (32, 40, off)]
    refused = refused_figures(
        [StreamRefusal(first, through, code, text.format(first), []) for first, through, (code, text) in given]
    )
    merged = [(1, 20, off[0]), (21, 22, full[0]), (30, 31, full[0]), (32, 40, off[0])]
    assert [(each["first"], each["through"], each["code"]) for each in refused] == merged
    assert refused[0]["message"] == "frame 1 was sent before"
