"""What made a version: the software, so that it can be made again, and how well it fits what it was made from."""

from __future__ import annotations

import platform
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import fields
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from lipcore.data import metrics
from lipcore.data.coverage import coverage_interval
from lipcore.data.metrics import Answer
from lipcore.data.samples import Samples
from lipcore.files.manifest import FORMAT_VERSION
from lipcore.model.acceptance import HeldOutFigures
from lipcore.model.torque_model import TorqueModel
from service import __version__
from service.foundation.fields import finite
from service.models.evaluation import known
from service.storage.database import DatasetRow

MOST_SAMPLES = 500
"""Samples that training metrics are computed on."""


def software() -> dict[str, str | int]:
    """Versions of what computes here, for a version's lineage: cheap after the first call of a process.

    model_format: of the files that this release writes; git_commit: only in a checkout, with the suffix `-dirty` where
    it was changed since.
    """
    versions: dict[str, str | int] = {
        "lipserve": __version__,
        "model_format": FORMAT_VERSION,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scipy": str(scipy.__version__),
    }
    commit = git_commit(Path(__file__).resolve().parents[2])
    return versions if commit is None else {**versions, "git_commit": commit}


def named(rows: Sequence[DatasetRow]) -> list[dict[str, Any]]:
    """Data sets that were trained on as a lineage names them, with how they were prepared where that is known."""
    prepared = ("source", "recipe", "steps")
    return [
        {
            "id": row.id,
            "name": row.name,
            "sha256": row.sha256,
            "rows": row.rows,
            **{name: row.report[name] for name in prepared if row.report.get(name) is not None},
        }
        for row in rows
    ]


def learnt_from(lineage: dict[str, Any]) -> frozenset[str]:
    """Ids and hashes of the data sets that a version has learnt from, be it from part of them."""
    holdout = lineage.get("holdout") or {}
    left_out = set() if holdout.get("learnt") else {each["id"] for each in holdout.get("datasets", []) if each["whole"]}
    learnt = [each for each in lineage.get("datasets", []) if each["id"] not in left_out]
    return frozenset(each[field] for each in learnt for field in ("id", "sha256") if field in each)


def figures(model: TorqueModel, samples: Samples, most: int, of: int) -> dict[str, Any]:
    """How well a model answers for samples, thinned evenly to at most so many of them; `of`: how many they stand for.
    Per joint: nmse (None where the torque did not vary), rmse in N·m, coverage of the 95 % interval with the confidence
    interval from so many `independent` errors, the width of the former in N·m, and nlpd in nats."""
    count = min(len(samples), most)
    used = samples.rows(np.linspace(0, len(samples) - 1, count).round().astype(np.int64))
    answer = answer_of(model, used)
    compared = metrics.evaluate(used.tau, *answer)
    per_joint = {name: finite(getattr(compared, name)) for name in ("nmse", "rmse", "coverage", "nlpd")}
    width = {"interval_width": compared.width.tolist()}
    return {"samples": len(used), "of": of, **per_joint, **width, **known(coverage_interval(used, answer))}


def held_out_figures(joint_names: tuple[str, ...], holdout: Mapping[str, Any]) -> HeldOutFigures:
    """Figures of a fit on what was held out, as a lineage has them; raise KeyError, TypeError or ValueError where there
    are none, or others."""
    found = {
        each.name: np.array(holdout[each.name], np.float64)
        for each in fields(HeldOutFigures)
        if each.name != "joint_names"
    }
    if any(each.shape != (len(joint_names),) for each in found.values()):
        raise ValueError("figures are not those of the joints")
    return HeldOutFigures(joint_names, **found)


def answer_of(model: TorqueModel, samples: Samples) -> Answer:
    """What a model predicts of samples, not by its compiled form: a process that trains and never serves would wait for
    that."""
    answer = model.posterior.predict(samples.motion())
    return Answer(answer.mean, answer.std, model.noise_std, model.scale)


@cache
def git_commit(checkout: Path) -> str | None:
    """The commit that a folder is a checkout of; None where it is none, or git cannot tell."""
    if not (checkout / ".git").exists():  # an installed package may lie within somebody else's checkout
        return None
    command = ["git", "--no-optional-locks", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:  # a checkout on a slow disk loses its commit, not its training
        answer = subprocess.run(  # noqa: S603 - a fixed command
            command, cwd=checkout, capture_output=True, text=True, timeout=5.0, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return answer.stdout.strip() or None
