"""Axes with a wrong direction are turned until the rows of a payload are explained."""

import numpy as np
import pytest

from lipcore import load
from lipcore.model.payload import Carrier
from lipcore.online.payload.axes import turn_axes
from lipcore.online.payload.bodies import ANY_PAYLOAD
from lipcore.online.payload.draws import ArmWithPayload, Point
from tests import ROOT
from tests.lipcore.stepping import run_to_end

SIZE = 3
"""Number of variables of an arm, none of which changes the energy."""


def axes_of(geometry):
    turns, _ = geometry.placements(np.zeros(geometry.n_joints))
    return (turns @ geometry.axis[..., None])[..., 0]


class AxisEnergy:
    """Energy that grows with the angles of axes from the right ones."""

    carrier = None

    def __init__(self, geometry):
        self.right = axes_of(geometry)

    def at(self, place):
        energy = 1000.0 * np.square(axes_of(place.geometry) - self.right).sum()
        residual = np.append(np.sqrt(2 * energy), np.zeros(SIZE + 10))
        derivative = np.vstack([np.zeros(SIZE + 10), np.eye(SIZE + 10)])
        return Point(place, residual, energy / 100, lambda: derivative)


@pytest.fixture(scope="module")
def right():
    geometry = Carrier(load(ROOT / "models" / "panda-sim")).term.arm.geometry
    arm = ArmWithPayload(np.zeros(SIZE), geometry, ANY_PAYLOAD.centre)
    for joint, direction in ((4, 0), (5, 2), (6, 4)):
        arm = arm.with_axis(joint, direction)
    return arm


@pytest.mark.parametrize("wrong", [{}, {6: 1}, {5: 4}, {5: 0, 6: 2}, {4: 2, 5: 1, 6: 0}], ids=str)
def test_wrong_axes_of_the_wrist_are_found(right, wrong):
    problem = AxisEnergy(right.geometry)
    arm = right
    for joint, direction in wrong.items():
        arm = arm.with_axis(joint, direction)
    at = problem.at(arm)
    found = run_to_end(turn_axes(problem, at, at.energy))
    assert len(found) == (1 if wrong else 0)
    for each in found:
        assert each.energy == pytest.approx(0.0, abs=1e-9)


def test_axes_stay_unless_the_energy_falls_far(right):
    problem = AxisEnergy(right.geometry)
    assert run_to_end(turn_axes(problem, problem.at(right.with_axis(6, 1)), 5.0)) == []
