"""What a job holds out of its data sets, as it is asked for and as a version's lineage keeps it."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from lipcore.data.splits import Kind, Split

_DEFAULTS = Split()


class Holdout(BaseModel):
    """Part of the data that is not learnt from, so that the version can be evaluated on it: never rows at random."""

    model_config = ConfigDict(extra="forbid", strict=True, json_schema_extra={"examples": [{"share": 0.3}]})

    kind: Kind = Field(
        _DEFAULTS.kind,
        description="Of each data set: whole `episodes`, chosen by the seed; its `last` part; or some of many equal "
        "`blocks`, chosen by the seed. Of several data sets of one episode each, `episodes` holds out whole data sets",
    )
    share: float = Field(
        _DEFAULTS.share, gt=0, lt=1, description="Of the samples, as nearly as whole episodes or blocks allow"
    )
    blocks: int = Field(_DEFAULTS.blocks, ge=2, le=1000, description="Equal stretches that `blocks` chooses from")
    guard_s: float | None = Field(
        None,
        ge=0,
        le=3600,
        description="Samples as near as that to the other side are left out of both, s; by default one period of the "
        "low-pass that the data set was prepared with. Of a data set without times 25 samples are",
    )
    seed: int = Field(_DEFAULTS.seed, ge=0, lt=2**31, description="Of the choice")


class HeldOutSet(BaseModel):
    """What was held out of one data set: enough to find the same samples again."""

    model_config = ConfigDict(strict=True)

    id: str = Field(max_length=40)
    sha256: str = Field(max_length=64)
    whole: bool = Field(description="Whether nothing of it was learnt")
    guard: float = Field(ge=0, description="See `guard_unit`")
    guard_unit: Literal["s", "rows"]
    rows: int = Field(ge=1, lt=2**63, description="Samples held out")
    guarded: int = Field(ge=0, lt=2**63, description="Samples left out of both sides")


class HoldoutLineage(BaseModel):
    """What a version's lineage says of it; the figures that go with it are shown and not read."""

    model_config = ConfigDict(strict=True)

    split: Holdout
    datasets: list[HeldOutSet] = Field(min_length=1, max_length=10_000)
    rows: int = Field(ge=1, lt=2**63)
    guarded: int = Field(ge=0, lt=2**63)
