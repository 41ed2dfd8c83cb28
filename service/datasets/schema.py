"""Data sets as the API shows them."""

from __future__ import annotations

from pydantic import BaseModel, Field

from lipcore.vocabulary import TorqueConvention
from service.datasets.report.schema import DatasetReport


class Dataset(BaseModel):
    """An immutable, validated table of samples."""

    id: str
    name: str
    created_at: str
    sha256: str = Field(description="Hash of the stored samples")
    joint_names: list[str]
    torque_convention: TorqueConvention
    report: DatasetReport


class DatasetPage(BaseModel):
    """One page of data sets, newest first."""

    items: list[Dataset]
    next_cursor: str | None
