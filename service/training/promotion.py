"""Decide whether a trained version serves, by its held-out rows and before its last fit.

It serves if the verdict is usable, also if only inside the recorded range, unless paired differences show that it is
worse than the serving version. Both are compared as trained. A version that has since learnt the held-out rows is
compared by its judged fit; its lineage contains the scores. Of equally good versions 1 to 7 % stay candidates
(simulated: 5 to 60 s held out, errors correlated over 0.1 to 3 s).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from sqlalchemy.orm import Session

from lipcore.data.metrics import BlockScores, Difference
from lipcore.data.samples import Samples
from lipcore.estimators.base import RobotKind
from lipcore.files.manifest import ModelFormatError
from lipcore.model.torque_model import TorqueModel
from lipcore.model.verdict import OPTIONS, VerdictOptions
from service.contract.holdout import HoldoutLineage
from service.contract.models import Promotion
from service.contract.states import PromotionOption
from service.contract.verdict import Verdict
from service.models import aliases, registry, verdicts
from service.models.lineage import answer_of, learnt_from
from service.models.texts import describe_verdict
from service.storage.database import Database, VersionRow
from service.storage.files import Files
from service.training import texts


def judge(
    database: Database,
    files: Files,
    model: str,
    trained: TorqueModel,
    held_out: Samples | None,
    lineage: dict[str, Any],
    option: PromotionOption,
) -> Promotion:
    """Judge a version before it is added.

    `held_out` are the rows to judge by, None if there are none. `lineage` is that of the version, with its figures on
    these rows; the errors of the serving version on them are added.
    """
    with database.session() as session:
        number = registry.serving_version(session, model)
        serving = None if number is None else session.get_one(VersionRow, (model, number))
    compared = None
    if held_out is not None and serving is not None:
        options = registry.verdict_options(database, [model])[model]
        compared = _against(files, serving, trained, held_out, lineage, options)
        if compared.rmse is not None:
            lineage["holdout"]["serving"] = {"version": serving.version, "rmse": compared.rmse}
    verdict = verdict_of(database, model, trained, lineage)
    if not verdict.serves:
        return Promotion.of(False, describe_verdict(verdict.label, verdict.reason), number, option)
    reason = verdict.reason if compared is None else f"{verdict.reason} {compared.reason}"
    return Promotion.of(compared is None or compared.serves, reason, number, option)


def verdict_of(database: Database, model: str, trained: TorqueModel, lineage: dict[str, Any]) -> Verdict:
    """Return the verdict on a fit before it is added as a version. lineage: that of the version."""
    options = registry.verdict_options(database, [model]).get(model, OPTIONS)
    about = {"joint_names": trained.joint_names, "joint_types": trained.joint_types, "lineage": lineage}
    return verdicts.of_version(about, options)


def settle(session: Session, model: str, judged: Promotion, option: PromotionOption) -> Promotion:
    """Return the decision at the moment when the version is added.

    The version is a candidate if the serving version has changed since it was judged.
    """
    serving = registry.serving_version(session, model)
    if serving in (None, judged.serving) or not judged.answers or option == "always":
        return judged
    reason = texts.describe_changed_serving(serving)
    return Promotion(answers=False, serving=serving, reason=reason)


def wait(session: Session, model: str, version: int) -> None:
    """Point the alias `candidate` to a version that was just added, if the model may have another alias."""
    known = aliases.names(session, model)
    if registry.CANDIDATE in known or len(known) < registry.MAX_ALIASES:
        aliases.point(session, model, registry.CANDIDATE, version)


@dataclass(frozen=True)
class ServingComparison:
    """Whether a version may replace the serving version, and why; rmse: of the serving version on the held-out rows."""

    serves: bool
    reason: str
    rmse: list[float] | None = None


def _against(
    files: Files,
    serving: VersionRow,
    trained: TorqueModel,
    held_out: Samples,
    lineage: dict[str, Any],
    options: VerdictOptions,
) -> ServingComparison:
    """Compare a version with the serving version, or return why they are not compared."""
    name, manifest = f"version {serving.version}", serving.manifest
    kind = RobotKind(trained.joint_names, trained.joint_types, trained.torque_convention)
    if RobotKind.of_manifest(manifest).difference(kind) is not None:
        return ServingComparison(False, texts.describe_other_robot(name))
    scores = BlockScores.of(held_out, answer_of(trained, held_out))
    try:
        before, rmse = _scores(files, serving, held_out, lineage["holdout"])
    except ModelFormatError:
        return ServingComparison(True, texts.describe_unreadable(name))
    if before is None or not np.array_equal(before.rows, scores.rows):
        return ServingComparison(True, texts.describe_learnt_held_out(name))
    if len(scores.rows) < 2:
        return ServingComparison(True, texts.describe_too_short(name), rmse)
    if foreign := _find_foreign_joints(serving, held_out, rmse, lineage["holdout"]["rmse"], options):
        return ServingComparison(False, texts.describe_foreign_recording(name, foreign), rmse)
    serves, reason = _compare(scores.difference_from(before), name)
    return ServingComparison(serves, reason, rmse)


def _find_foreign_joints(
    serving: VersionRow, held_out: Samples, rmse: list[float] | None, own: list[float], options: VerdictOptions
) -> list[str]:
    """Return the joints on which a usable serving version is no better than the mean torque, unlike the new version.

    The recording is then of another robot, or with another payload or torque unit. rmse, own: errors of both.
    """
    if rmse is None or not verdicts.of_version(serving.manifest, options).serves:
        return []
    limit = np.sqrt(OPTIONS.max_error) * held_out.tau.std(axis=0)
    foreign = (np.array(rmse) >= limit) & (np.array(own) < limit)
    return [name for name, is_foreign in zip(held_out.joint_names, foreign, strict=True) if is_foreign]


def _scores(
    files: Files, serving: VersionRow, held_out: Samples, holdout: dict[str, Any]
) -> tuple[BlockScores | None, list[float] | None]:
    """Return the scores and errors (n,) of a version on the held-out rows, None if there are none.

    If the version has learnt these rows, return those of its judged fit on the same rows. Raise ModelFormatError if the
    version cannot be read.
    """
    earlier = serving.manifest["lineage"]
    if _is_new_to(earlier, holdout):
        answer = answer_of(files.load_version(serving.folder, serving.checksums), held_out)
        return BlockScores.of(held_out, answer), np.sqrt(np.mean((held_out.tau - answer.mean) ** 2, axis=0)).tolist()
    before = earlier.get("holdout")
    if before is None or _rows_of(before) != _rows_of(holdout):
        return None, None
    blocks = HoldoutLineage.model_validate(before).blocks
    if blocks is None:
        return None, None
    nmse = [np.nan if each is None else each for each in blocks.nmse]
    return BlockScores(np.array(blocks.rows, np.int64), np.array([blocks.nlpd, nmse]).T), before["rmse"]


def _compare(total: Difference, name: str) -> tuple[bool, str]:
    """Return whether a version may replace the serving version, and why: unless it predicts worse.

    That is, its log predictive density is lower, or its errors are larger and its density is not higher.
    """
    (density, nmse), (clear, larger) = total.mean.tolist(), total.significant.tolist()
    half, half_nmse = total.half_width.tolist()
    if clear and density > 0:
        return False, texts.describe_density("worse", name, density, half)
    if larger and nmse > 0 and not clear:
        return False, texts.describe_larger_errors(name, nmse, half_nmse)
    return True, texts.describe_density("better" if clear else "no worse", name, density, half)


def _is_new_to(earlier: dict[str, Any], holdout: dict[str, Any]) -> bool:
    """Return whether a version with an earlier lineage has learnt none of the rows that are held out now."""
    learnt, before = learnt_from(earlier), earlier.get("holdout")
    kept = [] if before is None or before.get("learnt") else _rows_of(before)
    sets = zip(holdout["datasets"], _rows_of(holdout), strict=True)
    return all(learnt.isdisjoint((each["id"], each["sha256"])) or rows in kept for each, rows in sets)


def _rows_of(holdout: dict[str, Any]) -> list[dict[str, Any]]:
    """Return what identifies the held-out rows of each data set, in order."""
    split = {name: value for name, value in holdout["split"].items() if name != "only"}
    fields = ("sha256", "rows", "guarded", "whole", "stretches")
    return [{"split": split, **{field: each.get(field) for field in fields}} for each in holdout["datasets"]]
