"""Home with a double pendulum whose log tests write, and its expected predictions from one sum over all rows."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from sqlalchemy import select
from sqlalchemy.orm import Session

import lipcore
from lipcore import FitOptions, Samples, TorqueModel
from lipcore.online import transfer
from lipcore.online.batch import Rows
from lipcore.online.learner import OnlineModel
from lipcore.online.record import Record
from lipcore.posterior.compact import CompactPosterior
from lipcore.posterior.statistics import collect, merge
from service.foundation.settings import Settings
from service.journal import log, snapshots, undo
from service.journal.restore import RestoredState, advance, restore
from service.learning.learner import publication
from service.learning.learner.publication import Publication
from service.models import registry
from service.models.loaded import LoadedModels
from service.storage.database import Database, EventRow
from service.storage.disk import Disk
from service.storage.files import Files
from service.storage.storage import Storage
from tests.service.data import QUICK, stream
from tests.service.learning import batches

ARM = "arm"
ROWS = 10
"""Rows of a batch."""
BEGIN = 1000.0
"""Event time of the first batch, s."""
QUERIES = np.random.default_rng(5).uniform(-1.5, 1.5, (3, 40, 2))
Predictions: TypeAlias = tuple[np.ndarray, np.ndarray]
"""Torques and standard deviations."""


@cache
def trained_model() -> TorqueModel:
    """Return a model of a double pendulum; always the same object."""
    return lipcore.train(stream(), ["revolute", "revolute"], "lip-chain", FitOptions(**QUICK))


@cache
def make_recording() -> Samples:
    """Return a later recording of the robot, with other motions and more friction."""
    return stream(seed=21, samples=3000, viscous=2.0)


def make_rows(number: int, size: int = ROWS) -> Rows:
    """Return the rows of the batch with this sequence, at 100 Hz of event time."""
    part = slice(number * size, (number + 1) * size)
    time = BEGIN + np.arange(part.start, part.stop) / 100
    values = (getattr(make_recording(), name)[part] for name in ("q", "dq", "ddq", "tau"))
    return Rows(time, *values, np.zeros(size, np.uint8))


@dataclass(frozen=True)
class Arm:
    """Model in a home, with methods that write its log."""

    database: Database
    files: Files
    settings: Settings
    model: str = ARM

    @classmethod
    def open(cls, home: Path, **settings: Any) -> Arm:
        """Create a home with version 1 of the model."""
        chosen = Settings(home=home, publish_every_s=0.02, **settings)
        arm = cls(Database.of(chosen), Files.of(chosen), chosen)
        arm.publish()
        return arm

    @property
    def storage(self) -> Storage:
        """Return the storage of the home."""
        return Storage(self.settings, self.database, self.files, Disk(self.settings))

    def publish(self, model: str | None = None, **arguments: Any) -> int:
        """Publish the trained model as a version, by default of this model."""
        model = model or self.model
        folder = f"mv_{model}_{len(list(self.files.versions.iterdir()))}"
        with self.files.new_version(folder) as target:
            manifest = lipcore.save(trained_model(), target)
        with self.database.transaction() as session:
            return registry.publish(session, model, folder, manifest, None, **arguments)

    @property
    def base(self) -> TorqueModel:
        """Return version 1 as trained, as the service loads it."""
        return lipcore.load(self.files.version_folder(registry.find(self.database, self.model, 1).folder))

    def follow_log(self, known: RestoredState) -> RestoredState:
        """Advance a state to the end of the log."""
        while (following := advance(self.database, self.files, known)) is not known:
            known = following
        return known

    def store_snapshot(self, at_most: int | None = None) -> int:
        """Store the state after an event, by default the last one; return the number of that event."""
        known = self.restore_state(at_most=at_most)
        payload, most = transfer.dump(known.online), self.settings.max_snapshots
        state = 1, known.number, known.seen
        assert snapshots.save(self.database, self.files, self.model, *state, payload, most=most) is not None
        return known.number

    def log_batch(self, number: int, size: int = ROWS, model: str | None = None, **fields: Any) -> int:
        """Log the batch with this sequence, by default predicted without error; return the event number."""
        new_rows = fields.pop("rows", None) or make_rows(number, size)
        defaults: dict[str, Any] = {
            "stream_id": "s",
            "offset": 0.0,
            "received": float(new_rows.time[-1]),
            "rows": new_rows,
            "report": {"accepted": 0, "rejected": {}},
            "record": None,
        }
        batch = batches.make_batch(number, **defaults | fields)
        return batches.append_batches(self.database, batch, model=model or self.model)[0]

    def log_batches(self, *numbers: int) -> None:
        for number in numbers:
            self.log_batch(number)

    def log_event(self, kind: str, rows: Rows | None = None, **detail: Any) -> int:
        """Log an event that is not a batch; return its number."""
        with self.database.transaction() as session:
            return log.append(session, self.model, kind, detail, self._now(session), rows).number

    def unlearn(self, number: int) -> int:
        """Unlearn the batch with this event number; return the number of the unlearn event."""
        with self.database.transaction() as session:
            return undo.unlearn(session, self.model, self.find(number), self._now(session)).number

    def rollback(self, to: int) -> int:
        """Roll back to an event; return the number of the rollback event."""
        with self.database.transaction() as session:
            return undo.rollback(session, self.model, to, self._now(session)).number

    def _now(self, session: Session) -> float:
        """Return the time at which the last event was received."""
        latest = select(EventRow.received).where(EventRow.model == self.model).order_by(EventRow.number.desc())
        return session.scalar(latest.limit(1)) or BEGIN

    def find(self, number: int) -> EventRow:
        """Return the event with this number."""
        with self.database.session() as session:
            return log.events(session, self.model, number - 1, 1, void=True)[0]

    def restore_state(self, **arguments: Any) -> Any:
        """Return the state that version 1 has learnt."""
        return restore(self.database, self.files, self.model, 1, self.base, **arguments)


def expected_predictions(numbers: Iterable[int] = (), parts: Iterable[Rows] = ()) -> Predictions:
    """Return torques and standard deviations at QUERIES after the training and these batches, computed by one sum."""
    model = trained_model()
    posterior, known = model.posterior, model.posterior.statistics
    learnt = [*(make_rows(number) for number in numbers), *parts]
    if learnt:
        rows = Rows.concatenate(learnt).learnt
        motion = rows.motion()
        residual = rows.tau - posterior.kernel.mean(motion)
        known = merge(known, collect(posterior.basis, posterior.row_variance(motion), motion, residual))
    noise, misfit = posterior.noise_variance, posterior.misfit
    built = CompactPosterior.build(posterior.kernel, posterior.basis, known, noise, posterior.std_factor, misfit)
    return predict_queries(replace(model, posterior=built))


def predict_queries(model: TorqueModel) -> Predictions:
    """Return torques and standard deviations at QUERIES."""
    answer = model.predict(*QUERIES)
    return answer.tau, answer.tau_std


def assert_predictions(found: TorqueModel | OnlineModel, expected: Predictions) -> None:
    """Check the predictions of a model against torques and standard deviations."""
    model = found.model() if isinstance(found, OnlineModel) else found
    for values, expected_values in zip(predict_queries(model), expected, strict=True):
        np.testing.assert_allclose(values, expected_values, rtol=1e-8, atol=1e-8)


def predictions_differ(one: Predictions, other: Predictions) -> bool:
    """Return whether any torques differ by more than 1e-6 N·m."""
    return bool(np.abs(one[0] - other[0]).max() > 1e-6)


def residual_record(error: float, count: int = 100) -> dict[str, Any]:
    """Return the prequential record, as logged, of rows predicted with errors of this size and alternating sign."""
    tau = np.where(np.arange(count)[:, None] % 2, 1.0, -1.0) * np.array([[error, 0.0]])
    return Record.of(tau, np.zeros((count, 2)), np.full((count, 2), 1e-3), trained_model().noise_std).to_json()


def adopt_revision(loaded: LoadedModels, message: Publication) -> bool:
    """Adopt a published revision for predictions, as the service does."""
    return loaded.revise(message.model, message.version, message.revision, publication.read(message.path))
