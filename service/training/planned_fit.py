"""The fits of a job: one that is judged on what was held out, then one of all rows."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import Any

from lipcore.data.samples import Samples
from lipcore.estimators.hyperparameters import Progress
from lipcore.estimators.options import FitOptions
from lipcore.estimators.task import Task
from lipcore.model.selection import MAX_NAME, shortened
from lipcore.model.torque_model import TorqueModel
from lipcore.model.warnings import REFIT_ERROR
from lipcore.training.conditioning import should_condition
from lipcore.training.refit import refit, widened
from lipcore.training.train import fit_model
from lipcore.vocabulary import JointType
from service.foundation.settings import Settings
from service.training.material import CANDIDATES, Material
from service.training.pulse import LAST_FIT, PACE, Pulse, Remaining
from service.training.summing import all_rows
from service.training.table import Table

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class PlannedFit:
    """A fit, and the pass over all of its rows that may follow it.

    table: the data sets' rows of that pass, each with what it counts; pass_rows: all rows of it, 0 without one.
    """

    material: Material
    joint_types: tuple[JointType, ...]
    options: FitOptions
    table: Table
    pass_rows: int

    @classmethod
    def of(cls, request: dict[str, Any], material: Material) -> PlannedFit:
        """Plan the fit of a job's material."""
        options = FitOptions(**request["options"])
        table = material.table.weighed(options.posterior_samples)
        # the version that serves has learnt all rows of a refresh, not only the few that a fit chooses
        every = request.get("refresh") is not None or should_condition(options, material.rows, table.independent_rows())
        if material.every is not None:  # the last fit sums all rows: judging takes no second pass as long as that
            table = table.sparse(PACE.fit_rows)
        pass_rows = len(table) + (0 if material.logged is None else len(material.logged[0])) if every else 0
        return cls(material, tuple(request["joint_types"]), options, table, pass_rows)

    def first(self, settings: Settings, estimator: str, last: PlannedFit | None, pulse: Pulse) -> TorqueModel:
        """Fit a model. last: the fit that is to follow, if any; raise what `fit_model` does."""
        material, count = self.material, len(self.material.samples)
        pulse.plan(PACE.fit_rows, self.pass_rows, 0 if last is None else PACE.last_fit_rows + last.pass_rows)
        if not self.pass_rows or material.rows <= CANDIDATES:  # else it is the pass that takes long
            searched, conditioned = self.options.hyperparameter_samples, self.options.posterior_samples
            pulse.remaining = Remaining(min(searched, count), min(conditioned, count))
        pulse.stage("hyperparameters")
        task = self._task(pulse.progress, pulse)
        return self._on_all_rows(settings, fit_model(task, estimator, material.geometries), pulse)

    def last(self, settings: Settings, judged: TorqueModel, held_out: Samples, pulse: Pulse) -> TorqueModel:
        """Fit the model that was judged to all rows. If that fails, return it as judged; its report then says so.

        held_out: what it was judged on, of which its intervals are to hold 95 %.
        """
        pulse.plan(PACE.last_fit_rows, self.pass_rows)
        pulse.stage(LAST_FIT)
        try:
            again = refit(widened(judged, held_out), self._task(pulse.last_fit, pulse))
            return self._on_all_rows(settings, again, pulse)
        except (ArithmeticError, ValueError) as error:
            logger.exception("the fit on all rows failed: the version is the model that was judged")
            why = shortened(f"{type(error).__name__}: {error}")[:MAX_NAME]
            return replace(judged, fit={**judged.fit, REFIT_ERROR: why})

    def _task(self, on_progress: Progress, pulse: Pulse) -> Task:
        material = self.material
        return Task(
            material.samples,
            self.joint_types,
            self.options,
            material.torque_convention,
            material.robot,
            material.stretches,
            on_progress,
            pulse.cancelled,
            material.sibling,
        )

    def _on_all_rows(self, settings: Settings, trained: TorqueModel, pulse: Pulse) -> TorqueModel:
        """A model that was fitted, after the pass over all rows, if there is one."""
        material = self.material
        corrupt = sum(each["rows"] for each in material.lineage.get("corrupt", ()))
        counts = {"samples_given": material.rows} | ({"samples_corrupt": corrupt} if corrupt else {})
        trained = replace(trained, fit={**trained.fit, **counts})
        if not self.pass_rows:
            return trained
        return all_rows(settings, trained, self.table, material.logged, self.options, pulse.cancelled, pulse.share)
