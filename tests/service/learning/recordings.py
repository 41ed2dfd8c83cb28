"""Recordings of a double pendulum as a robot would stream them, and what a model ought to learn from them."""

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
from tests.service.learning.lessons import QUERIES, RATE, Pupil, School

NAMES = ("t", "q", "dq", "ddq", "tau")


def recording(samples: int = 400, seed: int = 7, rate: float = RATE) -> Samples:
    """A recording whose velocities and accelerations belong to its times."""
    return stream(samples=samples, seed=seed, rate=rate)


def part(recorded: Samples, first: int, last: int, without: tuple[str, ...] = ()) -> dict[str, Any]:
    """Rows first … last - 1 as a request has them."""
    return {name: getattr(recorded, name)[first:last].tolist() for name in NAMES if name not in without}


def batch(sequence: int, body: dict[str, Any], stream_id: str = "arm", **changes: Any) -> dict[str, Any]:
    """A request; a change that is None leaves its field out."""
    whole = {"stream_id": stream_id, "sequence": sequence, **body, **changes}
    return {name: value for name, value in whole.items() if value is not None}


def send(pupil: Pupil, sequence: int, body: dict[str, Any], stream_id: str = "arm", **changes: Any) -> dict[str, Any]:
    """Send a batch; return its acknowledgement."""
    return pupil.post("observations", batch(sequence, body, stream_id, **changes))


def logged(school: School, pupil: Pupil) -> list[Rows]:
    """The rows of all batches of a model, in the order of the log."""
    with school.service.database.session() as session:
        found = log.events(session, pupil.model, 0, 10_000, void=True)
    return [log.decode(event.payload) for event in found if event.kind == "batch"]


def codes(school: School, pupil: Pupil) -> list[str]:
    """What became of each row of a model, in the order of the log."""
    return [CODES[code] for rows in logged(school, pupil) for code in rows.code.tolist()]


def learnt_from(
    school: School, body: dict[str, Any], weight: float | NDArray[np.float64] = INDEPENDENT_HZ / RATE
) -> dict[str, Any]:
    """What a model that has learnt these rows, and nothing else, answers to QUERIES: by lipcore alone."""
    arrays = [np.array(body[name], np.float64) for name in ("q", "dq", "ddq", "tau")]
    count = len(arrays[0])
    rows = Rows(np.arange(count) / RATE, *arrays, np.zeros(count, np.uint8), np.broadcast_to(weight, count).copy())
    model = OnlineModel.start(lipcore.load(school.trained)).learn(rows).model()
    answer = model.predict(**{name: np.array(values) for name, values in QUERIES.items()})
    return {"tau": answer.tau.tolist(), "tau_std": answer.tau_std.tolist()}
