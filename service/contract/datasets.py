"""Data sets and their reports as the API shows them."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, Field

from lipcore.vocabulary import JointType, TorqueConvention
from service.contract import verdict

Verdict = Literal["well", "poorly", "not determined"]
"""How well the data determine a friction coefficient; `FrictionOptions` has the thresholds."""

Share = float

MAX_PREVIEW_STARTS = 2000
"""Max episode starts in a preview."""


class Gap(BaseModel):
    """A gap in time within a recording."""

    t: float = Field(description="Time of the last sample before the gap, s")
    seconds: float = Field(description="Duration of the gap, s")


class Timing(BaseModel):
    """Sampling times of the recording. Jitter is a share of the median time step."""

    rate_hz: float | None = Field(description="Median sampling rate of the upload, Hz; null if it has no times")
    duration_s: float | None = Field(description="Total duration without gaps, s")
    jitter_p50: Share | None = Field(description="Median deviation of a time step from the median step")
    jitter_p99: Share | None = Field(description="99 % quantile of that deviation")
    jitter_max: Share | None = Field(description="Largest deviation of a time step that is not a gap")
    gaps: list[Gap] = Field(description="The longest gaps, at most 20, in order of time")
    repeated_stamps: int = Field(description="Rows dropped because their time stamp repeats an earlier one")
    missing_rows: int = Field(description="Rows dropped because a value is missing")


class JointSaturation(BaseModel):
    """Signs that a joint's torque was saturated. Shares are of its samples."""

    joint: str
    at_largest: Share = Field(description="Share of samples at the largest or the smallest torque")
    flat: Share = Field(description="Share of samples that stay there for at least five samples while the joint moves")
    at_limit: Share | None = Field(
        description="Share of samples at or above 99 % of the torque limit; null if it is unknown"
    )


class JointLimits(BaseModel):
    """A joint compared with the robot's limits. Values are null if the limit is unknown."""

    joint: str
    range_used: Share | None = Field(description="Largest less smallest position, as a share of the joint's range")
    speed_used: Share | None = Field(description="Largest speed divided by the speed limit")
    torque_limit: float | None = Field(None, description="Rated torque of the actuator, N·m")
    torque_used: Share | None = Field(description="Largest torque divided by the torque limit")
    beyond_range: Share | None = Field(description="Share of samples beyond the position limits")
    beyond_speed: Share | None = Field(description="Share of samples beyond the speed limit")
    beyond_torque: Share | None = Field(description="Share of samples beyond the torque limit")


class Lag(BaseModel):
    """Time lag of the torque behind the motion; negative if the torque is ahead."""

    joint: str | None = Field(description="Joint; null for all joints combined")
    seconds: float | None = Field(None, description="Lag, s; null if the data do not determine it")
    std_s: float | None = Field(
        None, description="Standard deviation of the lag, s, from leaving out one eighth of the data at a time"
    )
    cost: Share | None = Field(None, description="Share of the torque's variance that becomes error because of the lag")
    reason: str | None = Field(None, description="Why the lag is unknown; null if it is known")
    improves: list[str] = Field(
        [],
        description="Joints with a clearly better prediction of torque on held-out parts if the lag is corrected. "
        "Empty unless the lag differs from 0",
    )


class JointNoise(BaseModel):
    """White noise of the signals as recorded; null if there are too few samples."""

    joint: str
    torque: float | None = Field(description="Standard deviation of the torque noise, N·m; also null if `smoothed`")
    torque_share: Share | None = Field(description="Torque noise divided by the standard deviation of the torque")
    velocity: float | None = Field(
        description="Standard deviation of the velocity noise, rad/s; also null if not recorded"
    )
    velocity_share: Share | None = Field(description="Velocity noise divided by the standard deviation of the velocity")
    smoothed: bool = Field(
        False, description="The torque was low-passed or simulated, so its noise cannot be estimated"
    )


class Weight(BaseModel):
    """A friction coefficient of a joint, and how well these data determine it."""

    value: float | None = Field(None, description="Estimate, N·m·s/rad or N·m; null unless rigid bodies are fitted too")
    std: float | None = Field(description="Standard deviation; null if the data say nothing about it")
    share: Share | None = Field(
        description="Torque error at one `std`, divided by the standard deviation of the torque"
    )
    verdict: Verdict
    implausible: bool = Field(False, description="True if friction is clearly negative, which is physically impossible")


class JointExcitation(BaseModel):
    """How a joint moved, and how well its motion determines friction."""

    joint: str
    span: float = Field(description="Largest less smallest position, rad or m")
    visited: Share | None = Field(
        description="Share of 20 equal parts of the joint's range that have samples; null if unknown"
    )
    speed_std: float = Field(description="Standard deviation, rad/s or m/s")
    acceleration_std: float = Field(description="Standard deviation, rad/s² or m/s²")
    forwards: Share = Field(description="Share of samples with a velocity above 0.02 rad/s or m/s")
    backwards: Share = Field(description="Share of samples with a velocity below −0.02 rad/s or m/s")
    still: Share | None = Field(None, description="Share of samples that move neither way")
    reversals: int = Field(description="Changes of direction within episodes")
    slow_forwards: Share = Field(description="Share of samples that move forwards slower than 0.1 rad/s or m/s")
    slow_backwards: Share = Field(description="Share of samples that move backwards slower than 0.1 rad/s or m/s")
    viscous: Weight
    coulomb: Weight
    offset: Weight
    collinear: Share = Field(
        description="Of dq, sign dq, ddq, cos q and sin q, the largest share of one that the other four explain"
    )
    collinear_term: str = Field(description="The feature with that share")


class WholeExcitation(BaseModel):
    """How well the data determine the robot's inertial parameters. Needs a robot with a URDF."""

    parameters: int = Field(
        description="Number of base parameters: combinations of inertial parameters that affect torque"
    )
    rank: int = Field(description="Number of base parameters with an excitation above 1 % of that of random motion")
    condition: float | None = Field(description="Condition number of the base regressor, columns scaled to equal norm")
    weakest: Share = Field(description="Excitation of the least excited one divided by that of random motion")
    weakest_body: str = Field(description="Joint that moves the body with the least excited parameters")


class Excitation(BaseModel):
    """How well the motion determines friction and inertial parameters."""

    friction_beside: Literal["rigid bodies", "any motion"] = Field(
        description="Model of the remaining torque while friction is estimated. `rigid bodies`: the robot's, with "
        "unknown parameters. `any motion`: any smooth function of the motion, which leaves friction less certain"
    )
    joints: list[JointExcitation]
    standstill: Share | None = Field(None, description="Share of samples in which no joint moves")
    motion_dimensions: float | None = Field(
        None, description="Number of independent motions: 1 if all joints move together, n if each moves on its own"
    )
    period_s: float | None = Field(
        None, description="Time after which the motion repeats itself, s; null if it does not"
    )
    whole: WholeExcitation | None
    text: str = Field(description="Summary in words")


class JointAgainstRobot(BaseModel):
    """A joint's torque, without friction, compared with the robot's rigid bodies; null if it cannot be determined."""

    joint: str
    gravity: float | None = Field(description="Gravity torque divided by that of the URDF: 1 if equal, 0 if absent")
    gravity_std: float | None
    inertia: float | None = Field(description="The same for inertial and velocity torques; rotors increase it")
    inertia_std: float | None
    explained: Share = Field(description="Share of the torque's variance that rigid bodies and friction explain")


class AgainstRobot(BaseModel):
    """Measured torque compared with the torque of a robot's rigid bodies."""

    robot: str = Field(description="Robot of the upload, else the robot that the joint names suggest")
    joints: list[JointAgainstRobot]


Cause = Literal[
    "torque_sign", "torque_order", "joint_order", "torque_factor", "no_gravity", "gravity_included", "gravity_doubled",
    "mounting", "robot", "friction_sign",
]  # fmt: skip


class Remedy(BaseModel):
    """A fault that would spoil a model, and the upload options that correct it."""

    cause: Cause
    joints: list[str] = Field(description="Affected joints")
    text: str
    options: dict[str, str] | None = Field(
        description="Query parameters to add when the file is read again; null if none would help"
    )


class DatasetReport(BaseModel):
    """Findings about a recording, and how it was prepared."""

    rows_uploaded: int
    rows: int = Field(description="Samples after preparation")
    episodes: int = Field(description="Number of contiguous parts")
    rate_hz: float | None = Field(description="Sampling rate after preparation, Hz; null without times")
    gaps: int = Field(description="Number of gaps in time at which the recording was split")
    derived: list[str] = Field(description="Quantities that were not uploaded and were derived")
    preparation: list[str] = Field(description="Steps that changed the data, one sentence each")
    ranges: dict[str, dict[str, list[float]]] = Field(description="Smallest and largest value by quantity and joint")
    torque_noise_estimate: list[float] = Field(
        description="White noise of the prepared torque per joint, N·m. `noise` has that of the recording"
    )
    warnings: list[str]
    reading: list[str] = Field(description="How the file was read: columns, units, joints and other notes")
    source: dict[str, Any] | None = Field(None, description="How the file's columns were read, for programs")
    recipe: dict[str, Any] = Field(description="Options of the preparation")
    steps: list[dict[str, Any]] = Field(description="Steps of `preparation` with their parameters")
    joint_types: list[JointType] | None = Field(
        None, description="Joint types of the robot, which training jobs use by default; null if unknown"
    )
    robot: str | None = Field(None, description="Robot with the limits that were compared with the data; null if none")
    upload_sha256: str | None = Field(
        None, description="Hash of the uploaded file; null if an earlier release stored it"
    )
    upload_kind: str | None = Field(None, description="Format in which the file was sent; null as `upload_options`")
    upload_options: dict[str, Any] | None = Field(
        None, description="Options of the upload; null if an earlier release stored it, without the file"
    )
    timing: Timing
    saturation: list[JointSaturation]
    limits: list[JointLimits]
    lag: list[Lag] = Field(description="All joints combined first, then each joint")
    noise: list[JointNoise]
    excitation: Excitation
    against_robot: AgainstRobot | None = Field(None, description="Null without a robot's URDF")
    remedies: list[Remedy] = Field(
        description="Corrections of the upload's options that `warnings` and `advice` mention"
    )
    advice: list[str] = Field(description="What to record next or to correct, one sentence each")


class Dataset(BaseModel):
    """An immutable, validated table of samples."""

    id: str
    name: str
    created_at: str
    sha256: str = Field(description="Hash of the stored samples")
    joint_names: list[str]
    torque_convention: TorqueConvention
    learnability: verdict.Verdict = Field(description="Best verdict that a version trained on it alone can get")
    report: DatasetReport


class DatasetPage(BaseModel):
    """One page of data sets, newest first."""

    items: list[Dataset]
    next_cursor: str | None


class PreviewColumn(BaseModel):
    """Points of one quantity of one joint, in row order."""

    quantity: str = Field(description="q, dq, ddq or tau")
    joint: str
    unit: str
    rows: list[int] = Field(description="Row of each point, counted from 0")
    t: list[float] = Field(description="Time of each point, s")
    values: list[float]


class Preview(BaseModel):
    """Columns of a data set, thinned for plots. Extremes are kept."""

    samples: int = Field(description="Rows of the data set")
    starts: list[int] = Field(
        description=f"First row of each episode, to break lines there; at most {MAX_PREVIEW_STARTS}, evenly chosen"
    )
    columns: list[PreviewColumn]
