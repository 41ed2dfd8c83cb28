"""Data sets and their reports as the API shows them."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, Field

from lipcore.vocabulary import JointType, TorqueConvention

Verdict = Literal["well", "poorly", "not determined"]
"""How well the data tell a weight, see `FrictionOptions` for the thresholds."""

Share = float

MOST_STARTS = 2000
"""Most starts of episodes in a preview."""


class Gap(BaseModel):
    """A pause within a recording."""

    t: float = Field(description="Time of the last sample before it, s")
    seconds: float = Field(description="How long it lasts")


class Timing(BaseModel):
    """When samples were taken. Shares are of the usual step of time."""

    rate_hz: float | None = Field(description="Usual rate of what was uploaded; null where no times were given")
    duration_s: float | None = Field(description="Time that the episodes cover, gaps left out")
    jitter_p50: Share | None = Field(description="Median deviation of a step from the usual one")
    jitter_p99: Share | None = Field(description="Deviation that 99 % of the steps stay within")
    jitter_max: Share | None = Field(description="Largest deviation of a step that is no gap")
    gaps: list[Gap] = Field(description="The longest gaps, at most 20, in order of time")
    repeated_stamps: int = Field(description="Rows left out as their time had been there before")
    missing_rows: int = Field(description="Rows left out as a value was missing")


class JointSaturation(BaseModel):
    """Signs that a joint's torque was cut off. Shares are of its samples."""

    joint: str
    at_largest: Share = Field(description="Share of samples at the largest or the smallest torque")
    flat: Share = Field(description="Share that stays there for five samples and longer while the joint moves")
    at_limit: Share | None = Field(description="Share at 99 % of the robot's torque limit and above")


class JointLimits(BaseModel):
    """A joint against the robot's limits; null where a limit is not known."""

    joint: str
    range_used: Share | None = Field(description="Share of the range of positions between smallest and largest")
    speed_used: Share | None = Field(description="Largest speed over the limit")
    torque_used: Share | None = Field(description="Largest torque over the limit")
    beyond_range: Share | None = Field(description="Share of samples beyond the limits of position")
    beyond_speed: Share | None = Field(description="Share of samples beyond the limit of speed")
    beyond_torque: Share | None = Field(description="Share of samples beyond the limit of torque")


class Lag(BaseModel):
    """How long the torque comes after the motion that it belongs to; negative where it comes before."""

    joint: str | None = Field(description="Null for all joints together")
    seconds: float | None = Field(None, description="Null where the data cannot tell")
    std_s: float | None = Field(None, description="Its standard deviation, from leaving out an eighth at a time")
    cost: Share | None = Field(None, description="Share of the torque's variance that the lag turns into error")
    reason: str | None = Field(None, description="Why the data cannot tell")
    improves: list[str] = Field(
        [],
        description="Of a lag that differs from 0: joints whose torque, taken so much later, is clearly predicted "
        "better on parts held out",
    )


class JointNoise(BaseModel):
    """White noise of the signals as recorded; null where there are too few samples."""

    joint: str
    torque: float | None = Field(description="Standard deviation, N·m; null where the torque was smoothed, too")
    torque_share: Share | None = Field(description="Of the torque's spread")
    velocity: float | None = Field(description="Standard deviation, rad/s; null where it was not recorded")
    velocity_share: Share | None = Field(description="Of the velocity's spread")
    smoothed: bool = Field(False, description="Torque without noise: low-passed, or simulated; nothing tells its noise")


class Weight(BaseModel):
    """A weight of a joint's friction: how well these data would tell it."""

    value: float | None = Field(None, description="Its estimate, N·m·s/rad or N·m, beside rigid bodies; else null")
    std: float | None = Field(description="Standard deviation that they leave; null where they say nothing")
    share: Share | None = Field(description="Torque of that deviation over the spread of the joint's torque")
    verdict: Verdict
    implausible: bool = Field(False, description="Clearly negative friction: no joint has that")


class JointExcitation(BaseModel):
    """How a joint was moved, and what that says of it."""

    joint: str
    span: float = Field(description="Largest less smallest position, rad or m")
    visited: Share | None = Field(description="Share of the robot's range, in 20 equal parts, with samples in it")
    speed_std: float = Field(description="rad/s or m/s")
    acceleration_std: float = Field(description="rad/s² or m/s²")
    forwards: Share = Field(description="Share of samples that move forwards, faster than 0.02 rad/s or m/s")
    backwards: Share = Field(description="Share that move backwards")
    still: Share | None = Field(None, description="Share that does neither")
    reversals: int = Field(description="Changes of direction within an episode")
    slow_forwards: Share = Field(description="Share of samples that move forwards slower than 0.1 rad/s or m/s")
    slow_backwards: Share = Field(description="Share that move backwards as slowly")
    viscous: Weight
    coulomb: Weight
    offset: Weight
    collinear: Share = Field(
        description="Largest share of one of dq, sign dq, ddq, cos q, sin q that the other four explain"
    )
    collinear_term: str = Field(description="Which one that is")


class WholeExcitation(BaseModel):
    """How well the data tell the robot's inertial parameters; needs a robot with a URDF."""

    parameters: int = Field(description="Base parameters: combinations of inertial parameters that torques depend on")
    rank: int = Field(description="How many of them are excited at least a hundredth as much as by random motion")
    condition: float | None = Field(description="Condition of the base regressor, columns of equal norm")
    weakest: Share = Field(description="Excitation of the least excited one over that of random motion")
    weakest_body: str = Field(description="Joint that moves the body which the least excited one mostly belongs to")


class Excitation(BaseModel):
    """How well the data determine what is to be learnt."""

    friction_beside: Literal["rigid bodies", "any motion"] = Field(
        description="What explains the rest of the torque where the friction's weights are judged: the robot's rigid "
        "bodies with unknown parameters, or, without them, any smooth function of the motion, which leaves less certain"
    )
    joints: list[JointExcitation]
    standstill: Share | None = Field(None, description="Share of samples in which no joint moves")
    motion_dimensions: float | None = Field(
        None, description="Independent joints' worth of motion: 1 where all move together, n where each moves by itself"
    )
    whole: WholeExcitation | None
    text: str = Field(description="The same in words")


class JointAgainstRobot(BaseModel):
    """A joint's torque against what the robot's rigid bodies need, friction apart; null where nothing tells it."""

    joint: str
    gravity: float | None = Field(description="Gravity's torque over the robot's: 1 as the URDF has it, 0 where absent")
    gravity_std: float | None
    inertia: float | None = Field(description="The same of inertia and velocities; rotors make it larger")
    inertia_std: float | None
    explained: Share = Field(description="Share of the torque's variance that both and friction explain")


class AgainstRobot(BaseModel):
    """Torque against that of a robot's rigid bodies."""

    robot: str = Field(description="The robot of the upload, else the one that the names of the joints suggest")
    joints: list[JointAgainstRobot]


Cause = Literal[
    "torque_sign", "torque_order", "joint_order", "torque_factor", "no_gravity", "gravity_included", "gravity_doubled",
    "mounting", "robot", "friction_sign",
]  # fmt: skip


class Remedy(BaseModel):
    """What ruins a model, and the options of an upload of the same file that put it right."""

    cause: Cause
    joints: list[str] = Field(description="Those concerned")
    text: str
    options: dict[str, str] | None = Field(description="Of the upload's query, to be added; null where none would do")


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
    torque_noise_estimate: list[float] = Field(
        description="White noise on the torque per joint, as prepared, N·m; as recorded: see noise"
    )
    warnings: list[str]
    reading: list[str] = Field(description="What was found while the file was read, and what columns were taken as")
    source: dict[str, Any] | None = Field(None, description="What the file's columns were taken as, in figures")
    recipe: dict[str, Any] = Field(description="The choices that the preparation was made with")
    steps: list[dict[str, Any]] = Field(description="The steps of `preparation` with their parameters")
    joint_types: list[JointType] | None = Field(
        None, description="Of the robot's joints: what a training job takes where it says nothing else"
    )
    robot: str | None = Field(None, description="Robot whose limits the data were compared with")
    upload_sha256: str | None = Field(None, description="Hash of the uploaded file; null for those of earlier releases")
    timing: Timing
    saturation: list[JointSaturation]
    limits: list[JointLimits]
    lag: list[Lag] = Field(description="All joints together first, then joint by joint")
    noise: list[JointNoise]
    excitation: Excitation
    against_robot: AgainstRobot | None = Field(None, description="Null without a robot's URDF")
    remedies: list[Remedy] = Field(description="What `warnings` and `advice` say of the upload's options, to act on")
    advice: list[str] = Field(description="What to record next, or to correct, one sentence each")


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


class PreviewColumn(BaseModel):
    """Points of one quantity of one joint, in order of rows."""

    quantity: str = Field(description="q, dq, ddq or tau")
    joint: str
    unit: str
    rows: list[int] = Field(description="Rows that the points are, counted from 0")
    t: list[float] = Field(description="Their times, s")
    values: list[float]


class Preview(BaseModel):
    """Columns of a data set, thinned so that no extreme is lost."""

    samples: int = Field(description="Rows of the data set")
    starts: list[int] = Field(
        description=f"First rows of the episodes, for breaks in the lines; at most {MOST_STARTS}, evenly chosen"
    )
    columns: list[PreviewColumn]
