"""Models and versions as the API shows them."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, Field, StringConstraints

from lipcore.vocabulary import JointType, TorqueConvention

ModelName = Annotated[str, StringConstraints(pattern=r"^[a-z0-9][a-z0-9._-]{0,63}$")]
"""Lower-case letters, digits, dots, underscores and hyphens: safe in URLs and never a path."""
VersionNumber = Annotated[int, Field(ge=1, lt=2**31)]
ALIAS = r"^[a-z][a-z0-9._-]{0,63}$"
AliasName = Annotated[str, StringConstraints(pattern=ALIAS)]
"""Lower-case letters, digits, dots, underscores and hyphens after a letter: never taken for a version's number."""


class Version(BaseModel):
    """An immutable trained version."""

    model: str
    version: int
    created_at: str
    job: str | None = Field(description="The job that made it; null for one that was imported or came with LIPServe")
    estimator: str
    joint_names: list[str]
    joint_types: list[JointType]
    torque_convention: TorqueConvention
    noise_std: list[float] = Field(description="Standard deviation of the measured torque, N·m")
    training_range: dict[str, dict[str, list[float]]] = Field(description="Where the samples lie that it stands on")
    options: dict[str, Any]
    fit: dict[str, Any] = Field(description="What the fit reported")
    compact: dict[str, Any] | None = Field(
        None,
        description="Size of the served posterior, and how far it deviates from the exact one: `mean_rms`, `mean_max`, "
        "`std_max` in standard deviations of the function, at `queries` motions; null for versions of model format 2",
    )
    calibration: dict[str, Any] = Field(
        description="`function_std_factor`: what `tau_std` was multiplied by so that intervals hold on unseen motion"
    )
    hyperparameters: dict[str, Any] | None = Field(
        None, description="Hyperparameters by name, mostly logarithms; null for versions of earlier releases"
    )
    warnings: list[str] = Field(
        [], description="What to be careful with: what the recording leaves open of a learnt arm, and how its fit ended"
    )
    lineage: dict[str, Any] = Field(
        description="Data sets with their hashes, when and with which `software` it was trained, and how well it fits "
        "them (`training_metrics`); of an imported version also where it comes from (`imported`)"
    )
    robot: dict[str, Any] | None = Field(None, description="The URDF of an estimator with rigid bodies, and its prior")
    parameters: dict[str, Any] | None = Field(
        None, description="Friction coefficients and, of rigid bodies, inertial parameters, with standard deviations"
    )


class VersionSummary(BaseModel):
    """A version in the list of its model."""

    version: int
    created_at: str
    estimator: str


class Model(BaseModel):
    """A named model. Queries are answered by the version that serves unless they name another."""

    name: str
    created_at: str
    latest_version: int = Field(description="The newest version")
    serving_version: int = Field(
        description="The version that answers where none is named: the newest, unless that is a refreshed one that has "
        "yet to prove better, or an earlier one was chosen"
    )
    aliases: dict[str, int] = Field(description="Names that were given to versions, `serving` aside")
    versions: list[VersionSummary]


class ModelPage(BaseModel):
    """One page of models, newest first."""

    items: list[Model]
    next_cursor: str | None
