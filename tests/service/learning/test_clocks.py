"""Wrong and corrected clocks of robots and of the host: learning continues and forgets nothing."""

import time

import numpy as np
import pytest

from tests.service.learning.learning_models import observation_batch, start_service

YEAR_S = 365 * 86400.0
FORGETTING_OPTIONS = {"forgetting_s": 600.0}


class HostClock:
    """Clock of the host with an adjustable offset."""

    def __init__(self, monkeypatch):
        self.offset_s, real = 0.0, time.time
        monkeypatch.setattr(time, "time", lambda: real() + self.offset_s)


@pytest.fixture
def host_clock(monkeypatch):
    return HostClock(monkeypatch)


def shifted_batch(number, stream_id="arm", by=22.8 * 3600):
    body = observation_batch(number, stream_id)
    return body | {"t": [each + by for each in body["t"]]}


def mean_std(answer):
    return np.array(answer["tau_std"]).mean()


@pytest.mark.slow
def test_clock_jump_rejects_rows_and_forgets_nothing(learning_service):
    learning_model, reference = (
        learning_service.create_model(name, **FORGETTING_OPTIONS) for name in ("clock-leap", "clock-even")
    )
    for each in (reference, learning_model):
        each.send_batches(0, 1)
    reference.send_batches(*range(4), stream_id="other")
    for number in (2, 3):
        reply = learning_model.post("observations", shifted_batch(number))
        assert (reply["accepted"], reply["effective_samples"], reply["rejected"]) == (0, 0.0, {"time_jump": 10})
    reply = learning_model.send_batches(*range(4), stream_id="other")
    assert (reply["accepted"], reply["effective_samples"]) == (10, pytest.approx(1.0, abs=0.01))
    assert mean_std(learning_model.predict()) == pytest.approx(mean_std(reference.predict()), rel=0.01)
    (alarm,) = (each for each in learning_model.get("alarms")["items"] if each["kind"] == "clock")
    assert alarm["evidence"] == {"stream_id": "arm", "ahead_s": pytest.approx(22.8 * 3600, abs=10)}
    assert learning_model.send_batches(4)["accepted"] == 10  # the clock is correct again
    replayed = learning_model.post("observations/arm/2/replay", {})
    assert replayed["codes"] == {"time_jump": 10}
    assert mean_std(learning_model.wait_for_revision(replayed["revision"])) < 1.1 * mean_std(reference.predict())


@pytest.mark.slow
def test_recording_can_be_sent_faster_than_real_time(learning_service):
    learning_model = learning_service.create_model("clock-fast", **FORGETTING_OPTIONS)
    for number in range(30):
        body = observation_batch(number)
        reply = learning_model.post("observations", body | {"t": (np.arange(10) + 10 * number).tolist()})
        assert reply["accepted"] == 10  # 300 s
    assert learning_model.get("alarms")["items"] == []


@pytest.mark.slow
def test_rows_too_late_to_be_learnt_are_rejected(learning_service):
    learning_model = learning_service.create_model("clock-late", **FORGETTING_OPTIONS)
    learning_model.send_batches(0)
    reply = learning_model.post("observations", shifted_batch(0, by=-5000.0) | {"sequence": 1})
    assert reply["rejected"] == {"time_jump": 10}  # backwards: the next batch is taken as one of a clock that was set
    reply = learning_model.post("observations", shifted_batch(1, by=-5000.0) | {"sequence": 2})
    assert (reply["accepted"], reply["effective_samples"], reply["rejected"]) == (0, 0.0, {"late": 10})
    half = learning_model.post("observations", shifted_batch(2, "other") | {"sequence": 0})
    assert half["accepted"] == 10
    late = learning_model.post("observations", shifted_batch(1, "other", 22.8 * 3600 - 600.0) | {"sequence": 1})
    assert late["rejected"] == {"time_jump": 10}
    late = learning_model.post("observations", shifted_batch(3, "other", 22.8 * 3600 - 600.0) | {"sequence": 2})
    assert late["effective_samples"] == pytest.approx(np.exp(-1.0), rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("off", [YEAR_S, -YEAR_S])
def test_corrected_host_clock_does_not_affect_learning(learning_service, host_clock, off):
    host_clock.offset_s = off
    learning_model = learning_service.create_model(f"clock-host-{off > 0}", **FORGETTING_OPTIONS)
    learning_model.send_batches(*range(4))
    earlier_std = mean_std(learning_model.predict())
    host_clock.offset_s = 0.0
    for number in range(4, 8):
        reply = learning_model.send_batches(number)
        assert (reply["accepted"], reply["effective_samples"]) == (10, pytest.approx(1.0, abs=0.01))
    assert mean_std(learning_model.predict()) < 1.5 * earlier_std
    window = learning_model.get("quality")["windows"][0]
    assert window["rows"] == 80
    shown = next(each for each in learning_model.get("learning")["status"]["streams"] if each["stream_id"] == "arm")
    assert shown["offset_s"] == pytest.approx(time.time(), abs=60)
    assert learning_model.send_batches(0, stream_id="new")["accepted"] == 10


@pytest.mark.slow
def test_streams_continue_after_clock_correction_during_downtime(learning_service, tmp_path, host_clock):
    host_clock.offset_s = YEAR_S
    with start_service(tmp_path, learning_service.trained) as before:
        learning_model = before.create_model("back", **FORGETTING_OPTIONS)
        learning_model.send_batches(0, 1)
        earlier_std = mean_std(learning_model.predict())
    host_clock.offset_s = 0.0
    with start_service(tmp_path, learning_service.trained) as after:
        learning_model = type(learning_model)(after.client, "back")
        reply = learning_model.send_batches(2, 3)
        assert (reply["accepted"], reply["effective_samples"]) == (10, pytest.approx(1.0, abs=0.01))
        assert mean_std(learning_model.predict()) < earlier_std
        assert learning_model.get("quality")["windows"][0]["rows"] == 20
