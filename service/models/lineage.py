"""The lineage of a version: software, data sets and quality of fit."""

from __future__ import annotations

import platform
import subprocess
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from lipcore.data import metrics
from lipcore.data.coverage import coverage_interval
from lipcore.data.metrics import TorqueDistribution
from lipcore.data.motion import spaced_rows
from lipcore.data.samples import Samples
from lipcore.files.manifest import FORMAT_VERSION
from lipcore.model.torque_model import TorqueModel
from service import __version__
from service.foundation.fields import finite
from service.models.evaluation import coverage_fields
from service.models.verdicts import find_faults
from service.storage.database import DatasetRow

MAX_METRIC_SAMPLES = 500
"""Maximum samples that training metrics are computed on."""


def software() -> dict[str, str | int]:
    """Return the software versions for a version's lineage; cheap after the first call in a process.

    `model_format` is the format of model files that this release writes. `git_commit` is present only in a checkout,
    with the suffix `-dirty` if files were changed since.
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


def describe_datasets(rows: Sequence[DatasetRow]) -> list[dict[str, Any]]:
    """Return the training data sets as a lineage lists them, with their preparation if it is recorded."""
    prepared = ("source", "recipe", "steps")
    return [
        {
            "id": row.id,
            "name": row.name,
            "sha256": row.sha256,
            "rows": row.rows,
            **{name: row.report[name] for name in prepared if row.report.get(name) is not None},
            **({"faults": faults} if (faults := find_faults(row)) else {}),
        }
        for row in rows
    ]


def learnt_from(lineage: dict[str, Any]) -> frozenset[str]:
    """Return the ids and hashes of the data sets that a version has learnt from, wholly or in part."""
    holdout = lineage.get("holdout") or {}
    left_out = set() if holdout.get("learnt") else {each["id"] for each in holdout.get("datasets", []) if each["whole"]}
    learnt = [each for each in lineage.get("datasets", []) if each["id"] not in left_out]
    return frozenset(each[field] for each in learnt for field in ("id", "sha256") if field in each)


def figures(model: TorqueModel, samples: Samples, most: int, of: int) -> dict[str, Any]:
    """Return how well a model predicts samples, thinned evenly to at most `most`.

    `of` is the number of rows that the samples represent. Per joint: nmse (None if the torque is constant), rmse in
    N·m, nlpd in nats, coverage of the 95 % interval and the interval's width in N·m. The confidence interval of the
    coverage counts `independent` errors.
    """
    used = samples.rows(spaced_rows(len(samples), most))
    answer = answer_of(model, used)
    compared = metrics.evaluate(used.tau, *answer)
    per_joint = {name: finite(getattr(compared, name)) for name in ("nmse", "rmse", "coverage", "nlpd")}
    width = {"interval_width": compared.width.tolist()}
    return {"samples": len(used), "of": of, **per_joint, **width, **coverage_fields(coverage_interval(used, answer))}


def answer_of(model: TorqueModel, samples: Samples) -> TorqueDistribution:
    """Return a model's predictions at samples, without its compiled form.

    Compilation pays off only in a process that serves.
    """
    answer = model.posterior.predict(samples.motion())
    return TorqueDistribution(answer.mean, answer.std, model.noise_std, model.scale)


@cache
def git_commit(checkout: Path) -> str | None:
    """Return the git commit of a checkout; None if the folder is not a checkout or git fails."""
    if not (checkout / ".git").exists():  # an installed package may lie inside another project's checkout
        return None
    command = ["git", "--no-optional-locks", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:  # on a slow disk, training continues without the commit
        answer = subprocess.run(  # noqa: S603 - a fixed command
            command, cwd=checkout, capture_output=True, text=True, timeout=5.0, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return answer.stdout.strip() or None
