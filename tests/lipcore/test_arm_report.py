"""What a manifest may report of an arm."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lipcore import ModelFormatError
from lipcore.files import persistence
from lipcore.files.arm import bodies_of, read_geometry
from lipcore.files.manifest import read_manifest_bytes
from tests.lipcore.arms import parameters, random_bodies, random_geometry

ORDER = [2, 0, 1]
SHIPPED = Path(__file__).parents[2] / "models" / "panda-sim"


def manifest(report: Any) -> bytes:
    """The manifest of the shipped model, with three joints only and these parameters."""
    shipped = json.loads((SHIPPED / "manifest.json").read_text())
    for name in ("joint_names", "joint_types", "noise_std"):
        shipped[name] = shipped[name][:3]
    for ends in shipped["training_range"].values():
        ends["min"], ends["max"] = ends["min"][:3], ends["max"][:3]
    return persistence.manifest_bytes({**shipped, "parameters": report})


@pytest.fixture
def report() -> Any:
    names = json.loads(manifest({}))["joint_names"]
    return parameters(random_geometry("RPR", 1), random_bodies(3, 1), names, ORDER)


def test_a_report_is_read_back(report: Any) -> None:
    entry = read_manifest_bytes(manifest(report))["parameters"]
    geometry, order = read_geometry(entry["geometry"], 3)
    assert order == ORDER
    np.testing.assert_array_equal(geometry.constants, random_geometry("RPR", 1).constants)
    np.testing.assert_array_equal(bodies_of(entry["inertia"])[order], random_bodies(3, 1))


def test_what_earlier_releases_reported_is_read(report: Any) -> None:
    for body in report["inertia"]["bodies"]:
        del body["undetermined"]
    read_manifest_bytes(manifest({name: report[name] for name in ("friction", "inertia")}))
    read_manifest_bytes(manifest({"friction": report["friction"]}))


Change = Callable[[Any], None]
WRONG: dict[str, Change] = {
    r"parameters.geometry.mode is 'guess', expected one of learn": lambda r: r["geometry"].update(mode="guess"),
    r"parameters.geometry lacks order": lambda r: r["geometry"].pop("order"),
    r"parameters.geometry.order is .*, expected each of the joints 0 to 2": lambda r: r["geometry"].update(
        order=[0, 0, 1]
    ),
    r"parameters.geometry.gravity\[2\] is": lambda r: r["geometry"].update(gravity=[0, 0, "down"]),
    r"parameters.geometry.joints is .*a list of 3": lambda r: r["geometry"]["joints"].pop(),
    r"parameters.geometry.joints\[1\].type": lambda r: r["geometry"]["joints"][1].update(type="ball"),
    r"parameters.geometry.joints\[0\].turn_std is": lambda r: r["geometry"]["joints"][0].update(turn_std=[0.1]),
    r"parameters.geometry.joints\[0\].undetermined": lambda r: r["geometry"]["joints"][0].update(undetermined=["x"]),
    r"parameters.geometry.joints\[2\] has the entry 'mesh'": lambda r: r["geometry"]["joints"][2].update(mesh="file"),
    r"parameters.geometry: rotation holds a matrix": lambda r: r["geometry"]["joints"][0]["rotation"][0].reverse(),
    r"parameters.rotor.std is": lambda r: r["rotor"].update(std=[0.1]),
    r"parameters.inertia.bodies\[1\].mean.first_moment\[0\] is": lambda r: r["inertia"]["bodies"][1]["mean"].update(
        first_moment=[None, 0, 0]
    ),
    r"parameters.inertia.bodies\[0\].undetermined is": lambda r: r["inertia"]["bodies"][0].update(undetermined="mass"),
    r"parameters has the entry 'colour'": lambda r: r.update(colour="red"),
}


@pytest.mark.parametrize("expected", WRONG)
def test_anything_else_is_refused(report: Any, expected: str) -> None:
    changed = copy.deepcopy(report)
    WRONG[expected](changed)
    with pytest.raises(ModelFormatError, match=expected.replace("'", "['\"]")):
        read_manifest_bytes(manifest(changed))
