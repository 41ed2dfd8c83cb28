"""Clocks that are wrong, of a robot or of the host, and are set right: learning goes on, and forgets nothing for it."""

import time

import numpy as np
import pytest

from tests.service.learning.lessons import lesson
from tests.service.learning.lessons import school as opened

YEAR = 365 * 86400.0
FORGETFUL = {"forgetting_s": 600.0}


class Host:
    """The clock of the machine, which can be set."""

    def __init__(self, monkeypatch):
        self.off, real = 0.0, time.time
        monkeypatch.setattr(time, "time", lambda: real() + self.off)


@pytest.fixture
def host(monkeypatch):
    return Host(monkeypatch)


def leapt(number, stream_id="arm", by=22.8 * 3600):
    body = lesson(number, stream_id)
    return body | {"t": [each + by for each in body["t"]]}


def width(answer):
    return np.array(answer["tau_std"]).mean()


def test_a_stream_whose_clock_leaps_waits_and_nothing_is_forgotten_for_it(school):
    pupil, steady = (school.enrol(name, **FORGETFUL) for name in ("clock-leap", "clock-even"))
    for each in (steady, pupil):
        each.teach(0, 1)
    steady.teach(*range(4), stream_id="other")
    for number in (2, 3):
        said = pupil.post("observations", leapt(number))
        assert (said["accepted"], said["effective_samples"], said["rejected"]) == (0, 0.0, {"time_jump": 10})
    said = pupil.teach(*range(4), stream_id="other")
    assert (said["accepted"], said["effective_samples"]) == (10, pytest.approx(1.0, abs=0.01))
    assert width(pupil.predict()) == pytest.approx(width(steady.predict()), rel=0.01)
    (alarm,) = (each for each in pupil.get("alarms")["items"] if each["kind"] == "clock")
    assert alarm["evidence"] == {"stream_id": "arm", "ahead_s": pytest.approx(22.8 * 3600, abs=10)}
    assert pupil.teach(4)["accepted"] == 10  # its clock is right again
    replayed = pupil.post("observations/arm/2/replay", {})
    assert replayed["codes"] == {"time_jump": 10}
    assert width(pupil.settled(replayed["revision"])) < 1.1 * width(steady.predict())


def test_a_recording_may_be_sent_faster_than_it_was_measured(school):
    pupil = school.enrol("clock-fast", **FORGETFUL)
    for number in range(30):
        body = lesson(number)
        said = pupil.post("observations", body | {"t": (np.arange(10) + 10 * number).tolist()})
        assert said["accepted"] == 10  # 300 s
    assert pupil.get("alarms")["items"] == []


def test_rows_that_come_so_late_that_they_would_teach_nothing_are_not_accepted(school):
    pupil = school.enrol("clock-late", **FORGETFUL)
    pupil.teach(0)
    said = pupil.post("observations", leapt(0, by=-5000.0) | {"sequence": 1})
    assert said["rejected"] == {"time_jump": 10}  # back: the next batch is of a clock that was set
    said = pupil.post("observations", leapt(1, by=-5000.0) | {"sequence": 2})
    assert (said["accepted"], said["effective_samples"], said["rejected"]) == (0, 0.0, {"late": 10})
    half = pupil.post("observations", leapt(2, "other") | {"sequence": 0})
    assert half["accepted"] == 10
    late = pupil.post("observations", leapt(1, "other", 22.8 * 3600 - 600.0) | {"sequence": 1})
    assert late["rejected"] == {"time_jump": 10}
    late = pupil.post("observations", leapt(3, "other", 22.8 * 3600 - 600.0) | {"sequence": 2})
    assert late["effective_samples"] == pytest.approx(np.exp(-1.0), rel=0.02)


@pytest.mark.parametrize("off", [YEAR, -YEAR])
def test_a_host_whose_clock_is_set_right_goes_on_as_if_it_had_been_right(school, host, off):
    host.off = off
    pupil = school.enrol(f"clock-host-{off > 0}", **FORGETFUL)
    pupil.teach(*range(4))
    known = width(pupil.predict())
    host.off = 0.0
    for number in range(4, 8):
        said = pupil.teach(number)
        assert (said["accepted"], said["effective_samples"]) == (10, pytest.approx(1.0, abs=0.01))
    assert width(pupil.predict()) < 1.5 * known
    window = pupil.get("quality")["windows"][0]
    assert window["rows"] == 80
    shown = next(each for each in pupil.get("learning")["status"]["streams"] if each["stream_id"] == "arm")
    assert shown["offset_s"] == pytest.approx(time.time(), abs=60)
    assert pupil.teach(0, stream_id="new")["accepted"] == 10


def test_a_host_whose_clock_was_set_back_while_nothing_ran_lets_streams_go_on(school, tmp_path, host):
    host.off = YEAR
    with opened(tmp_path, school.trained) as before:
        pupil = before.enrol("back", **FORGETFUL)
        pupil.teach(0, 1)
        known = width(pupil.predict())
    host.off = 0.0
    with opened(tmp_path, school.trained) as after:
        pupil = type(pupil)(after.client, "back")
        said = pupil.teach(2, 3)
        assert (said["accepted"], said["effective_samples"]) == (10, pytest.approx(1.0, abs=0.01))
        assert width(pupil.predict()) < known
        assert pupil.get("quality")["windows"][0]["rows"] == 20
