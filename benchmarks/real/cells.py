"""Results of cells, one JSON file each, so that a run can be resumed."""

from __future__ import annotations

import hashlib
import os
import subprocess
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict

from benchmarks.real.rivals import Forecast, Intervals
from benchmarks.real.splits import Split
from benchmarks.workload import BenchError
from lipcore.data.metrics import LEVEL, evaluate, quantile

Knowledge = Literal["nothing", "URDF"]
"""What a method knows of the robot besides the samples and the joint types."""
PRODUCT = "LIPServe"
"""Method: the service with default options."""
BASE_FRICTION = "LIPServe, base friction"
"""Method: the same, with no more than viscous and Coulomb friction and an offset; computed without the service."""
OWN = PRODUCT, BASE_FRICTION
"""Methods of LIPServe."""
SOURCES = ("lipcore", "service", "clients/python/lipserve")
"""Folders of code on which results of OWN depend."""


class Cell(BaseModel):
    """One method on one split of one recording."""

    model_config = ConfigDict(frozen=True)

    recording: str
    split: str
    knowledge: Knowledge
    method: str

    def __str__(self) -> str:
        return f"{self.recording}/{self.split}/{self.knowledge}/{self.method}"


class Result(BaseModel):
    """Figures of a cell; lists have a value for each joint.

    Attributes:
        cell: the cell.
        revision: revision of LIPServe; None for another method.
        train_s: duration of the training samples, s.
        train_rows: rows of the training samples.
        test_rows: rows of the test.
        nmse: mean squared error / variance of the measured torque.
        nmse_mean: nMSE of the training samples' mean.
        coverage: share of measurements inside the 95 % interval.
        width: mean half width of that interval / (1.96 × RMSE).
        seconds: time of training, for other methods with prediction, s.
        estimator: the estimator that LIPServe chose.
        intervals: number of parameters with intervals, and of infinite ones; None without intervals of parameters.
    """

    model_config = ConfigDict(ser_json_inf_nan="constants")

    cell: Cell
    revision: str | None = None
    train_s: float
    train_rows: int
    test_rows: int
    nmse: list[float]
    nmse_mean: list[float]
    coverage: list[float]
    width: list[float]
    seconds: float
    estimator: str = ""
    intervals: Intervals | None = None

    @property
    def error(self) -> float:
        """Mean nMSE over the joints."""
        return float(np.mean(self.nmse))

    @property
    def of_mean(self) -> float:
        """Mean nMSE over the joints / mean nMSE of the training samples' mean."""
        return self.error / float(np.mean(self.nmse_mean))

    @property
    def worst(self) -> float:
        """Largest nMSE of a joint / nMSE of the training samples' mean."""
        return float(np.max(np.divide(self.nmse, self.nmse_mean)))


def evaluate_forecast(cell: Cell, split: Split, forecast: Forecast, seconds: float, estimator: str = "") -> Result:
    """Compare a forecast with the measured torque of a split's test."""
    tau = split.test.tau
    figures = evaluate(tau, forecast.mean, forecast.std, np.zeros(split.test.n_joints))
    constant = np.mean(np.square(tau - split.train.tau.mean(axis=0)), axis=0) / tau.var(axis=0)
    return Result(
        cell=cell,
        train_s=split.train_s,
        train_rows=len(split.train),
        test_rows=len(split.test),
        nmse=figures.nmse.tolist(),
        nmse_mean=constant.tolist(),
        coverage=figures.coverage.tolist(),
        width=(figures.width / (2 * quantile(LEVEL) * figures.rmse)).tolist(),
        seconds=seconds,
        estimator=estimator,
        intervals=forecast.intervals,
    )


class Cache:
    """Results in a folder; results of OWN belong to a revision, others are kept until they are deleted."""

    def __init__(self, folder: Path, revision: str) -> None:
        self.folder, self.revision = folder, revision

    def add(self, result: Result) -> None:
        """Store a result atomically."""
        if result.cell.method in OWN:
            result = result.model_copy(update={"revision": self.revision})
        path = self._path(result.cell)
        path.parent.mkdir(parents=True, exist_ok=True)
        draft = path.with_suffix(f".{os.getpid()}.draft")
        draft.write_text(result.model_dump_json(indent=1) + "\n")
        draft.replace(path)

    def find(self, cell: Cell) -> Result | None:
        """Return the result of a cell, None if it was not computed."""
        path = self._path(cell)
        return Result.model_validate_json(path.read_bytes()) if path.is_file() else None

    def _path(self, cell: Cell) -> Path:
        revision = f"@{self.revision}" if cell.method in OWN else ""
        return (
            self.folder
            / cell.recording
            / cell.split
            / f"{cell.method}-{cell.knowledge}{revision}.json".replace(" ", "-")
        )


def product_revision() -> str:
    """Return the last commit that changed SOURCES, with a hash of what is not committed; raise BenchError."""
    root = Path(__file__).resolve().parents[2]

    def git(*arguments: str) -> bytes:
        command = ["git", "-C", str(root), *arguments, "--", *SOURCES]
        try:
            return subprocess.run(command, check=True, capture_output=True).stdout  # noqa: S603 - our own
        except (OSError, subprocess.CalledProcessError) as error:
            raise BenchError(f"The revision could not be read from git: {error}. Set it with --revision.") from None

    commit, changes = git("log", "-1", "--format=%h", "--abbrev=8").decode().strip(), git("diff", "HEAD")
    return f"{commit}+{hashlib.sha256(changes).hexdigest()[:8]}" if changes else commit
