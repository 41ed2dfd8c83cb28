"""Recordings of a double pendulum as a robot streams them, and the expected predictions after learning them."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

import lipcore
from lipcore.data.independence import INDEPENDENT_HZ
from lipcore.data.samples import Samples
from lipcore.online.batch import Rows
from lipcore.online.learner import OnlineModel
from lipcore.vocabulary import CODES
from service.journal import log
from tests.service.data import stream
from tests.service.learning.learning_models import QUERIES, RATE, LearningModel, LearningService, max_difference

NAMES = ("t", "q", "dq", "ddq", "tau")
MAX_DIFFERENCE_NM = 1e-8


def make_recording(samples: int = 400, seed: int = 7, rate: float = RATE) -> Samples:
    """Return a recording whose velocities and accelerations match its times."""
    return stream(samples=samples, seed=seed, rate=rate)


def slice_recording(recorded: Samples, first: int, last: int, without: tuple[str, ...] = ()) -> dict[str, Any]:
    """Return rows first … last - 1 as the fields of a request."""
    return {name: getattr(recorded, name)[first:last].tolist() for name in NAMES if name not in without}


def make_request(sequence: int, body: dict[str, Any], stream_id: str = "arm", **changes: Any) -> dict[str, Any]:
    """Return the body of a request; a change to None leaves the field out."""
    request = {"stream_id": stream_id, "sequence": sequence, **body, **changes}
    return {name: value for name, value in request.items() if value is not None}


def send_batch(
    learning_model: LearningModel, sequence: int, body: dict[str, Any], stream_id: str = "arm", **changes: Any
) -> dict[str, Any]:
    """Send a batch; return its acknowledgement."""
    return learning_model.post("observations", make_request(sequence, body, stream_id, **changes))


def expect_rejection(
    learning_model: LearningModel, request: dict[str, Any], status: int = 422, code: str = "invalid_request"
) -> dict[str, Any]:
    """Return the error of a batch that is rejected."""
    return learning_model.expect_error("POST", "observations", status, code, json=request)


def read_logged_rows(learning_service: LearningService, learning_model: LearningModel) -> list[Rows]:
    """Return the logged rows of each batch of a model."""
    with learning_service.service.database.session() as session:
        found = log.events(session, learning_model.name, 0, 10_000, void=True)
    return [log.decode(event.payload) for event in found if event.kind == "batch"]


def read_codes(learning_service: LearningService, learning_model: LearningModel) -> list[str]:
    """Return the code of each logged row of a model."""
    return [CODES[code] for rows in read_logged_rows(learning_service, learning_model) for code in rows.code.tolist()]


def predict_after_learning(
    learning_service: LearningService, body: dict[str, Any], weight: float | NDArray[np.float64] = INDEPENDENT_HZ / RATE
) -> dict[str, Any]:
    """Return the prediction of QUERIES after learning only these rows, computed with lipcore alone."""
    arrays = [np.array(body[name], np.float64) for name in ("q", "dq", "ddq", "tau")]
    count = len(arrays[0])
    rows = Rows(np.arange(count) / RATE, *arrays, np.zeros(count, np.uint8), np.broadcast_to(weight, count).copy())
    model = OnlineModel.start(lipcore.load(learning_service.trained)).learn(rows).model()
    answer = model.predict(**{name: np.array(values) for name, values in QUERIES.items()})
    return {"tau": answer.tau.tolist(), "tau_std": answer.tau_std.tolist()}


def assert_learnt(
    learning_service: LearningService,
    learning_model: LearningModel,
    revision: int,
    body: dict[str, Any],
    weight: float | NDArray[np.float64] = INDEPENDENT_HZ / RATE,
) -> None:
    """Check that a revision predicts as after learning only these rows."""
    expected = predict_after_learning(learning_service, body, weight)
    assert max_difference(learning_model.wait_for_revision(revision), expected) < MAX_DIFFERENCE_NM
