"""Upload of a recording: the file, and the query with its options."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, Field

from lipcore.data.signals import CUTOFF
from lipcore.preparation.recipe import Filtering, Form
from lipcore.vocabulary import TorqueConvention
from service.contract.media_types import MEDIA_TYPES, SUFFIXES
from service.foundation.fields import BINARY, NameForPeople, upload_body

Effort = Literal["measured", "commanded", "current"]
"""Meaning of a recording's effort: measured torque, gravity included; commanded torque on top of gravity compensation;
or motor current, A, converted by torque constants."""
MAX_TEXT_CHARS = 8000
"""Max characters of a list or a mapping."""

UPLOAD_BODY = upload_body(
    "A recording with at least positions, torques and times. Canonical columns are `t` (s), `q1..qn`, `dq1..`, "
    "`ddq1..`, `tau1..` and optionally `episode`, in SI units. Other names and units are recognised, or declared by "
    "`columns` and `units`. `dq` and `ddq` are derived if absent. NPZ has `q`, `dq`, `ddq`, `tau` (N, n), `t` or `dt`, "
    "`episode` and `joint_names`. Bags have messages of any type with numbers of each joint. A zip has the directory "
    "of a LeRobot data set or a rosbag2, or text tables that are joined side by side: positions.txt, velocities.txt "
    "and torques.txt may then lack column names.",
    {
        "text/csv": {"schema": {"type": "string"}, "example": "t,q1,dq1,ddq1,tau1\n0.0,0.1,0.0,0.2,1.5\n"},
        "application/x-ndjson": {
            "schema": {"type": "string"},
            "example": '{"t": 0.0, "q": [0.1], "dq": [0.0], "tau": [1.5]}\n',
        },
        **{kind: {"schema": BINARY} for kind in MEDIA_TYPES if kind not in ("text/csv", "application/x-ndjson")},
    },
    f"A file with a name that ends in {', '.join(SUFFIXES)}",
)


class UploadQuery(BaseModel):
    """Options for reading and preparing an upload. Lists and mappings are text, for URLs."""

    name: NameForPeople | None = Field(None, description="Display name; the file name by default")
    joint_names: str | None = Field(
        None, max_length=MAX_TEXT_CHARS, description="Names of joints 1..n, separated by commas"
    )
    robot: str | None = Field(
        None,
        max_length=200,
        description="Profile such as panda, or id of an uploaded URDF, for limits, joints and effort",
    )
    torque_convention: TorqueConvention | None = Field(
        None,
        description="Whether `tau` is the full joint torque or the torque on top of gravity compensation. By default "
        "it follows from the effort, else the full torque",
    )
    effort: Effort | None = Field(
        None,
        description="Meaning of the torque column: measured torque with gravity, commanded torque without gravity, or "
        "motor current in A (unknown torque constants are estimated from the masses of `robot`). By default from the "
        "robot's profile",
    )
    torque_constants: str | None = Field(
        None,
        max_length=MAX_TEXT_CHARS,
        description="Torque constants of joints 1..n for motor currents, N·m/A, separated by commas",
    )
    torque_factors: str | None = Field(
        None,
        max_length=MAX_TEXT_CHARS,
        description="Factors on the torques of joints 1..n, separated by commas: -1 for an inverted sign, or a gear "
        "ratio",
    )
    joints: str | None = Field(
        None,
        max_length=MAX_TEXT_CHARS,
        description="Joints to keep, in this order, separated by commas; all by default",
    )
    drop_joints: str | None = Field(
        None,
        max_length=MAX_TEXT_CHARS,
        description="Joints to leave out, separated by commas, such as grippers and locked joints",
    )
    columns: str | None = Field(
        None,
        max_length=MAX_TEXT_CHARS,
        description="Column names of the file as JSON: for `t`, `episode`, `q`, `dq`, `ddq` and `tau`, a pattern "
        'such as `{"q": "{joint}/position"}`, or a list of names. Detected by default',
    )
    units: str | None = Field(
        None,
        max_length=MAX_TEXT_CHARS,
        description='Units of columns as JSON, such as `{"q": "deg", "t": "ms"}`; by default as in the header, else SI',
    )
    topic: str | None = Field(
        None,
        max_length=200,
        description="Topic of a bag, HDF5 group, or sheet of a workbook, if several can be read. Topics separated by "
        "commas are merged by time",
    )
    delimiter: str | None = Field(
        None, min_length=1, max_length=1, description="Delimiter of a CSV; detected by default"
    )
    column_names: str | None = Field(
        None,
        max_length=MAX_TEXT_CHARS,
        description="Column names of text without a header, separated by commas; `q1..q7` stands for seven names",
    )
    dt: float | None = Field(
        None, gt=0, le=100, allow_inf_nan=False, description="Time from row to row of a file without times, s"
    )
    poses: bool = Field(
        False,
        description="Whether each row is a held pose, without times and velocities. Equal ones in a row are averaged",
    )
    cutoff: float = Field(CUTOFF, gt=0, le=1000, allow_inf_nan=False, description="Cut-off of the low-pass, Hz")
    filtering: Filtering = Field(
        "derived",
        description="When signals are low-passed: if velocity or acceleration is `derived`, `always`, or `never`",
    )
    form: Form = Field("acausal", description="`causal`: with the delay of a live stream; `acausal`: without delay")
    rate: float | None = Field(
        None, gt=0, le=1e6, allow_inf_nan=False, description="Rate of the prepared samples, Hz; as recorded by default"
    )
    gap: float = Field(
        1.5, gt=1, le=1e6, allow_inf_nan=False, description="Time step that splits a recording, in median steps"
    )
    trim: float | None = Field(
        None,
        ge=0,
        le=1e6,
        allow_inf_nan=False,
        description="Time to cut off at both ends of every part, s; by default the edges of the filter",
    )


class RereadQuery(UploadQuery):
    """Options for reading the file of a data set again."""

    fresh: bool = Field(False, description="Ignore the options of the upload")
