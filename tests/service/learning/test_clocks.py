"""Wrong and corrected clocks of robots and of the host: learning continues and forgets nothing."""

import time

import numpy as np
import pytest

from service.storage.database import iso_time
from tests.service.learning.learning_models import LearningModel, observation_batch, start_service

YEAR_S = 365 * 86400.0
FORGETTING_OPTIONS = {"forgetting_s": 600.0}


@pytest.fixture
def set_host_clock(monkeypatch):
    """Function that sets the offset of the host's clock, s."""
    return lambda offset_s, real=time.time: monkeypatch.setattr(time, "time", lambda: real() + offset_s)


def shifted_batch(number, stream_id="arm", by=22.8 * 3600, **changes):
    body = observation_batch(number, stream_id, **changes)
    return body | {"t": [each + by for each in body["t"]]}


def mean_std(learning_model):
    return np.mean(learning_model.predict()["tau_std"])


def assert_learnt_completely(reply):
    assert (reply["accepted"], reply["effective_samples"]) == (10, pytest.approx(1.0, abs=0.01))


@pytest.mark.slow
def test_clock_jump_rejects_rows_and_forgets_nothing(learning_service):
    learning_model, reference = (learning_service.create_model(**FORGETTING_OPTIONS) for _ in range(2))
    for each in (reference, learning_model):
        each.send_batches(0, 1)
    reference.send_batches(*range(4), stream_id="other")
    for number in (2, 3):
        reply = learning_model.post("observations", shifted_batch(number))
        assert (reply["accepted"], reply["effective_samples"], reply["rejected"]) == (0, 0.0, {"time_jump": 10})
    assert_learnt_completely(learning_model.send_batches(*range(4), stream_id="other"))
    assert mean_std(learning_model) == pytest.approx(mean_std(reference), rel=0.01)
    (alarm,) = (each for each in learning_model.get("alarms")["items"] if each["kind"] == "clock")
    assert alarm["evidence"] == {"stream_id": "arm", "ahead_s": pytest.approx(22.8 * 3600, abs=10)}
    assert learning_model.send_batches(4)["accepted"] == 10  # the clock is correct again
    replayed = learning_model.post("observations/arm/2/replay", {})
    assert replayed["codes"] == {"time_jump": 10}
    learning_model.wait_for_revision(replayed["revision"])
    assert mean_std(learning_model) < 1.1 * mean_std(reference)


@pytest.mark.slow
def test_rows_too_late_to_be_learnt_are_rejected(learning_service):
    learning_model = learning_service.create_model(**FORGETTING_OPTIONS)
    learning_model.send_batches(0)
    reply = learning_model.post("observations", shifted_batch(0, by=-5000.0, sequence=1))
    assert reply["rejected"] == {"time_jump": 10}  # backwards: the next batch is taken as one of a clock that was set
    reply = learning_model.post("observations", shifted_batch(1, by=-5000.0, sequence=2))
    assert (reply["accepted"], reply["effective_samples"], reply["rejected"]) == (0, 0.0, {"late": 10})
    ahead = learning_model.post("observations", shifted_batch(2, "other", sequence=0))
    assert ahead["accepted"] == 10
    late = learning_model.post("observations", shifted_batch(1, "other", 22.8 * 3600 - 600.0, sequence=1))
    assert late["rejected"] == {"time_jump": 10}
    late = learning_model.post("observations", shifted_batch(3, "other", 22.8 * 3600 - 600.0, sequence=2))
    assert late["effective_samples"] == pytest.approx(np.exp(-1.0), rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("off", [YEAR_S, -YEAR_S])
def test_corrected_host_clock_does_not_affect_learning(learning_service, set_host_clock, off):
    set_host_clock(off)
    learning_model = learning_service.create_model(**FORGETTING_OPTIONS)
    learning_model.send_batches(*range(4))
    earlier_std = mean_std(learning_model)
    set_host_clock(0.0)
    for number in range(4, 8):
        assert_learnt_completely(learning_model.send_batches(number))
    assert mean_std(learning_model) < 1.5 * earlier_std
    assert learning_model.get("quality")["windows"][0]["rows"] == 80
    (shown,) = learning_model.get("learning")["status"]["streams"]
    assert (shown["stream_id"], shown["offset_s"]) == ("arm", pytest.approx(time.time(), abs=60))
    assert learning_model.send_batches(0, stream_id="new")["accepted"] == 10


@pytest.mark.slow
def test_streams_continue_after_clock_correction_during_downtime(learning_service, tmp_path, set_host_clock):
    set_host_clock(YEAR_S)
    with start_service(tmp_path, learning_service.trained) as before:
        learning_model = before.create_model("back", **FORGETTING_OPTIONS)
        learning_model.send_batches(0, 1)
        earlier_std = mean_std(learning_model)
    set_host_clock(0.0)
    with start_service(tmp_path, learning_service.trained) as after:
        learning_model = LearningModel(after.client, "back")
        assert_learnt_completely(learning_model.send_batches(2, 3))
        assert mean_std(learning_model) < earlier_std
        assert learning_model.get("quality")["windows"][0]["rows"] == 20


@pytest.mark.parametrize(("seconds", "text"), [(-1e300, "0001-01-01T00:00:00"), (1e300, "9999-12-31T23:59:59")])
def test_times_outside_the_calendar_get_the_nearest_date(seconds, text):
    assert iso_time(seconds) == f"{text}.000+00:00"
