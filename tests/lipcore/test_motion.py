"""Motion: what is accepted as joint positions, velocities and accelerations."""

from __future__ import annotations

import numpy as np
import pytest

from lipcore.data.motion import Motion, check_joint_types


def test_one_instant_and_many_are_accepted() -> None:
    assert Motion.from_arrays([1, 2], [3, 4], [5, 6]).q.shape == (1, 2)
    motion = Motion.from_arrays(*np.arange(24.0).reshape(3, 4, 2))
    assert (len(motion), motion.n_joints) == (4, 2)
    assert motion[1:3].dq.tolist() == [[10.0, 11.0], [12.0, 13.0]]


def test_motion_does_not_share_memory_with_the_caller() -> None:
    q = np.zeros((2, 2))
    motion = Motion.from_arrays(q, q, q)
    q[:] = 7.0
    assert float(motion.q.abs().max()) == 0.0


@pytest.mark.parametrize("name", ["q", "dq", "ddq"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_value_that_is_not_finite_is_located(name: str, value: float) -> None:
    arrays = {key: np.zeros((3, 2)) for key in ("q", "dq", "ddq")}
    arrays[name][2, 1] = value
    with pytest.raises(ValueError, match=rf"^{name}\[2, 1\] is {value}, expected a finite number"):
        Motion.from_arrays(**arrays)


def test_differing_shapes_are_named() -> None:
    with pytest.raises(ValueError, match=r"ddq has shape \(3, 1\), expected \(3, 2\)"):
        Motion.from_arrays(np.zeros((3, 2)), np.zeros((3, 2)), np.zeros((3, 1)))


def test_arrays_of_three_dimensions_are_refused() -> None:
    with pytest.raises(ValueError, match="q"):
        Motion.from_arrays(*np.zeros((3, 4, 2, 2)))


def test_robot_without_joints_is_refused() -> None:
    with pytest.raises(ValueError, match="joint_types is empty"):
        check_joint_types([])
