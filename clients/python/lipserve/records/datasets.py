"""Data sets and their reports. Written by `python clients/python/records.py`."""

from __future__ import annotations

from typing import Any, Literal

from msgspec import field

from lipserve.records import Record


class Gap(Record, frozen=True, kw_only=True):
    """A pause within a recording.

    t: Time of the last sample before it, s
    seconds: How long it lasts
    """

    t: float
    seconds: float


class Timing(Record, frozen=True, kw_only=True):
    """When samples were taken. Shares are of the usual step of time.

    rate_hz: Usual rate of what was uploaded; null where no times were given
    duration_s: Time that the episodes cover, gaps left out
    jitter_p50: Median deviation of a step from the usual one
    jitter_p99: Deviation that 99 % of the steps stay within
    jitter_max: Largest deviation of a step that is no gap
    gaps: The longest gaps, at most 20, in order of time
    repeated_stamps: Rows left out as their time had been there before
    missing_rows: Rows left out as a value was missing
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
    """Signs that a joint's torque was cut off. Shares are of its samples.

    at_largest: Share of samples at the largest or the smallest torque
    flat: Share that stays there for five samples and longer while the joint moves
    at_limit: Share at 99 % of the robot's torque limit and above
    """

    joint: str
    at_largest: float
    flat: float
    at_limit: float | None


class JointLimits(Record, frozen=True, kw_only=True):
    """A joint against the robot's limits; null where a limit is not known.

    range_used: Share of the range of positions between smallest and largest
    speed_used: Largest speed over the limit
    torque_used: Largest torque over the limit
    beyond_range: Share of samples beyond the limits of position
    beyond_speed: Share of samples beyond the limit of speed
    beyond_torque: Share of samples beyond the limit of torque
    """

    joint: str
    range_used: float | None
    speed_used: float | None
    torque_used: float | None
    beyond_range: float | None
    beyond_speed: float | None
    beyond_torque: float | None


class Lag(Record, frozen=True, kw_only=True):
    """How long the torque comes after the motion that it belongs to; negative where it comes before.

    joint: Null for all joints together
    seconds: Null where the data cannot tell
    std_s: Its standard deviation, from leaving out an eighth at a time
    cost: Share of the torque's variance that the lag turns into error
    reason: Why the data cannot tell
    improves: Of a lag that differs from 0: joints whose torque, taken so much later, is clearly predicted better on
        parts held out
    """

    joint: str | None
    seconds: float | None = None
    std_s: float | None = None
    cost: float | None = None
    reason: str | None = None
    improves: list[str] = field(default_factory=list)


class JointNoise(Record, frozen=True, kw_only=True):
    """White noise of the signals as recorded; null where there are too few samples.

    torque: Standard deviation, N·m; null where the torque was smoothed, too
    torque_share: Of the torque's spread
    velocity: Standard deviation, rad/s; null where it was not recorded
    velocity_share: Of the velocity's spread
    smoothed: Torque without noise: low-passed, or simulated; nothing tells its noise
    """

    joint: str
    torque: float | None
    torque_share: float | None
    velocity: float | None
    velocity_share: float | None
    smoothed: bool = False


class Weight(Record, frozen=True, kw_only=True):
    """A weight of a joint's friction: how well these data would tell it.

    value: Its estimate, N·m·s/rad or N·m, beside rigid bodies; else null
    std: Standard deviation that they leave; null where they say nothing
    share: Torque of that deviation over the spread of the joint's torque
    implausible: Clearly negative friction: no joint has that
    """

    value: float | None = None
    std: float | None
    share: float | None
    verdict: Literal["well", "poorly", "not determined"]
    implausible: bool = False


class JointExcitation(Record, frozen=True, kw_only=True):
    """How a joint was moved, and what that says of it.

    span: Largest less smallest position, rad or m
    visited: Share of the robot's range, in 20 equal parts, with samples in it
    speed_std: rad/s or m/s
    acceleration_std: rad/s² or m/s²
    forwards: Share of samples that move forwards, faster than 0.02 rad/s or m/s
    backwards: Share that move backwards
    still: Share that does neither
    reversals: Changes of direction within an episode
    slow_forwards: Share of samples that move forwards slower than 0.1 rad/s or m/s
    slow_backwards: Share that move backwards as slowly
    collinear: Largest share of one of dq, sign dq, ddq, cos q, sin q that the other four explain
    collinear_term: Which one that is
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
    """How well the data tell the robot's inertial parameters; needs a robot with a URDF.

    parameters: Base parameters: combinations of inertial parameters that torques depend on
    rank: How many of them are excited at least a hundredth as much as by random motion
    condition: Condition of the base regressor, columns of equal norm
    weakest: Excitation of the least excited one over that of random motion
    weakest_body: Joint that moves the body which the least excited one mostly belongs to
    """

    parameters: int
    rank: int
    condition: float | None
    weakest: float
    weakest_body: str


class Excitation(Record, frozen=True, kw_only=True):
    """How well the data determine what is to be learnt.

    friction_beside: What explains the rest of the torque where the friction's weights are judged: the robot's rigid
        bodies with unknown parameters, or, without them, any smooth function of the motion, which leaves less certain
    standstill: Share of samples in which no joint moves
    motion_dimensions: Independent joints' worth of motion: 1 where all move together, n where each moves by itself
    text: The same in words
    """

    friction_beside: Literal["rigid bodies", "any motion"]
    joints: list[JointExcitation]
    standstill: float | None = None
    motion_dimensions: float | None = None
    whole: WholeExcitation | None
    text: str


class JointAgainstRobot(Record, frozen=True, kw_only=True):
    """A joint's torque against what the robot's rigid bodies need, friction apart; null where nothing tells it.

    gravity: Gravity's torque over the robot's: 1 as the URDF has it, 0 where absent
    inertia: The same of inertia and velocities; rotors make it larger
    explained: Share of the torque's variance that both and friction explain
    """

    joint: str
    gravity: float | None
    gravity_std: float | None
    inertia: float | None
    inertia_std: float | None
    explained: float


class AgainstRobot(Record, frozen=True, kw_only=True):
    """Torque against that of a robot's rigid bodies.

    robot: The robot of the upload, else the one that the names of the joints suggest
    """

    robot: str
    joints: list[JointAgainstRobot]


class Remedy(Record, frozen=True, kw_only=True):
    """What ruins a model, and the options of an upload of the same file that put it right.

    joints: Those concerned
    options: Of the upload's query, to be added; null where none would do
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
    """What was found in the recording and what was done to it.

    rows: Samples kept
    episodes: Contiguous recordings
    rate_hz: Usual sampling rate; null where no times were given
    gaps: Gaps in time, where the recording was split
    derived: Quantities that were not given and had to be derived
    preparation: Every step that changed the data
    ranges: Smallest and largest value per joint
    torque_noise_estimate: White noise on the torque per joint, as prepared, N·m; as recorded: see noise
    reading: What was found while the file was read, and what columns were taken as
    source: What the file's columns were taken as, in figures
    recipe: The choices that the preparation was made with
    steps: The steps of `preparation` with their parameters
    joint_types: Of the robot's joints: what a training job takes where it says nothing else
    robot: Robot whose limits the data were compared with
    upload_sha256: Hash of the uploaded file; null for those of earlier releases
    lag: All joints together first, then joint by joint
    against_robot: Null without a robot's URDF
    remedies: What `warnings` and `advice` say of the upload's options, to act on
    advice: What to record next, or to correct, one sentence each
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
    """

    id: str
    name: str
    created_at: str
    sha256: str
    joint_names: list[str]
    torque_convention: Literal["gravity_included", "gravity_compensated"]
    report: DatasetReport
