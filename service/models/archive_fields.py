"""What the manifest of an archive may say beyond what the model is made of: each field by type and range.

`lipcore` reads none of this, the service shows it. What an export writes passes; of names that this release does not
know only numbers and truth values do.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from lipcore.files.checks import LARGEST, LARGEST_SQUARE, MAX_NAME
from service.contract.models import HoldoutLineage

Count = Annotated[int, Field(ge=0, lt=2**63)]
Size = Annotated[float, Field(ge=0, le=LARGEST)]
"""A deviation, a duration or anything else that is not below zero."""
Share = Annotated[float, Field(ge=0, le=1)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Plain = bool | int | Finite


class Strict(BaseModel):
    """Values are of their types already."""

    model_config = ConfigDict(extra="allow", strict=True)


class FitFields(Strict):
    """What a fit did: see `lipcore.estimators.hyperparameters.FitReport` and `lipcore.arm.learning`."""

    __pydantic_extra__: dict[str, Plain]

    objective: Finite | None = None
    iterations: Count | None = None
    evaluations: Count | None = None
    rejected_steps: Count | None = None
    converged: bool | None = None
    start: Count | None = None
    samples_given: Count | None = None
    samples_hyperparameters: Count | None = None
    samples_posterior: Count | None = None
    samples_corrupt: Count | None = None
    corrupt: str | None = Field(
        None, max_length=300, pattern=r"^\d+ by [a-z]+(, \d+ by [a-z]+)*; the first are rows [\d, ]+, counted from 0$"
    )
    refit_error: str | None = Field(None, max_length=MAX_NAME)
    independent_samples: Size | None = None
    row_correlation: Size | None = None
    motion_dimensions: Size | None = None
    jitter: Annotated[float, Field(ge=0, le=LARGEST_SQUARE)] | None = None
    seconds: Size | None = None
    device: str | None = Field(None, pattern=r"^[a-z]{1,10}(:\d{1,3})?$")
    geometry: str | None = Field(None, pattern=r"^[a-z]{1,20}$")
    friction_terms: Count | None = None
    stribeck_nats: Finite | None = None
    search_objective: Finite | None = None
    search_starts: Count | None = None
    search_hops: Count | None = None
    search_optima: Count | None = None
    search_times_best: Count | None = None
    search_explained: bool | None = None
    search_ended: str | None = Field(None, pattern=r"^[a-z]{1,20}$")
    search_seconds: Size | None = None
    search_alternatives: Count | None = None
    search_next_nats: Finite | None = None


class CompactFields(Strict):
    """How near a compact posterior comes to the exact one: see `lipcore.posterior.compression`."""

    __pydantic_extra__: dict[str, Plain]

    inducing_outputs: Count | None = None
    inducing_samples: Count | None = None
    weights: Count | None = None
    tolerance: Size | None = None
    tolerance_reached: bool | None = None
    mean_rms: Size | None = None
    mean_max: Size | None = None
    std_max: Size | None = None
    queries: Count | None = None
    data_samples: Count | None = None


class CandidateFields(Strict):
    """How one estimator of several did."""

    standard_error: Size | None = None
    coverage: list[Share | None] | None = None


class SelectionFields(Strict):
    """How an estimator was chosen."""

    table: list[CandidateFields] = []


class Figures(Strict):
    """How well a version answered for samples, per joint: see `service.models.lineage.figures`."""

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


class HeldOut(HoldoutLineage, Figures):
    """The same of what was held out."""


class ProcessFields(Strict):
    """What a training took."""

    __pydantic_extra__: dict[str, Plain]

    seconds: Size | None = None
    peak_memory_mb: Size | None = None


class LineageDataset(BaseModel):
    """A data set as a lineage names it."""

    model_config = ConfigDict(strict=True)

    id: str = Field(max_length=40)
    name: str = Field("", max_length=1000)
    sha256: str = Field("", max_length=64)
    rows: Count = 0


class Lineage(BaseModel):
    """What the service reads or shows of a lineage; whatever else there is goes with it unread."""

    model_config = ConfigDict(strict=True)

    datasets: list[LineageDataset] = Field([], max_length=10_000)
    imported: list[dict[str, Any]] = Field([], max_length=1000)
    learnt: dict[str, Any] | None = None
    holdout: HeldOut | None = None
    training_metrics: Figures | None = None
    training_process: ProcessFields | None = None
    trained_at: str | None = Field(None, max_length=40)
    job: str | None = Field(None, max_length=100)
    software: dict[str, str | int] = Field({}, max_length=20)


FIELDS: Mapping[str, type[BaseModel]] = {
    "fit": FitFields,
    "compact": CompactFields,
    "selection": SelectionFields,
    "lineage": Lineage,
}
"""What checks each entry of a manifest."""
