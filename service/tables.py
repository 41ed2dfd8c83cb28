"""Answers as tables for the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from rich.table import Table

from service.inference.schema import EvaluateResponse, Nested, PredictResponse


def prediction_tables(answer: PredictResponse) -> list[Table]:
    """Tables of the answer to one query: joints, then components that are matrices, then those that are numbers."""
    columns = {"tau N·m": _texts(answer.tau), "tau_std": _texts(answer.tau_std), "noise_std": _texts(answer.noise_std)}
    matrices, numbers = [], Table("", "mean", "std")
    for name, values in (answer.components or {}).items():
        dimensions = np.ndim(values.mean)
        if dimensions == 0:
            numbers.add_row(name, *_texts(values.mean), *_texts(values.std))
        elif dimensions == 1:
            columns[name] = _pairs(values.mean, values.std)
        else:
            cells = np.reshape(_pairs(values.mean, values.std), np.shape(values.mean))
            matrices.append(_by_joint(Table(name, *answer.joint_names), answer.joint_names, cells.tolist()))
    rows = [list(row) for row in zip(*columns.values(), strict=True)]
    joints = _by_joint(
        Table("joint", *columns, title=f"{answer.model} version {answer.version}"), answer.joint_names, rows
    )
    return [joints, *matrices, *([numbers] if numbers.row_count else [])]


def evaluation_table(result: EvaluateResponse) -> Table:
    """Figures of an evaluation, joint by joint."""
    what = "held-out samples" if result.part == "held_out" else "samples"
    unseen = "" if not result.in_training else ", which it was trained on"
    title = f"{result.model} version {result.version} on {result.samples_used} {what} of {result.dataset}{unseen}"
    figures: dict[str, Sequence[float | None]] = {
        "nmse": result.nmse,
        "rmse": result.rmse,
        "coverage": result.coverage,
        "nlpd": result.nlpd,
    }
    return figures_table(title, result.joint_names, figures)


def figures_table(title: str, joint_names: Sequence[str], figures: Mapping[str, Sequence[float | None]]) -> Table:
    """nmse, rmse, coverage and nlpd per joint, as an evaluation or a version's lineage tells them."""
    table = Table("joint", "nMSE", "RMSE N·m", "coverage of 95%", "NLPD nats", title=title)
    columns = [figures[name] for name in ("nmse", "rmse", "coverage", "nlpd")]
    for joint, nmse, rmse, coverage, nlpd in zip(joint_names, *columns, strict=True):
        table.add_row(joint, _figure(nmse, ".2e"), _figure(rmse, ".4f"), _figure(coverage, ".1%"), _figure(nlpd, ".3f"))
    return table


def _figure(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def _by_joint(table: Table, joint_names: list[str], rows: list[list[str]]) -> Table:
    for joint, row in zip(joint_names, rows, strict=True):
        table.add_row(joint, *row)
    return table


def _texts(values: Nested) -> list[str]:
    return [f"{value:.4f}" for value in np.ravel(values)]


def _pairs(means: Nested, stds: Nested) -> list[str]:
    return [f"{mean} ± {std}" for mean, std in zip(_texts(means), _texts(stds), strict=True)]
