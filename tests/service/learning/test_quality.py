"""Prequential quality: what was said of rows before they were learnt, against what was measured."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lipcore.online.record import Record
from service.learning.control import status
from service.learning.ingest.monitor import Window
from tests.service.data import error
from tests.service.learning.lessons import lesson

FIGURES = ("nmse", "rmse", "coverage", "nlpd")


def by_hand(taught, answers):
    """The four figures, straight from their definitions, of all rows against the answers that came before."""
    tau = np.vstack([batch["tau"] for batch in taught])
    mean, std = (np.vstack([answer[name] for answer in answers]) for name in ("tau", "tau_std"))
    noise = np.array(answers[0]["noise_std"])
    error, total = tau - mean, np.sqrt(std**2 + noise**2)
    density = np.exp(-(error**2) / (2 * total**2)) / np.sqrt(2 * math.pi * total**2)
    return {
        "nmse": (error**2).mean(0) / ((tau - tau.mean(0)) ** 2).mean(0),
        "rmse": np.sqrt((error**2).mean(0)),
        "coverage": (np.abs(error) <= 1.959963984540054 * total).mean(0),
        "nlpd": -np.log(density).mean(0),
    }


def test_rows_are_predicted_before_they_are_learnt(school):
    pupil = school.enrol("prequential")
    taught, answers = [lesson(number) for number in range(3)], []
    for number, batch in enumerate(taught):
        answers.append(pupil.predict({name: batch[name] for name in ("q", "dq", "ddq")}))
        assert answers[-1]["revision"] == number
        pupil.teach(number)
    expected = by_hand(taught, answers)
    seen = pupil.get("quality")
    assert (seen["model"], seen["version"], seen["revision"], seen["level"]) == ("prequential", 1, 3, 0.95)
    assert seen["joint_names"] == ["joint1", "joint2"]
    assert [window["seconds"] for window in seen["windows"]] == list(school.service.settings.quality_windows_s)
    for window in seen["windows"]:
        assert (window["rows"], window["accepted"], window["rejected"]) == (30, 30, {})
        for name in FIGURES:
            assert window[name] == pytest.approx(expected[name], rel=1e-9), name
    after = pupil.predict({name: taught[0][name] for name in ("q", "dq", "ddq")})
    late, early = (np.abs(np.subtract(answer["tau"], taught[0]["tau"])).mean() for answer in (after, answers[0]))
    assert late < early  # which would have flattered


def test_without_rows_nothing_is_known(school):
    for window in school.enrol("silent").get("quality")["windows"]:
        assert (window["rows"], window["accepted"], window["rejected"]) == (0, 0, {})
        assert all(window[name] == [None, None] for name in FIGURES)


def test_a_torque_that_does_not_vary_has_no_nmse(school):
    pupil = school.enrol("constant")
    tau = [[row[0], 0.25] for row in lesson(0)["tau"]]
    pupil.teach(0, tau=tau)
    for window in pupil.get("quality")["windows"]:
        assert window["nmse"][0] is not None
        assert window["nmse"][1] is None
        assert None not in window["rmse"] + window["coverage"] + window["nlpd"]


def test_rows_that_are_kept_out_are_counted_by_code(school):
    pupil = school.enrol("counted")
    batch = lesson(0)
    q, dq = [[*row] for row in batch["q"]], [[*row] for row in batch["dq"]]
    q[2][0], q[5][1], dq[7][0] = None, 1000.0, 1000.0
    pupil.teach(0, q=q, dq=dq)
    for window in pupil.get("quality")["windows"]:
        assert (window["accepted"], window["rejected"]) == (7, {"non_finite": 1, "limit": 2})
        assert window["rows"] == 7


def test_windows_slide():
    seen = Window(60.0, 1)
    for at, value in ((1000.0, 1.0), (1050.0, 3.0)):
        record = Record.of(np.full((4, 1), value), np.zeros((4, 1)), np.zeros((4, 1)), np.ones(1))
        seen.add(record, {"learnt": 4, "contact": 1}, at)
    whole, half, none = (status.window(seen, now) for now in (1055.0, 1065.0, 1200.0))
    assert (whole.rows, whole.accepted, whole.rejected) == (8, 8, {"contact": 2})
    assert whole.rmse == pytest.approx([math.sqrt((1 + 9) / 2)])
    assert (half.rows, half.rmse, half.nmse) == (4, [3.0], [None])
    assert (none.rows, none.accepted, none.rejected, none.rmse) == (0, 0, {}, [None])


def test_a_model_that_does_not_exist_has_no_quality(school):
    error(school.client.get("/v1/models/nobody/quality"), 404, "not_found")
