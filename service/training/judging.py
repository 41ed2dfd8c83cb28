"""What the rows held out say of a fit that has not learnt them, for the lineage of its version."""

from __future__ import annotations

from typing import Any

from lipcore.data.metrics import BlockScores
from lipcore.estimators.noise import white
from lipcore.model.torque_model import TorqueModel
from service.contract.models import Evaluation
from service.foundation.fields import finite
from service.models.evaluation import MAX_EVALUATION_SAMPLES, evaluation
from service.models.lineage import answer_of, figures
from service.training import repeating
from service.training.material import Material
from service.training.table import TablePart


def judged_figures(model: TorqueModel, material: Material) -> dict[str, Any]:
    """Return the figures of a fit on what was held out, as a lineage keeps them.

    If a last fit follows, these are also what can be computed no more after it: fields of a `HoldoutLineage`.
    """
    table, most = material.held_out, MAX_EVALUATION_SAMPLES
    assert table is not None  # something was held out
    samples = table.thinned(most)
    repeats = repeating.look(material.table.parts, samples, model.joint_types)
    judged = {"judged_rows": material.rows, "torque_noise": white(material.samples, material.stretches).tolist()}
    found = {**judged, **figures(model, samples, most, len(table)), **repeats}
    if material.every is None:
        return found
    scores = BlockScores.of(samples, answer_of(model, samples))
    nlpd, nmse = (finite(sums) for sums in scores.sums.T)
    blocks = {"rows": scores.rows.tolist(), "nlpd": nlpd, "nmse": nmse}
    evaluations = {part.row.id: _evaluation(model, material, part, most) for part in table.parts}
    return {**found, "blocks": blocks, "evaluations": evaluations}


def _evaluation(model: TorqueModel, material: Material, part: TablePart, most: int) -> dict[str, Any]:
    """What an evaluation of the fit on the rows held out of one data set answers."""
    _, samples = part.motion(most)
    found = evaluation(samples, answer_of(model, samples))
    repeats = repeating.look(material.table.parts, samples, model.joint_types)
    return Evaluation(samples=len(part), **found, **repeats).model_dump(mode="json")
