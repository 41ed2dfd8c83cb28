"""The fits of a job: one that is judged on held-out rows, then one on all rows."""

from __future__ import annotations

import logging
from dataclasses import asdict, dataclass, replace
from typing import Any

from lipcore.data.samples import Samples
from lipcore.estimators.hyperparameters import Progress
from lipcore.estimators.options import FitOptions
from lipcore.estimators.task import Task
from lipcore.model.selection import MAX_NAME, shortened
from lipcore.model.torque_model import TorqueModel
from lipcore.model.warnings import REFIT_ERROR
from lipcore.training.conditioning import should_condition
from lipcore.training.learning_curve import LearningCurve, learning_curve
from lipcore.training.refit import refit, widen_intervals
from lipcore.training.train import fit_model
from lipcore.vocabulary import JointType
from service.foundation.settings import Settings
from service.training.material import MAX_CANDIDATE_ROWS, TrainingData
from service.training.pulse import LAST_FIT, PACE, Heartbeat, RemainingTime
from service.training.summing import all_rows
from service.training.table import Table

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class PlannedFit:
    """A fit, and the pass over all rows if one follows."""

    data: TrainingData
    joint_types: tuple[JointType, ...]
    options: FitOptions
    table: Table
    """Rows of the data sets for that pass, with weights."""
    pass_rows: int
    """Number of rows in the pass; 0 if there is none."""

    @classmethod
    def of(cls, request: dict[str, Any], data: TrainingData) -> PlannedFit:
        """Plan the fit of a job's training data."""
        options = FitOptions(**request["options"])
        table = data.table.weighed(options.posterior_samples)
        # a refresh must learn all rows as the serving version has, not only those that a fit selects
        every = request.get("refresh") is not None or should_condition(options, data.rows, table.independent_rows())
        if data.every is not None:  # the last fit sums all rows: a second pass as long is not worth it
            table = table.sparse(PACE.fit_rows)
        pass_rows = len(table) + (0 if data.logged is None else len(data.logged[0])) if every else 0
        return cls(data, tuple(request["joint_types"]), options, table, pass_rows)

    def first(self, settings: Settings, estimator: str, last: PlannedFit | None, heartbeat: Heartbeat) -> TorqueModel:
        """Fit a model; `last` is the fit that follows, if any. Raise as `fit_model` does."""
        data, count = self.data, len(self.data.samples)
        heartbeat.plan(PACE.fit_rows, self.pass_rows, 0 if last is None else PACE.last_fit_rows + last.pass_rows)
        if not self.pass_rows or data.rows <= MAX_CANDIDATE_ROWS:  # else the pass takes longest
            searched, conditioned = self.options.hyperparameter_samples, self.options.posterior_samples
            heartbeat.remaining = RemainingTime(min(searched, count), min(conditioned, count))
        heartbeat.stage("hyperparameters")
        task = self._task(heartbeat.progress, heartbeat)
        return self._on_all_rows(settings, fit_model(task, estimator, data.geometries), heartbeat)

    def last(self, settings: Settings, judged: TorqueModel, held_out: Samples, heartbeat: Heartbeat) -> TorqueModel:
        """Refit the judged model to all rows. If that fails, return the judged model with the error in its report.

        `held_out` are the rows on which the model was judged. Its intervals are widened until they cover 95 % of them.
        """
        heartbeat.plan(PACE.last_fit_rows, self.pass_rows)
        heartbeat.stage(LAST_FIT)
        try:
            again = refit(widen_intervals(judged, held_out), self._task(heartbeat.last_fit, heartbeat))
            return self._on_all_rows(settings, again, heartbeat)
        except (ArithmeticError, ValueError) as error:
            logger.exception("the final fit, on all rows, failed; the version keeps the judged fit")
            return replace(judged, fit={**judged.fit, REFIT_ERROR: _reason(error)})

    def learning_curve(self, judged: TorqueModel, held_out: Samples, heartbeat: Heartbeat) -> dict[str, Any] | None:
        """Return the learning curve of the judged model for its lineage; None if there are too few samples.

        If it fails, it has no points, and its text tells the error.
        """
        try:
            curve = learning_curve(judged, self._task(None, heartbeat), held_out)
        except (ArithmeticError, ValueError) as error:
            logger.exception("the learning curve failed")
            curve = LearningCurve((), False, False, f"The learning curve could not be computed: {_reason(error)}")
        return None if curve is None else asdict(curve)

    def _task(self, on_progress: Progress | None, heartbeat: Heartbeat) -> Task:
        data = self.data
        return Task(
            data.samples,
            self.joint_types,
            self.options,
            data.torque_convention,
            data.robot,
            data.stretches,
            on_progress,
            heartbeat.cancelled,
            data.sibling,
        )

    def _on_all_rows(self, settings: Settings, trained: TorqueModel, heartbeat: Heartbeat) -> TorqueModel:
        """Return a fitted model after the pass over all rows, if there is one."""
        data = self.data
        corrupt = sum(each["rows"] for each in data.lineage.get("corrupt", ()))
        counts = {"samples_given": data.rows} | ({"samples_corrupt": corrupt} if corrupt else {})
        trained = replace(trained, fit={**trained.fit, **counts})
        if not self.pass_rows:
            return trained
        return all_rows(settings, trained, self.table, data.logged, self.options, heartbeat.cancelled, heartbeat.share)


def _reason(error: Exception) -> str:
    """Return the error as a short line."""
    return shortened(f"{type(error).__name__}: {error}")[:MAX_NAME]
