"""Decide whether a refreshed version replaces the serving version: if it is better, and its verdict is usable.

Both predict the newest logged rows, which neither has learnt: the refreshed version is first fitted without them, and
the serving version is restored to its state before them. The score is the negative log predictive density of a row's
torques, summed over the joints, with the noise that each version states. It rewards small errors and honest uncertainty
alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sqlalchemy.orm import Session

from lipcore.data import metrics
from lipcore.data.metrics import MIN_BLOCKS, BlockScores
from lipcore.data.samples import Samples
from lipcore.model.torque_model import TorqueModel
from service.contract.models import Promotion
from service.contract.observations import LearningOptions
from service.foundation.fields import finite
from service.journal.alarms import raise_alarm
from service.journal.floor import error_floor_of
from service.journal.restore import restore
from service.models import registry
from service.models.lineage import answer_of
from service.models.texts import describe_verdict
from service.storage import audit
from service.storage.database import Database, LearningRow, VersionRow
from service.storage.files import Files
from service.training import texts
from service.training.judging import stream_figures
from service.training.promotion import verdict_of
from service.training.refresh_data import ComparisonRows


@dataclass(frozen=True)
class RefreshComparison:
    """Comparison of a refreshed version with the version that it refreshes; `evidence` has its figures as JSON."""

    better: bool
    reason: str
    evidence: dict[str, Any]


def judge(
    database: Database,
    files: Files,
    serving: VersionRow,
    trained: TorqueModel,
    rows: ComparisonRows | None,
    lineage: dict[str, Any],
) -> Promotion:
    """Decide whether the judged fit of a refresh may serve: if it is better than the serving version, and usable.

    Add the comparison, and the figures behind the verdict, to the lineage of its version.
    """
    compared = compare(database, files, serving, trained, rows)
    lineage["refresh"] = {**lineage["refresh"], "compared": compared.reason, "evidence": compared.evidence}
    if rows is not None and compared.evidence:
        lineage["judged"] = stream_figures(trained, rows.samples)
    verdict = verdict_of(database, serving.model, trained, lineage)
    if compared.better and not verdict.serves:
        return Promotion.of(False, describe_verdict(verdict.label, verdict.reason), serving.version)
    return Promotion.of(compared.better, compared.reason, serving.version)


def compare(
    database: Database, files: Files, serving: VersionRow, trained: TorqueModel, rows: ComparisonRows | None
) -> RefreshComparison:
    """Compare the judged fit of a refresh with the version that it refreshes, on rows that neither has learnt."""
    name = f"version {serving.version}"
    if rows is None or len(metrics.blocks(rows.samples)) < MIN_BLOCKS:
        return RefreshComparison(False, texts.describe_too_few_logged(name), {})
    samples, key = rows.samples, (serving.model, serving.version)
    base = files.load_version(serving.folder, serving.checksums)
    known = restore(database, files, *key, base, rows.after)
    before = known.online.model(error_floor_of(database, *key, rows.after, base.n_joints))
    answers = {"serving": answer_of(before, samples), "candidate": answer_of(trained, samples)}
    scores = {which: BlockScores.of(samples, answer) for which, answer in answers.items()}
    found = scores["candidate"].difference_from(scores["serving"])
    evidence = {
        "rows": len(samples),
        "blocks": len(scores["serving"].rows),
        "gain": -float(found.mean[0]),
        "standard_error": float(found.standard_error[0]),
        "figures": {which: _figures(samples, answer) for which, answer in answers.items()},
    }
    better = bool(found.significant[0] and found.mean[0] < 0)
    reason = texts.describe_newest_rows(better, name, found.mean[0], found.half_width[0])
    return RefreshComparison(better, reason, evidence)


def promote(session: Session, model: str, version: int, judged: Promotion, evidence: dict[str, Any]) -> str:
    """Let a refreshed version that was just added serve, if it is better and its owner allows that.

    Raise an alarm with the outcome and return the outcome in words.
    """
    row = session.get(LearningRow, model)
    promotes = (LearningOptions() if row is None else LearningOptions(**row.options)).auto_promote
    serving = registry.serving_version(session, model)
    promoted = judged.answers and promotes and serving == judged.serving
    if promoted:
        registry.serve(session, model, version)
    outcome = texts.describe_refresh(version, judged.reason, judged.answers, promoted)
    verdict = "promote" if judged.answers else "dismiss"
    if not promoted:
        after = {"verdict": verdict, "serving": serving}
        audit.note(session, model, "candidate dismissed", version, after=after)
    named = {"serving": judged.serving, "candidate": version, "verdict": verdict, "promoted": promoted}
    raise_alarm(session, model, "promotion", f"Version {version} {outcome}", {**named, **evidence})
    return outcome


def _figures(samples: Samples, answer: metrics.TorqueDistribution) -> dict[str, list[float | None]]:
    """Return nMSE and coverage per joint; null if the torque is constant."""
    found = metrics.evaluate(samples.tau, *answer)
    return {"nmse": finite(found.nmse), "coverage": finite(found.coverage)}
