"""Judge a fit on held-out rows, which it has not learnt, for the lineage of its version."""

from __future__ import annotations

from typing import Any

import numpy as np

from lipcore.data.metrics import BlockScores
from lipcore.data.samples import Samples
from lipcore.estimators.noise import white
from lipcore.model.torque_model import TorqueModel
from service.contract.holdout import Evaluation
from service.foundation.fields import finite
from service.models.evaluation import MAX_EVALUATION_SAMPLES, evaluation, range_figures
from service.models.lineage import answer_of, figures
from service.models.verdicts import torque_limits
from service.training import repeating
from service.training.material import TrainingData
from service.training.table import TablePart


def judged_figures(model: TorqueModel, data: TrainingData) -> dict[str, Any]:
    """Return the figures of a fit on the held-out rows, as a lineage contains them.

    If a last fit follows, include what cannot be computed after it: fields of a `HoldoutLineage`.
    """
    table, most = data.held_out, MAX_EVALUATION_SAMPLES
    assert table is not None  # something was held out
    samples = table.thinned(most)
    repeats = repeating.find_repetition(data.table.parts, samples, model.joint_types)
    answer = answer_of(model, samples)
    judged = {
        "judged_rows": data.rows,
        # of thinned samples, `white` contains motion
        "torque_noise": np.minimum(white(data.samples, data.stretches), white(samples)).tolist(),
        "torque_limit": torque_limits([part.row for part in table.parts]),
        **range_figures(samples, answer, model.training_range),
    }
    found = {**judged, **figures(model, samples, most, len(table)), **repeats}
    if data.every is None:
        return found
    scores = BlockScores.of(samples, answer)
    nlpd, nmse = (finite(sums) for sums in scores.sums.T)
    blocks = {"rows": scores.rows.tolist(), "nlpd": nlpd, "nmse": nmse}
    evaluations = {part.row.id: _evaluation(model, data, part, most) for part in table.parts}
    return {**found, "blocks": blocks, "evaluations": evaluations}


def stream_figures(model: TorqueModel, samples: Samples) -> dict[str, Any]:
    """Return the figures of a fit on rows of streams that it has not learnt, as the `judged` of a lineage."""
    answer = answer_of(model, samples)
    return {
        "torque_noise": np.minimum(white(samples), model.noise_std).tolist(),  # `white` of thinned rows contains motion
        **range_figures(samples, answer, model.training_range),
        **figures(model, samples, len(samples), len(samples)),
    }


def _evaluation(model: TorqueModel, data: TrainingData, part: TablePart, most: int) -> dict[str, Any]:
    """Return the evaluation of the fit on the held-out rows of one data set."""
    _, samples = part.motion(most)
    found = evaluation(samples, answer_of(model, samples), model.training_range)
    repeats = repeating.find_repetition(data.table.parts, samples, model.joint_types)
    return Evaluation(samples=len(part), **found, **repeats).model_dump(mode="json")
