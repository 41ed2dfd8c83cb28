"""Data sets as the API shows them."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, Field

from lipcore.model import TorqueConvention


class DatasetReport(BaseModel):
    """What was found in the recording and what was done to it."""

    rows_uploaded: int
    rows: int = Field(description="Samples kept")
    episodes: int = Field(description="Contiguous recordings")
    rate_hz: float | None = Field(description="Usual sampling rate; null where no times were given")
    gaps: int = Field(description="Gaps in time, where the recording was split")
    derived: list[str] = Field(description="Quantities that were not given and had to be derived")
    preparation: list[str] = Field(description="Every step that changed the data")
    ranges: dict[str, dict[str, list[float]]] = Field(description="Smallest and largest value per joint")
    torque_noise_estimate: list[float] = Field(description="White noise on the torque per joint, N·m")
    warnings: list[str]


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


UPLOAD_BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "description": "Columns `t` (s), `q1..qn`, `dq1..`, `ddq1..`, `tau1..`, optional `episode`, in SI units; "
        "`dq` and `ddq` may be absent and are then derived. NPZ holds `q`, `dq`, `ddq`, `tau` (N, n), `t` or "
        "`dt`, `episode`, `joint_names`.",
        "content": {
            "text/csv": {"schema": {"type": "string"}, "example": "t,q1,dq1,ddq1,tau1\n0.0,0.1,0.0,0.2,1.5\n"},
            "application/x-npz": {"schema": {"type": "string", "format": "binary"}},
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "required": ["file"],
                    "properties": {
                        "file": {"type": "string", "format": "binary", "description": "A .csv or .npz file"}
                    },
                }
            },
        },
    }
}
