"""Frames of gravity, mass matrix and Coriolis torque: answers of the model, payload, errors, and the motion around."""

from dataclasses import replace

import numpy as np
import pytest

from lipcore import load
from lipcore.model.body import Body
from lipcore.model.payload import Carrier
from service.models.loads import StreamPayload
from tests import ROOT
from tests.lipcore.model.test_equation import random_model
from tests.lipcore.remembering import remembering_model, remembering_samples
from tests.service.api.stream.test_session import FakeVersions, answer_frame, make_session
from tests.service.streams import (
    ASK_CORIOLIS,
    ASK_GRAVITY,
    ASK_MASS_MATRIX,
    CORIOLIS,
    ERROR,
    GRAVITY,
    MASS_MATRIX,
    STD,
    frame,
)

Q = np.array([0.1, -0.2, 0.3, -1.8, 0.2, 1.6, 0.3])
DQ = np.linspace(-0.5, 0.7, 7)
GRAVITY_FRAME = frame([Q], flags=ASK_GRAVITY)


@pytest.fixture(scope="module")
def panda():
    return load(ROOT / "models/panda-sim")


def session_of(model, **more):
    return make_session(FakeVersions(v1=model), 1, **more)[0]


def test_parts_are_those_of_the_model(panda):
    session, gravity = session_of(panda, scale=True), panda.gravity(Q)
    for request, flags, mean, std in (
        (frame([Q], flags=ASK_GRAVITY), GRAVITY, gravity.mean, None),
        (frame([Q], flags=ASK_GRAVITY | STD), GRAVITY | STD, gravity.mean, gravity.std),
        (frame([Q], flags=ASK_MASS_MATRIX), MASS_MATRIX, panda.mass_matrix(Q).ravel(), None),
        (frame([Q, DQ], flags=ASK_CORIOLIS), CORIOLIS, panda.coriolis(Q, DQ), None),
    ):
        answer = answer_frame(session, request)
        assert (answer.flags, answer.tau, answer.version) == (flags, None, 1)
        np.testing.assert_array_equal(answer.part, mean)
        assert (answer.std is None) == (std is None)
        if std is not None:
            np.testing.assert_array_equal(answer.std, std)


def test_gravity_has_its_deviation_if_the_stream_asks_for_it(panda):
    session = session_of(panda)
    session._sends_std = True
    np.testing.assert_array_equal(answer_frame(session, GRAVITY_FRAME).std, panda.gravity(Q).std)
    assert answer_frame(session, frame([Q], flags=ASK_MASS_MATRIX)).std is None


def test_parts_include_the_payload_of_the_stream(panda):
    carrier = Carrier(panda)
    carrying = carrier.with_payload(carrier.known(Body(2.0, np.array([0.0, 0.0, 0.1])).parameters))
    loaded = FakeVersions(v1=panda)
    loaded.memory[1].payloads.replace({"arm": StreamPayload(carrying, (2.0, 0.0), 0.0)})
    session, other = (make_session(loaded, 1, stream_id=name)[0] for name in ("arm", "other"))
    np.testing.assert_array_equal(answer_frame(session, GRAVITY_FRAME).part, carrying.gravity(Q).mean)
    np.testing.assert_array_equal(answer_frame(other, GRAVITY_FRAME).part, panda.gravity(Q).mean)
    assert np.abs(carrying.gravity(Q).mean - panda.gravity(Q).mean).max() > 1.0


def test_nonlinear_model_is_computed_in_a_thread():
    model = random_model("lip")
    q, dq = np.array([[0.3, -0.2], [0.1, 0.4]])
    answer = answer_frame(session_of(model), frame([q, dq], flags=ASK_CORIOLIS))
    np.testing.assert_array_equal(answer.part, model.coriolis(q, dq))


def test_part_that_the_model_lacks_is_refused_and_the_stream_continues(panda):
    for model, asked, message in (
        (random_model("se"), ASK_MASS_MATRIX, "its estimator is se, whose torque is not affine"),
        (random_model("gip"), ASK_GRAVITY, "cannot separate gravity from other torque: its estimator is gip"),
        (replace(panda, torque_convention="gravity_compensated"), ASK_GRAVITY, "trained on torque without gravity"),
    ):
        session, n = session_of(model), model.n_joints
        answer = answer_frame(session, frame([np.zeros(n)], flags=asked))
        assert answer.flags == ERROR
        assert message in answer.error["message"]
        assert answer.error["detail"][0]["field"] == "model"
        assert answer_frame(session, frame(np.zeros((3, n)))).tau is not None


def test_parts_are_no_part_of_the_motion_that_friction_follows():
    model, samples = remembering_model(), remembering_samples(seed=8, size=200)
    alone, followed = model.predict(samples.q, samples.dq, samples.ddq).tau, model.predict_along(samples).tau
    last = int(np.abs(alone - followed).max(axis=1).argmax())
    session = session_of(model)
    for t, motion in zip(samples.t[: last + 1], samples.motion().arrays()[:, :3], strict=False):
        answer_frame(session, frame([motion[0] + 1.0], flags=ASK_GRAVITY), t)
        answer = answer_frame(session, frame(motion), t)
    np.testing.assert_allclose(answer.tau, followed[last], rtol=1e-9)
    assert np.abs(alone[last] - followed[last]).max() > 0.1
