"""What a client sends to upload a recording: the file, and in the query how it is to be read."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, Field

from lipcore.data.signals import CUTOFF
from lipcore.preparation.recipe import Filtering, Form
from lipcore.vocabulary import TorqueConvention
from service.contract.media_types import MEDIA_TYPES, SUFFIXES
from service.foundation.fields import BINARY, NameForPeople, upload_body

Effort = Literal["measured", "commanded", "current"]
"""What the effort of a recording is: measured torque, gravity included; commanded torque, what is added to gravity
compensation; motor current, A, that torque constants turn into torque."""
MOST_TEXT = 8000
"""Characters of a list or a mapping."""

UPLOAD_BODY = upload_body(
    "A recording with at least positions, torques and times. Canonical columns are `t` (s), `q1..qn`, `dq1..`, "
    "`ddq1..`, `tau1..`, optional `episode`, in SI units; other names and units are recognised or declared by "
    "`columns` and `units`. `dq` and `ddq` may be absent and are then derived. NPZ holds `q`, `dq`, `ddq`, `tau` "
    "(N, n), `t` or `dt`, `episode`, `joint_names`; bags hold `sensor_msgs/JointState` or the states of a Franka; a "
    "zip is the directory of a LeRobot data set or of a rosbag2, or holds tables of text that are joined side by side: "
    "positions.txt, velocities.txt, torques.txt may then lack column names.",
    {
        "text/csv": {"schema": {"type": "string"}, "example": "t,q1,dq1,ddq1,tau1\n0.0,0.1,0.0,0.2,1.5\n"},
        "application/x-ndjson": {
            "schema": {"type": "string"},
            "example": '{"t": 0.0, "q": [0.1], "dq": [0.0], "tau": [1.5]}\n',
        },
        **{kind: {"schema": BINARY} for kind in MEDIA_TYPES if kind not in ("text/csv", "application/x-ndjson")},
    },
    f"A file whose name ends in {', '.join(SUFFIXES)}",
)


class UploadQuery(BaseModel):
    """How an upload is to be read and prepared; lists and mappings as text, as a URL has them."""

    name: NameForPeople | None = Field(None, description="A name for people; the file's by default")
    joint_names: str | None = Field(None, max_length=MOST_TEXT, description="Names of joints 1..n, separated by commas")
    robot: str | None = Field(
        None,
        max_length=200,
        description="A profile such as panda, or the id of an uploaded URDF: its limits, joints, effort",
    )
    torque_convention: TorqueConvention | None = Field(
        None,
        description="Whether `tau` is the whole joint torque or what is added to gravity; by default what the "
        "effort of the robot means, else the whole",
    )
    effort: Effort | None = Field(
        None,
        description="What the column of torque holds: measured torque, gravity included; commanded torque without "
        "gravity; or motor current, A, which needs torque constants. By default what the robot's profile says",
    )
    torque_constants: str | None = Field(
        None, max_length=MOST_TEXT, description="N·m/A of joints 1..n, separated by commas, for motor currents"
    )
    torque_factors: str | None = Field(
        None,
        max_length=MOST_TEXT,
        description="By which the torques of joints 1..n are multiplied, separated by commas: -1 where the sign is "
        "opposite, or a gear's ratio",
    )
    joints: str | None = Field(None, max_length=MOST_TEXT, description="Joints to keep, in this order; all by default")
    drop_joints: str | None = Field(
        None, max_length=MOST_TEXT, description="Joints to leave out: grippers, those that are locked"
    )
    columns: str | None = Field(
        None,
        max_length=MOST_TEXT,
        description="What the file calls its columns, as JSON: for `t`, `episode`, `q`, `dq`, `ddq`, `tau` a "
        'pattern such as `{"q": "{joint}/position"}`, or a list of names. Found out where not given',
    )
    units: str | None = Field(
        None,
        max_length=MOST_TEXT,
        description='Units of columns as JSON, such as `{"q": "deg", "t": "ms"}`; SI, or as the header says',
    )
    topic: str | None = Field(None, max_length=200, description="Topic of a bag, where several could be read")
    delimiter: str | None = Field(None, min_length=1, max_length=1, description="Of a CSV; found out where not given")
    column_names: str | None = Field(
        None,
        max_length=MOST_TEXT,
        description="Names of the columns of text that has none, separated by commas; `q1..q7` stands for seven",
    )
    dt: float | None = Field(
        None, gt=0, le=100, allow_inf_nan=False, description="s from row to row, of a file without times"
    )
    cutoff: float = Field(CUTOFF, gt=0, le=1000, allow_inf_nan=False, description="Of the low-pass, Hz")
    filtering: Filtering = Field(
        "derived",
        description="When signals are low-passed: where velocity or acceleration is `derived`, always, or never",
    )
    form: Form = Field(
        "acausal", description="`causal` prepares as a live stream could be, late; `acausal` without delay"
    )
    rate: float | None = Field(
        None, gt=0, le=1e6, allow_inf_nan=False, description="Of the samples that come out, Hz; as recorded by default"
    )
    gap: float = Field(
        1.5, gt=1, le=1e6, allow_inf_nan=False, description="A step of time that splits a recording, in usual steps"
    )
    trim: float | None = Field(
        None,
        ge=0,
        le=1e6,
        allow_inf_nan=False,
        description="Cut off at both ends of every part, s; what the filter spoils by default",
    )
