"""Data sets and their reports. Written by `python clients/python/records.py`."""

from __future__ import annotations

from typing import Any, Literal

from msgspec import field

from lipserve.records import Record
from lipserve.records.verdicts import Verdict


class Gap(Record, frozen=True, kw_only=True):
    """A gap in time within a recording.

    t: Time of the last sample before the gap, s
    seconds: Duration of the gap, s
    """

    t: float
    seconds: float


class Timing(Record, frozen=True, kw_only=True):
    """Sampling times of the recording. Jitter is a share of the median time step.

    rate_hz: Median sampling rate of the upload, Hz; null if it has no times
    duration_s: Total duration without gaps, s
    jitter_p50: Median deviation of a time step from the median step
    jitter_p99: 99 % quantile of that deviation
    jitter_max: Largest deviation of a time step that is not a gap
    gaps: The longest gaps, at most 20, in order of time
    repeated_stamps: Rows dropped because their time stamp repeats an earlier one
    missing_rows: Rows dropped because a value is missing
    """

    rate_hz: float | None
    duration_s: float | None
    jitter_p50: float | None
    jitter_p99: float | None
    jitter_max: float | None
    gaps: list[Gap]
    repeated_stamps: int
    missing_rows: int


class JointSaturation(Record, frozen=True, kw_only=True):
    """Signs that a joint's torque was saturated. Shares are of its samples.

    at_largest: Share of samples at the largest or the smallest torque
    flat: Share of samples that stay there for at least five samples while the joint moves
    at_limit: Share of samples at or above 99 % of the torque limit; null if it is unknown
    """

    joint: str
    at_largest: float
    flat: float
    at_limit: float | None


class JointLimits(Record, frozen=True, kw_only=True):
    """A joint compared with the robot's limits. Values are null if the limit is unknown.

    range_used: Largest less smallest position, as a share of the joint's range
    speed_used: Largest speed divided by the speed limit
    torque_limit: Rated torque of the actuator, N·m
    torque_used: Largest torque divided by the torque limit
    beyond_range: Share of samples beyond the position limits
    beyond_speed: Share of samples beyond the speed limit
    beyond_torque: Share of samples beyond the torque limit
    """

    joint: str
    range_used: float | None
    speed_used: float | None
    torque_limit: float | None = None
    torque_used: float | None
    beyond_range: float | None
    beyond_speed: float | None
    beyond_torque: float | None


class Lag(Record, frozen=True, kw_only=True):
    """Time lag of the torque behind the motion; negative if the torque is ahead.

    joint: Joint; null for all joints combined
    seconds: Lag, s; null if the data do not determine it
    std_s: Standard deviation of the lag, s, from leaving out one eighth of the data at a time
    cost: Share of the torque's variance that becomes error because of the lag
    reason: Why the lag is unknown; null if it is known
    improves: Joints with a clearly better prediction of torque on held-out parts if the lag is corrected. Empty unless
        the lag differs from 0
    """

    joint: str | None
    seconds: float | None = None
    std_s: float | None = None
    cost: float | None = None
    reason: str | None = None
    improves: list[str] = field(default_factory=list)


class JointNoise(Record, frozen=True, kw_only=True):
    """White noise of the signals as recorded; null if there are too few samples.

    torque: Standard deviation of the torque noise, N·m; also null if `smoothed`
    torque_share: Torque noise divided by the standard deviation of the torque
    velocity: Standard deviation of the velocity noise, rad/s; also null if not recorded
    velocity_share: Velocity noise divided by the standard deviation of the velocity
    smoothed: The torque was low-passed or simulated, so its noise cannot be estimated
    """

    joint: str
    torque: float | None
    torque_share: float | None
    velocity: float | None
    velocity_share: float | None
    smoothed: bool = False


class Weight(Record, frozen=True, kw_only=True):
    """A friction coefficient of a joint, and how well these data determine it.

    value: Estimate, N·m·s/rad or N·m; null unless rigid bodies are fitted too
    std: Standard deviation; null if the data say nothing about it
    share: Torque error at one `std`, divided by the standard deviation of the torque
    implausible: True if friction is clearly negative, which is physically impossible
    """

    value: float | None = None
    std: float | None
    share: float | None
    verdict: Literal["well", "poorly", "not determined"]
    implausible: bool = False


class JointExcitation(Record, frozen=True, kw_only=True):
    """How a joint moved, and how well its motion determines friction.

    span: Largest less smallest position, rad or m
    visited: Share of 20 equal parts of the joint's range that have samples; null if unknown
    speed_std: Standard deviation, rad/s or m/s
    acceleration_std: Standard deviation, rad/s² or m/s²
    forwards: Share of samples with a velocity above 0.02 rad/s or m/s
    backwards: Share of samples with a velocity below −0.02 rad/s or m/s
    still: Share of samples that move neither way
    reversals: Changes of direction within episodes
    slow_forwards: Share of samples that move forwards slower than 0.1 rad/s or m/s
    slow_backwards: Share of samples that move backwards slower than 0.1 rad/s or m/s
    collinear: Of dq, sign dq, ddq, cos q and sin q, the largest share of one that the other four explain
    collinear_term: The feature with that share
    """

    joint: str
    span: float
    visited: float | None
    speed_std: float
    acceleration_std: float
    forwards: float
    backwards: float
    still: float | None = None
    reversals: int
    slow_forwards: float
    slow_backwards: float
    viscous: Weight
    coulomb: Weight
    offset: Weight
    collinear: float
    collinear_term: str


class WholeExcitation(Record, frozen=True, kw_only=True):
    """How well the data determine the robot's inertial parameters. Needs a robot with a URDF.

    parameters: Number of base parameters: combinations of inertial parameters that affect torque
    rank: Number of base parameters with an excitation above 1 % of that of random motion
    condition: Condition number of the base regressor, columns scaled to equal norm
    weakest: Excitation of the least excited one divided by that of random motion
    weakest_body: Joint that moves the body with the least excited parameters
    """

    parameters: int
    rank: int
    condition: float | None
    weakest: float
    weakest_body: str


class Excitation(Record, frozen=True, kw_only=True):
    """How well the motion determines friction and inertial parameters.

    friction_beside: Model of the remaining torque while friction is estimated. `rigid bodies`: the robot's, with
        unknown parameters. `any motion`: any smooth function of the motion, which leaves friction less certain
    standstill: Share of samples in which no joint moves
    motion_dimensions: Number of independent motions: 1 if all joints move together, n if each moves on its own
    period_s: Time after which the motion repeats itself, s; null if it does not
    text: Summary in words
    """

    friction_beside: Literal["rigid bodies", "any motion"]
    joints: list[JointExcitation]
    standstill: float | None = None
    motion_dimensions: float | None = None
    period_s: float | None = None
    whole: WholeExcitation | None
    text: str


class JointAgainstRobot(Record, frozen=True, kw_only=True):
    """A joint's torque, without friction, compared with the robot's rigid bodies; null if it cannot be determined.

    gravity: Gravity torque divided by that of the URDF: 1 if equal, 0 if absent
    inertia: The same for inertial and velocity torques; rotors increase it
    explained: Share of the torque's variance that rigid bodies and friction explain
    """

    joint: str
    gravity: float | None
    gravity_std: float | None
    inertia: float | None
    inertia_std: float | None
    explained: float


class AgainstRobot(Record, frozen=True, kw_only=True):
    """Measured torque compared with the torque of a robot's rigid bodies.

    robot: Robot of the upload, else the robot that the joint names suggest
    """

    robot: str
    joints: list[JointAgainstRobot]


class Remedy(Record, frozen=True, kw_only=True):
    """A fault that would spoil a model, and the upload options that correct it.

    joints: Affected joints
    options: Query parameters to add when the file is read again; null if none would help
    """

    cause: Literal[
        "torque_sign",
        "torque_order",
        "joint_order",
        "torque_factor",
        "no_gravity",
        "gravity_included",
        "gravity_doubled",
        "mounting",
        "robot",
        "friction_sign",
    ]
    joints: list[str]
    text: str
    options: dict[str, str] | None


class DatasetReport(Record, frozen=True, kw_only=True):
    """Findings about a recording, and how it was prepared.

    rows: Samples after preparation
    episodes: Number of contiguous parts
    rate_hz: Sampling rate after preparation, Hz; null without times
    gaps: Number of gaps in time at which the recording was split
    derived: Quantities that were not uploaded and were derived
    preparation: Steps that changed the data, one sentence each
    ranges: Smallest and largest value by quantity and joint
    torque_noise_estimate: White noise of the prepared torque per joint, N·m. `noise` has that of the recording
    reading: How the file was read: columns, units, joints and other notes
    source: How the file's columns were read, for programs
    recipe: Options of the preparation
    steps: Steps of `preparation` with their parameters
    joint_types: Joint types of the robot, which training jobs use by default; null if unknown
    robot: Robot with the limits that were compared with the data; null if none
    upload_sha256: Hash of the uploaded file; null if an earlier release stored it
    upload_kind: Format in which the file was sent; null as `upload_options`
    upload_options: Options of the upload; null if an earlier release stored it, without the file
    lag: All joints combined first, then each joint
    against_robot: Null without a robot's URDF
    remedies: Corrections of the upload's options that `warnings` and `advice` mention
    advice: What to record next or to correct, one sentence each
    """

    rows_uploaded: int
    rows: int
    episodes: int
    rate_hz: float | None
    gaps: int
    derived: list[str]
    preparation: list[str]
    ranges: dict[str, dict[str, list[float]]]
    torque_noise_estimate: list[float]
    warnings: list[str]
    reading: list[str]
    source: dict[str, Any] | None = None
    recipe: dict[str, Any]
    steps: list[dict[str, Any]]
    joint_types: list[Literal["revolute", "prismatic"]] | None = None
    robot: str | None = None
    upload_sha256: str | None = None
    upload_kind: str | None = None
    upload_options: dict[str, Any] | None = None
    timing: Timing
    saturation: list[JointSaturation]
    limits: list[JointLimits]
    lag: list[Lag]
    noise: list[JointNoise]
    excitation: Excitation
    against_robot: AgainstRobot | None = None
    remedies: list[Remedy]
    advice: list[str]


class Dataset(Record, frozen=True, kw_only=True):
    """An immutable, validated table of samples.

    sha256: Hash of the stored samples
    learnability: Best verdict that a version trained on it alone can get
    """

    id: str
    name: str
    created_at: str
    sha256: str
    joint_names: list[str]
    torque_convention: Literal["gravity_included", "gravity_compensated"]
    learnability: Verdict
    report: DatasetReport
