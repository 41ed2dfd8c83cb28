"""A stream of an arm with friction that remembers its motion, and what a service has to know after it."""

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import lipcore
from lipcore.data.samples import Array, Samples
from lipcore.kernels.drive.play import with_deflections
from lipcore.online.batch import Rows
from lipcore.online.learner import OnlineModel
from service.journal import log
from service.storage.database import Database
from tests.lipcore.remembering import remembering_model, remembering_samples

MODEL, STREAM, BATCH_ROWS, BATCHES, UNLEARNT = "remembering", "arm", 20, 10, 2
TOLERANCE_NM = 1e-8
_FIELDS = ("t", "q", "dq", "ddq", "tau")


@cache
def recorded() -> Samples:
    """Return the rows of the whole stream, with the deflections that lipcore computes at once."""
    return with_deflections(remembering_samples(seed=8, size=BATCH_ROWS * BATCHES), ["revolute"] * 2)


def save_model(folder: Path) -> Path:
    """Save the model in a folder."""
    lipcore.save(remembering_model(), folder)
    return folder


def stream_batch(number: int) -> dict[str, Any]:
    """Return a batch as a request."""
    rows = slice(number * BATCH_ROWS, (number + 1) * BATCH_ROWS)
    body = {name: getattr(recorded(), name)[rows].tolist() for name in _FIELDS}
    return {"stream_id": STREAM, "sequence": number, **body}


def query_along() -> dict[str, Any]:
    """Return a request for the torque along the second half of the motion, after a history of the first."""
    middle = len(recorded()) // 2
    query = {name: getattr(recorded(), name)[middle:].tolist() for name in ("t", "q", "dq", "ddq")}
    history = {name: getattr(recorded(), name)[:middle].tolist() for name in ("t", "q", "dq")}
    return {**query, "history": history, "trajectory": True}


def read_stream(database: Database) -> list[Rows]:
    """Return the logged rows of each batch, in order, those of unlearnt batches included."""
    with database.session() as session:
        events = log.events(session, MODEL, 0, 1000, void=True)
    batches = sorted((event for event in events if event.kind == "batch"), key=lambda event: event.sequence or 0)
    assert [event.sequence for event in batches] == list(range(BATCHES))
    return [log.decode(event.payload) for event in batches]


def assert_deflections_known(logged: Sequence[Rows]) -> None:
    """Check that the logged deflections are those of one motion without interruption."""
    found = Rows.concatenate(list(logged))
    assert found.deflections is not None
    np.testing.assert_allclose(found.q, recorded().q)
    np.testing.assert_allclose(found.deflections, recorded().deflections, atol=1e-9)


def predict_learnt(logged: Sequence[Rows], without: int | None) -> Array:
    """Return the torque of `query_along`, (N, n), by a model that learns the logged batches at once, but for one."""
    rows = Rows.concatenate([rows for number, rows in enumerate(logged) if number != without])
    model = OnlineModel.start(remembering_model()).learn(rows).model()
    return model.predict_along(recorded()).tau[len(recorded()) // 2 :]
