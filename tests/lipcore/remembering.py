"""An arm of two joints with friction that remembers where a joint came from."""

from dataclasses import replace
from functools import cache

from lipcore import FitOptions, Samples, TorqueModel
from lipcore.kernels.drive.play import with_deflections
from lipcore.robots.simulation import Simulation, simulate
from tests.lipcore.arm_oracles import arm, train_from_geometry

GEOMETRY, _, ROBOT = arm("RR", 31)
OPTIONS = FitOptions(hyperparameter_samples=40, posterior_samples=200, max_iterations=4, device="cpu")
ELEMENT, TORQUE = 3, 0.5
"""The element that friction depends on, and its torque, N·m."""


@cache
def remembering_samples(seed: int = 3, size: int = 1500) -> Samples:
    """Return a recording at 100 Hz with its deflections; always the same object."""
    samples = simulate(ROBOT, Simulation(size, rate=100.0, speed=6.0, noise=0.02), seed)
    samples = with_deflections(samples, ROBOT.joint_types)
    assert samples.deflections is not None
    return replace(samples, tau=samples.tau + TORQUE * samples.deflections[:, ELEMENT])


@cache
def remembering_model() -> TorqueModel:
    """Return a model trained on the recording; always the same object."""
    model = train_from_geometry(GEOMETRY, ROBOT, remembering_samples(), OPTIONS)
    assert model.remembers
    return model
