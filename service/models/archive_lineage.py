"""The lineage of an imported version: type and range of each field that the service reads or shows."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from lipcore.files.entries import MAX_VALUE
from service.contract.holdout import HoldoutLineage, OutsideRange

Count = Annotated[int, Field(ge=0, lt=2**63)]
Size = Annotated[float, Field(ge=0, le=MAX_VALUE)]
"""A number that is not negative, such as a standard deviation or a duration."""
Share = Annotated[float, Field(ge=0, le=1)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Plain = bool | int | Finite


class Strict(BaseModel):
    """Model with values that already have the right type."""

    model_config = ConfigDict(extra="allow", strict=True)


class Figures(Strict):
    """Quality of predictions per joint, see `service.models.lineage.figures`."""

    samples: Count | None = None
    of: Count | None = None
    nmse: list[Annotated[float, Field(ge=0)] | None] = []
    rmse: list[Size | None] = []
    nlpd: list[Finite | None] = []
    coverage: list[Share | None] = []
    coverage_low: list[Share | None] = []
    coverage_high: list[Share | None] = []
    interval_width: list[Size | None] = []
    independent: list[Size | None] = []


class ServingErrors(BaseModel):
    """Errors of the version that served before, on the same rows."""

    model_config = ConfigDict(strict=True)

    version: Count
    rmse: list[Size]


class JudgedFigures(Figures):
    """Figures that a verdict needs."""

    torque_noise: list[Size] | None = None
    seconds: Size | None = None
    moving: Share | None = None
    torque_range: list[Size] | None = None
    torque_limit: list[Size | None] | None = None
    outside: OutsideRange | None = None
    repeats_training: Share | None = None
    serving: ServingErrors | None = None


class HeldOut(HoldoutLineage, JudgedFigures):
    """Quality of predictions on held-out rows."""


class ProcessFields(Strict):
    """Resources that a training used."""

    __pydantic_extra__: dict[str, Plain]

    seconds: Size | None = None
    peak_memory_mb: Size | None = None


class LineageDataset(BaseModel):
    """A data set in a lineage."""

    model_config = ConfigDict(strict=True)

    id: str = Field(max_length=40)
    name: str = Field("", max_length=1000)
    sha256: str = Field("", max_length=64)
    rows: Count = 0
    faults: list[Annotated[str, Field(max_length=2000)]] = Field([], max_length=100)


class Lineage(BaseModel):
    """Fields of a lineage that the service reads or shows; other fields are kept unread."""

    model_config = ConfigDict(strict=True)

    datasets: list[LineageDataset] = Field([], max_length=10_000)
    imported: list[dict[str, Any]] = Field([], max_length=1000)
    learnt: dict[str, Any] | None = None
    holdout: HeldOut | None = None
    judged: JudgedFigures | None = None
    training_metrics: Figures | None = None
    training_process: ProcessFields | None = None
    trained_at: str | None = Field(None, max_length=40)
    job: str | None = Field(None, max_length=100)
    software: dict[str, str | int] = Field({}, max_length=20)
