"""What a model says of what its recording leaves open."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lipcore import FitOptions, ModelFormatError, TorqueModel, load, save, train
from lipcore.fitting.estimators import make_estimator
from lipcore.kernels.arm_prior import Alternative
from lipcore.model.parameters import report
from lipcore.model.warnings import warnings
from lipcore.robots.library import random_arm
from lipcore.robots.simulation import Stream, simulate

ROBOT = random_arm(4, joints=3)
SHARE, MORE = 0.27, 1.5
"""Probability of the other arm, and what its second joint has more of viscous friction, N·m·s/rad."""


@pytest.fixture(scope="module")
def model() -> TorqueModel:
    stream = Stream(400, n_sinusoids=50, speed=10.0, motion="full", noise=0.05, viscous=0.3)
    options = FitOptions(search_seconds=10.0, statistics="chosen", device="cpu")
    return train(simulate(ROBOT, stream, seed=1), ROBOT.joint_types, "rigid-body", options)


@pytest.fixture(scope="module")
def parameters(model: TorqueModel) -> dict[str, Any]:
    return report(model.posterior, model.estimator, model.joint_names)


def test_a_good_recording_calls_for_nothing(model: TorqueModel, parameters: dict[str, Any]) -> None:
    assert warnings(model, parameters) == []
    samples = simulate(ROBOT, Stream(100, speed=10.0), seed=1)
    assert warnings(train(samples, ROBOT.joint_types, "se"), {}) == []


def test_joints_that_moved_together_are_told_of_any_estimator() -> None:
    samples = simulate(ROBOT, Stream(100, speed=10.0), seed=1)
    together = replace(samples, dq=samples.dq[:, :1] * np.array([1.0, -0.5, 2.0]))
    [text] = warnings(train(together, ROBOT.joint_types, "se"), {})
    assert text.startswith("Its joints moved together, like 1.0 independent ones of 3")


def test_another_arm_is_told_with_the_motion_that_tells_them_apart(model: TorqueModel) -> None:
    assert model.arm is not None
    friction = np.zeros((3, 3))
    first = Alternative(model.arm.geometry, model.arm.parameters, np.zeros(3), friction, 1 - SHARE)
    other = replace(first, friction=friction + np.outer([0, MORE, 0], [1, 0, 0]), probability=SHARE)
    arm = replace(model.arm, alternatives=(first, other))
    both = replace(model, estimator=make_estimator("rigid-body", model.joint_types, True, arm))
    [text] = warnings(both, {})
    assert text.startswith(
        "Two arms explain the recording about as well (73% and 27%); their difference is in tau_std."
    )
    range_of = model.training_range["dq"]
    assert f"joint2 is faster than {max(-range_of['min'][1], range_of['max'][1]):.2g} rad/s" in text
    speeds = 2 * model.posterior.basis.inducing.dq[:, 1].numpy()
    differ = MORE * np.sqrt(SHARE * (1 - SHARE) * np.mean(speeds**2))
    assert f"they differ by {differ:.2g} N·m in joint2" in text


def test_how_the_fit_ended(model: TorqueModel) -> None:
    ended = replace(model, fit={**model.fit, "search_ended": "time", "search_explained": False})
    late, coarse = warnings(ended, {})
    assert "time limit, 10 s" in late
    assert coarse.endswith("Compare with rigid-body+lip-chain.")


def test_numbers_of_the_geometry_that_are_open(model: TorqueModel, parameters: dict[str, Any]) -> None:
    joints = [{**each, "undetermined": []} for each in parameters["geometry"]["joints"]]
    joints[1]["undetermined"], joints[2]["undetermined"] = ["turn 1", "shift 1"], ["shift 2"]
    geometry = {"geometry": {"joints": joints}}
    [text] = warnings(model, geometry)
    assert "3 numbers of the geometry" in text
    assert "(joint2: turn 1, shift 1; joint3: shift 2)" in text
    together = replace(model, fit={**model.fit, "motion_dimensions": 1.2})
    assert "like 1.2 independent ones of 3" in warnings(together, geometry)[1]
    joints[2]["undetermined"] = []
    assert warnings(together, geometry) == []  # no torque depends on two


def test_a_manifest_holds_them(model: TorqueModel, tmp_path: Path) -> None:
    late = replace(model, fit={**model.fit, "search_ended": "time"})
    manifest = save(late, tmp_path / "late")
    assert manifest["warnings"] == warnings(late, manifest["parameters"])
    assert len(manifest["warnings"]) == 1
    for wrong in ("a text", [""], ["x"] * 21, [1]):
        (tmp_path / "late/manifest.json").write_text(json.dumps(manifest | {"warnings": wrong}))
        with pytest.raises(ModelFormatError, match="warnings"):
            load(tmp_path / "late")
