"""How a model learns, as its owner sets it."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class LearningOptions(BaseModel):
    """How a model learns from observations."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    enabled: bool = Field(True, description="Whether observations are taken at all")
    forgetting_s: float | None = Field(
        None,
        ge=1,
        allow_inf_nan=False,
        description="Age in s at which a sample counts 1/e of a new one, in event time; null: nothing is forgotten",
    )
    on_change: Literal["hold", "adapt", "learn"] = Field(
        "hold",
        description="What follows a detected change of the robot. `hold`: nothing is learnt until its owner decides; "
        "`adapt`: a new regime begins; `learn`: learning goes on as before",
    )
    torque_limits: list[Positive] | None = Field(
        None, description="Largest |tau| of each joint's actuator in N·m, to tell saturated samples; null: not known"
    )
    contact_threshold: Positive = Field(
        8.0, description="Predictive standard deviations, noise included, beyond which a torque is taken for a contact"
    )
    auto_refresh: bool = Field(True, description="Train a new version by itself where motion leaves what is known")
    auto_promote: bool = Field(True, description="Let such a version answer by itself once it predicts better")
