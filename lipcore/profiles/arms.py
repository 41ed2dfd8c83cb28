"""Arms whose makers publish their numbers: profiles that are there whether or not a URDF is installed.

Where a maker's document and the URDF of example-robot-data differ, the document is taken and `source` says so.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lipcore.profiles.profile import FREE, Numbers, Sheet, degrees, numbered, symmetric

_FRANKA = (
    "JointState.effort and tau_J are the torque that link-side sensors measure, gravity included. tau_J_d, the "
    "commanded torque, is without gravity and friction compensation: upload it as `commanded`."
)
_PANDA = Sheet(
    "Franka Emika Robot (Panda)",
    tuple(f"panda_joint{joint}" for joint in range(1, 8)),
    "measured",
    _FRANKA,
    "github frankaemika/docs, control parameters, limits for Panda; the URDF of example-robot-data has the same",
    Numbers(
        (
            (-2.8973, 2.8973),
            (-1.7628, 1.7628),
            (-2.8973, 2.8973),
            (-3.0718, -0.0698),
            (-2.8973, 2.8973),
            (-0.0175, 3.7525),
            (-2.8973, 2.8973),
        ),
        (2.175,) * 4 + (2.61,) * 3,
        (87.0,) * 4 + (12.0,) * 3,
        (15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0),
    ),
    numbered(7, "fer_joint{}"),
)
_FR3 = Sheet(
    "Franka Research 3",
    tuple(f"fr3_joint{joint}" for joint in range(1, 8)),
    "measured",
    _FRANKA,
    "github frankaemika/franka_description, robots/fr3/joint_limits.yaml, and frankaemika/docs, control parameters; "
    "the speed limits hold in the middle of the range and fall towards its ends",
    Numbers(
        (
            (-2.7437, 2.7437),
            (-1.7837, 1.7837),
            (-2.9007, 2.9007),
            (-3.0421, -0.1518),
            (-2.8065, 2.8065),
            (0.5445, 4.5169),
            (-3.0159, 3.0159),
        ),
        (2.62,) * 4 + (5.26, 4.18, 5.26),
        (87.0,) * 4 + (12.0,) * 3,
        (10.0,) * 7,
    ),
)

_UR_JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
_UR_EFFORT = (
    "JointState.effort of the driver and actual_current of RTDE are motor currents in A, not torque, unless the driver "
    "was set to report torque (PolyScope 5.23 or 10.11 and later). Universal Robots publishes no torque constants: "
    "give `torque_constants`, in N·m/A at the joint."
)
_UR_SOURCE = (
    "github UniversalRobots/Universal_Robots_ROS2_Description, config/{}/joint_limits.yaml, from the user manual and "
    "the article on joint torques; the elbow turns ±180° there, since the upper arm is in the way of more; "
    "accelerations are not published"
)


def _ur(name: str, speed: tuple[float, ...], torque: tuple[float, ...], note: str = "", endless: bool = False) -> Sheet:
    """An arm of Universal Robots: speeds in °/s. endless: its last joint turns without end."""
    ranges = symmetric(360, 360, 180, 360, 360, 360)
    return Sheet(
        f"Universal Robots {name.upper().replace('E', 'e')}",
        tuple(f"{joint}_joint" for joint in _UR_JOINTS),
        "current",
        _UR_EFFORT,
        _UR_SOURCE.format(name) + note,
        Numbers((*ranges[:5], FREE) if endless else ranges, degrees(*speed), torque),
        tuple((joint,) for joint in _UR_JOINTS),
    )


_SMALL, _MEDIUM, _LARGE = (180, 180, 180, 360, 360, 360), (180,) * 6, (120, 120, 180, 180, 180, 180)
_OTHER_URDF = "; the URDF of example-robot-data gives other limits of speed and torque"

_XARM_EFFORT = (
    "UFACTORY's arms have no joint torque sensors: what the driver reports as effort is an estimate of the controller. "
    "Say what your driver does with `effort`."
)
_XARM7 = Sheet(
    "UFACTORY xArm 7",
    tuple(f"joint{joint}" for joint in range(1, 8)),
    "unknown",
    _XARM_EFFORT,
    "URDF of example-robot-data",
    Numbers(
        (
            (-2 * np.pi, 2 * np.pi),
            (-2.059, 2.0944),
            (-2 * np.pi, 2 * np.pi),
            (-0.19198, 3.927),
            (-2 * np.pi, 2 * np.pi),
            (-1.69297, np.pi),
            (-2 * np.pi, 2 * np.pi),
        ),
        (3.14,) * 7,
        (50.0, 50.0, 30.0, 30.0, 30.0, 20.0, 20.0),
    ),
    numbered(7, "xarm7_joint{}", "xarm_joint{}"),
)
_XARM6 = Sheet(
    "UFACTORY xArm 6",
    tuple(f"joint{joint}" for joint in range(1, 7)),
    "unknown",
    _XARM_EFFORT,
    "github xArm-Developer/xarm_ros, xarm_description/urdf/xarm6/xarm6.urdf.xacro",
    Numbers(
        (
            (-2 * np.pi, 2 * np.pi),
            (-2.059, 2.0944),
            (-3.927, 0.19198),
            (-2 * np.pi, 2 * np.pi),
            (-1.69297, np.pi),
            (-2 * np.pi, 2 * np.pi),
        ),
        (3.14,) * 6,
        (50.0, 50.0, 32.0, 32.0, 32.0, 20.0),
    ),
    numbered(6, "xarm6_joint{}", "xarm_joint{}"),
)

_KINOVA = Sheet(
    "Kinova Jaco 2, 6 joints, spherical wrist (j2s6s200)",
    tuple(f"j2s6s200_joint_{joint}" for joint in range(1, 7)),
    "measured",
    "JointState.effort is the torque that the actuators measure, gravity included, as long as the driver's "
    "publish_torque_with_gravity_compensation is false, its default.",
    "URDF of example-robot-data",
    Numbers(
        (
            FREE,
            (0.820304748437, 5.46288055874),
            (0.331612557879, 5.9515727493),
            FREE,
            (0.523598775598, 5.75958653158),
            FREE,
        ),
        (0.628318530718,) * 3 + (0.837758040957,) * 3,
        (40.0, 80.0, 40.0, 20.0, 20.0, 20.0),
    ),
    numbered(6, "j2s6s300_joint_{}", "jaco_joint_{}"),
)
_GEN3 = Sheet(
    "Kinova Gen3, 7 joints",
    tuple(f"joint_{joint}" for joint in range(1, 8)),
    "measured",
    "Torque sensors in every joint, gravity included: not checked against a document. Kinova's examples of torque "
    "control call the measured torque reversed against the actuator's direction: check the sign.",
    "github Kinovarobotics/ros_kortex, kortex_description/arms/gen3/7dof",
    Numbers(
        (FREE, (-2.41, 2.41), FREE, (-2.66, 2.66), FREE, (-2.23, 2.23), FREE),
        (1.3963,) * 4 + (1.2218,) * 3,
        (39.0,) * 4 + (9.0,) * 3,
    ),
    numbered(7, "gen3_joint_{}"),
)

_IIWA7 = Sheet(
    "KUKA LBR iiwa 7 R800",
    tuple(f"iiwa_joint_{joint}" for joint in range(1, 8)),
    "measured",
    "The fast robot interface's measured torque comes from joint torque sensors, gravity included; torque commanded "
    "on top of the controller's gravity compensation is `commanded`.",
    "KUKA, specification LBR iiwa: motion ranges, speeds at rated load, maximum torques; written down from memory, not "
    "checked against the document: compare with yours",
    Numbers(
        symmetric(170, 120, 170, 120, 170, 120, 175),
        degrees(98, 98, 100, 130, 140, 180, 180),
        (176.0, 176.0, 110.0, 110.0, 110.0, 40.0, 40.0),
    ),
    numbered(7, "lbr_iiwa_joint_{}", "joint_a{}", "lbr_A{}", "A{}"),
)
_IIWA14 = replace(
    _IIWA7,
    title="KUKA LBR iiwa 14 R820",
    numbers=Numbers(
        symmetric(170, 120, 170, 120, 170, 120, 175),
        degrees(85, 85, 100, 75, 130, 135, 135),
        (320.0, 320.0, 176.0, 176.0, 110.0, 40.0, 40.0),
    ),
)

_Z1 = Sheet(
    "Unitree Z1",
    tuple(f"joint{joint}" for joint in range(1, 7)),
    "unknown",
    "Which torque the arm reports is not documented well enough to say. Say what yours is with `effort`.",
    "URDF of example-robot-data",
    Numbers(
        (
            (-2.6179938779914944, 2.6179938779914944),
            (0.0, 2.9670597283903604),
            (-2.8797932657906435, 0.0),
            (-1.5184364492350666, 1.5184364492350666),
            (-1.3439035240356338, 1.3439035240356338),
            (-2.792526803190927, 2.792526803190927),
        ),
        (3.1415,) * 6,
        (30.0, 60.0, 30.0, 30.0, 30.0, 30.0),
    ),
    numbered(6, "z1_joint{}"),
)

_SO_EFFORT = (
    "Its servos measure no torque, and LeRobot records positions: an `action` is a wanted position, not a torque. "
    "Recorded present current is `current`, with your servos' torque constants."
)
_SO100 = Sheet(
    "SO-ARM100",
    ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper"),
    "unknown",
    _SO_EFFORT,
    "URDF of example-robot-data for the ranges, zero where that has it; its limits of speed and torque are "
    "placeholders and left out",
    Numbers(
        ((-2.0, 2.0), (0.0, 3.5), (-3.14158, 0.0), (-2.5, 1.2), (-3.14158, 3.14158), (-0.2, 2.0)), (np.nan,) * 6, None
    ),
)
_SO101 = replace(
    _SO100,
    title="SO-ARM101",
    numbers=Numbers(
        (
            (-1.91986, 1.91986),
            (-1.74533, 1.74533),
            (-1.69, 1.69),
            (-1.65806, 1.65806),
            (-2.74385, 2.84121),
            (-0.174533, 1.74533),
        ),
        (np.nan,) * 6,
        None,
    ),
)

ARMS: dict[str, Sheet] = {
    "panda": _PANDA,
    "fr3": _FR3,
    "ur3": _ur("ur3", _SMALL, (56.0, 56.0, 28.0, 12.0, 12.0, 12.0), _OTHER_URDF, endless=True),
    "ur5": _ur("ur5", _MEDIUM, (150.0, 150.0, 150.0, 28.0, 28.0, 28.0), _OTHER_URDF),
    "ur10": _ur("ur10", _LARGE, (330.0, 330.0, 150.0, 56.0, 56.0, 56.0), _OTHER_URDF),
    "ur3e": _ur("ur3e", _SMALL, (56.0, 56.0, 28.0, 12.0, 12.0, 12.0)),
    "ur5e": _ur("ur5e", _MEDIUM, (150.0, 150.0, 150.0, 28.0, 28.0, 28.0)),
    "ur10e": _ur("ur10e", _LARGE, (330.0, 330.0, 150.0, 56.0, 56.0, 56.0)),
    "ur16e": _ur("ur16e", _LARGE, (330.0, 330.0, 150.0, 54.0, 54.0, 54.0)),
    "xarm6": _XARM6,
    "xarm7": _XARM7,
    "kinova": _KINOVA,
    "gen3": _GEN3,
    "iiwa7": _IIWA7,
    "iiwa14": _IIWA14,
    "z1": _Z1,
    "so100": _SO100,
    "so101": _SO101,
}
