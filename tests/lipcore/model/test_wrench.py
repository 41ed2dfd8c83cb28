"""External wrench: recovered from the torque that Pinocchio computes for a force on the last link."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from lipcore import load
from lipcore.estimators.catalogue import make_estimator
from lipcore.kernels.arm import ArmKernel
from lipcore.model.parameters import weight_posterior
from lipcore.model.wrench import NoWrenchError, external_wrench, jacobian_of, wrench_of
from tests import ROOT
from tests.lipcore.arm_oracles import arm

FORCE = np.array([3.0, -5.0, 8.0, 0.4, -0.2, 0.6])
"""N and N·m, in the axes of the last link."""
MOTION = np.array([[0.1, -0.4, 0.2, -1.8, 0.3, 1.6, 0.3], [0.1, 0.2, -0.1, 0.3, 0.0, 0.2, -0.3], [0.5] * 7])


@pytest.mark.parametrize("kinds", ["RRRRRR", "RRRRRRR", "RRPRRRR"])
def test_wrench_is_the_force_on_the_last_link(kinds: str) -> None:
    geometry, _, robot = arm(kinds, 50)
    rng, data = np.random.default_rng(1), robot.model.createData()
    root = rng.standard_normal((len(kinds), len(kinds)))
    covariance, found = 0.01 * (root @ root.T + np.eye(len(kinds))), 0
    for q in rng.uniform(-1.5, 1.5, (20, len(kinds))):
        forces = pin.StdVec_Force()
        forces.extend([pin.Force.Zero()] * len(kinds) + [pin.Force(FORCE)])
        zero = np.zeros_like(q)
        torque = pin.rnea(robot.model, data, q, zero, zero, forces) - pin.rnea(robot.model, data, q, zero, zero)
        jacobian, turn = jacobian_of(geometry, q)
        expected = pin.computeJointJacobian(robot.model, data, q, len(kinds))  # in the axes of the link
        local = np.kron(np.eye(2), turn.T)
        np.testing.assert_allclose(local @ jacobian, expected, atol=1e-12)
        try:
            seen = wrench_of(geometry, q, torque, covariance)
        except NoWrenchError:  # a singular posture
            continue
        found += 1
        np.testing.assert_allclose(seen.link, FORCE, rtol=1e-8)
        np.testing.assert_allclose(seen.base, local.T @ FORCE, rtol=1e-8)
        precision = expected @ np.linalg.inv(covariance) @ expected.T
        np.testing.assert_allclose(seen.link_covariance @ precision, np.eye(6), atol=1e-6)
        np.testing.assert_allclose(seen.base_std**2, (local.T @ seen.link_covariance @ local).diagonal(), rtol=1e-6)
    assert found > 5


def test_wrench_at_a_tool_is_that_of_its_frame() -> None:
    """Pinocchio's Jacobian of a frame, and the same wrench moved from the last link."""
    geometry, _, robot = arm("RRRRRR", 50)
    place = pin.SE3(pin.utils.rotate("x", 0.7) @ pin.utils.rotate("z", -0.4), np.array([0.1, -0.05, 0.2]))
    frame = robot.model.addFrame(pin.Frame("tool", 6, place, pin.FrameType.OP_FRAME))
    q = np.array([0.3, -0.8, 1.1, 0.4, -0.9, 0.2])
    expected = pin.computeFrameJacobian(robot.model, robot.model.createData(), q, frame, pin.ReferenceFrame.LOCAL)
    jacobian, turn = jacobian_of(geometry, q, place.homogeneous)
    np.testing.assert_allclose(np.kron(np.eye(2), turn.T) @ jacobian, expected, atol=1e-12)
    torque, covariance = np.arange(1.0, 7.0), np.diag(np.arange(1.0, 7.0))
    link, tool = (
        wrench_of(geometry, q, torque, covariance),
        wrench_of(geometry, q, torque, covariance, place.homogeneous),
    )
    np.testing.assert_allclose(tool.link, place.actInv(pin.Force(link.link)).vector, rtol=1e-8)
    action = place.inverse().toDualActionMatrix()
    np.testing.assert_allclose(tool.link_covariance, action @ link.link_covariance @ action.T, rtol=1e-6, atol=1e-12)


def test_calibrated_geometry_is_the_learnt_one() -> None:
    learnt = load(ROOT / "models/panda-sim")
    known = learnt.arm
    assert known is not None
    assert known.mode == "learn"
    term = learnt.estimator.terms["rigid_body"]
    assert isinstance(term, ArmKernel)
    expected = term.geometry(weight_posterior(learnt.posterior, term).mean)
    assert learnt.geometry is not None
    np.testing.assert_allclose(learnt.geometry.translation, expected.translation, atol=1e-9)
    assert np.abs(expected.translation - known.geometry.translation).max() > 1e-6
    estimator = make_estimator("rigid-body", learnt.joint_types, arm=replace(known, mode="calibrate"))
    model = replace(learnt, estimator=estimator)
    tau = model.answer(MOTION)[0]
    base = np.array([10.0, 0.0, -5.0, 0.0, 0.5, 0.0])
    jacobian, _ = jacobian_of(expected, MOTION[0][known.order])
    pushed = tau.copy()
    pushed[known.order] -= jacobian.T @ base
    np.testing.assert_allclose(external_wrench(model, MOTION, pushed).base, base, atol=1e-7)


def test_singular_posture_and_short_arm_are_named() -> None:
    geometry, _, _ = arm("RRRRRR", 50)
    straight = replace(geometry, axis=np.tile([0.0, 0.0, 1.0], (6, 1)), rotation=np.tile(np.eye(3), (6, 1, 1)))
    with pytest.raises(NoWrenchError, match="the posture is singular"):
        wrench_of(straight, np.zeros(6), np.ones(6), np.eye(6))
    short, _, _ = arm("RRR", 50)
    with pytest.raises(NoWrenchError, match="the arm has 3 joints"):
        wrench_of(short, np.zeros(3), np.ones(3), np.eye(3))


def test_wrench_of_a_model_has_the_covariance_of_its_torque() -> None:
    learnt = load(ROOT / "models/panda-sim")
    tau = learnt.answer(MOTION)[0]
    with pytest.raises(NoWrenchError, match="learnt from torque"):
        external_wrench(learnt, MOTION, tau)
    assert learnt.arm is not None
    none = np.zeros(0)
    known = replace(learnt.arm, mode="fixed", expected=none, widths=none)
    model = replace(learnt, estimator=make_estimator("rigid-body", learnt.joint_types, arm=known))
    jacobian, _ = jacobian_of(known.geometry, MOTION[0][known.order])
    pushed = tau.copy()
    base = np.array([10.0, 0.0, -5.0, 0.0, 0.5, 0.0])
    pushed[known.order] -= jacobian.T @ base
    seen, still = external_wrench(model, MOTION, pushed), external_wrench(model, MOTION, tau)
    np.testing.assert_allclose(seen.base, base, atol=1e-8)
    np.testing.assert_allclose(still.base, 0.0, atol=1e-8)
    covariance = learnt.predict(*MOTION[:, None], covariance=True).covariance
    assert covariance is not None
    inside = learnt.scale[:, None] * (covariance[0] + np.diag(learnt.noise_std**2)) * learnt.scale
    weight = np.linalg.inv(inside[np.ix_(known.order, known.order)])
    np.testing.assert_allclose(seen.base_covariance @ (jacobian @ weight @ jacobian.T), np.eye(6), atol=1e-6)
    wider = external_wrench(model, MOTION, pushed, 2.0 * learnt.scale)
    np.testing.assert_allclose(wider.base_std, 2 * seen.base_std, rtol=1e-9)
