"""Answers as tables for the terminal."""

from __future__ import annotations

import numpy as np
from rich.table import Table

from service.inference.schema import Nested, PredictResponse


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


def _by_joint(table: Table, joint_names: list[str], rows: list[list[str]]) -> Table:
    for joint, row in zip(joint_names, rows, strict=True):
        table.add_row(joint, *row)
    return table


def _texts(values: Nested) -> list[str]:
    return [f"{value:.4f}" for value in np.ravel(values)]


def _pairs(means: Nested, stds: Nested) -> list[str]:
    return [f"{mean} ± {std}" for mean, std in zip(_texts(means), _texts(stds), strict=True)]
