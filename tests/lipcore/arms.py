"""Random arms, and the manifest entry `parameters` of an arm."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from lipcore.kernels.geometry import Geometry, rotation_of
from lipcore.robots.urdf import RigidBody


def random_geometry(kinds: str, seed: int, gravity: bool = True) -> Geometry:
    """Return joints `R` and `P` with no aligned axes, on a tilted base; lower case: the first joint of another arm."""
    rng = np.random.default_rng(seed)
    n = len(kinds)
    axis, down = rng.standard_normal((n, 3)), rng.standard_normal(3)
    return Geometry(
        tuple("prismatic" if kind in "Pp" else "revolute" for kind in kinds),
        np.array([rotation_of(rng.uniform(-2, 2, 3)) for _ in kinds]),
        rng.normal(0, 0.4, (n, 3)),
        axis / np.linalg.norm(axis, axis=1, keepdims=True),
        down * (9.81 / np.linalg.norm(down) if gravity else 0.0),
        (0, *(joint for joint, kind in enumerate(kinds) if kind.islower())),
    )


def random_bodies(n: int, seed: int) -> np.ndarray:
    """Return the ten parameters of n clouds of four points, (n, 10)."""
    rng = np.random.default_rng(seed)
    out = []
    for _ in range(n):
        masses, points = rng.uniform(0.2, 2.0, 4), rng.normal(0, 0.2, (4, 3))
        spread = (masses[:, None, None] * points[:, :, None] * points[:, None, :]).sum(0)
        inertia = np.trace(spread) * np.eye(3) - spread
        out.append([masses.sum(), *(masses @ points), *inertia[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]])
    return np.array(out)


def ten_parameters(values: Sequence[float]) -> dict[str, Any]:
    """Return ten parameters in the form of a manifest."""
    mass, *rest = map(float, values)
    return {"mass": mass, "first_moment": rest[:3], "inertia": rest[3:]}


def parameters(geometry: Geometry, bodies: np.ndarray, joint_names: Sequence[str], order: Sequence[int]) -> Any:
    """Return the entry `parameters` of a manifest.

    bodies: (n, 10), base to tip; joint_names: of the data; order: the data's joint at each place of the chain.
    """
    n = geometry.n_joints
    counts, at = geometry.screws, np.argsort(order)
    numbers = np.arange(n, dtype=float)
    friction = {
        name: {"mean": (scale * (1 + numbers)).tolist(), "std": [0.01] * n}
        for name, scale in (("viscous", 0.1), ("coulomb", 0.2), ("offset", -0.05))
    }
    joints = [
        {
            "joint": joint_names[order[place]],
            "type": geometry.joint_types[place],
            "rotation": geometry.rotation[place].tolist(),
            "translation": geometry.translation[place].tolist(),
            "axis": geometry.axis[place].tolist(),
            "across": geometry.across[place].tolist(),
            "turn_std": [0.001, 0.002][: counts[place]],
            "shift_std": [0.001, 0.004][: max(counts[place] - 2, 0)],
            "undetermined": ["shift 2"] if place == n - 1 and counts[place] == 4 else [],
            **({"root": True} if place and place in geometry.roots else {}),
        }
        for place in range(n)
    ]
    return {
        "friction": friction,
        "rotor": {"mean": (0.1 + 0.01 * numbers).tolist(), "std": [0.002] * n},
        "inertia": {
            "mean_is_plausible": True,
            "plausible_deviation": (0.001 * (1 + numbers)).tolist(),
            "bodies": [
                {
                    "joint": joint_names[joint],
                    "mean": ten_parameters(bodies[place]),
                    "std": ten_parameters(np.abs(bodies[place]) * 0.05 + 0.001),
                    "plausible": ten_parameters(bodies[place]),
                    "undetermined": ["mass", "first_moment"] if place == 0 else [],
                }
                for joint, place in enumerate(at)
            ],
        },
        "geometry": {
            "mode": "learn",
            "gravity": geometry.gravity.tolist(),
            "order": [int(joint) for joint in order],
            "joints": joints,
        },
    }


def parameters_of(robot: RigidBody) -> Any:
    """Return the entry `parameters` of a manifest with the geometry and masses of a robot."""
    chain = np.argsort(robot.order)
    return parameters(Geometry.from_robot(robot), robot.parameters()[chain], robot.joint_names, chain.tolist())
