"""Versions added to a service without training: pendulums, and the shipped arm."""

import json
from functools import cache
from typing import Any

import numpy as np

import lipcore
from lipcore import FitOptions, TorqueModel
from lipcore.files import persistence
from lipcore.files.manifest import MANIFEST, read_manifest_bytes
from lipcore.robots.library import load_robot
from lipcore.robots.urdf import RigidBody
from service.foundation.settings import Settings, shipped_models
from service.models import registry, shipped
from service.storage.database import Database
from service.storage.files import Files, new_id
from tests.lipcore.arms import parameters_of
from tests.service.data import QUICK, service_of, stream
from tests.service.learning.pendulums import trained_model

__all__ = ["QUERY", "predict", "predict_json", "publish", "train_worse", "trained_model"]

QUERY: dict[str, Any] = {"q": [0.3, -0.2], "dq": [0.1, 0.4], "ddq": [1.0, -0.5]}


@cache
def train_worse() -> TorqueModel:
    """Return a model of a pendulum with more friction; always the same object."""
    return lipcore.train(stream(viscous=2.0), ["revolute"] * 2, "lip-chain", FitOptions(**QUICK))


def publish(api: Any, model: str, found: TorqueModel | None = None, lineage: Any = None, **arguments: Any) -> int:
    """Add a version to a model of the service, which serves from then on; return its number."""
    service = service_of(api)
    folder = new_id("mv")
    with service.files.new_version(folder) as target:
        manifest = lipcore.save(found or trained_model(), target, lineage or {})
    with service.database.transaction() as session:
        version = registry.publish(session, model, folder, manifest, None, **arguments)
    service.loaded.announce([model])
    return version


def predict(api: Any, model: str, **chosen: Any) -> Any:
    """Query a torque, of QUERY if no motion is given; return the answer."""
    body = {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in chosen.items()}
    return api.post(f"/v1/models/{model}/predict", json=QUERY | body)


def predict_json(api: Any, model: str, **chosen: Any) -> Any:
    """Query a torque that must be answered; return the body."""
    answer = predict(api, model, **chosen)
    assert answer.status_code == 200, answer.text
    return answer.json()


WARNING = "Two arms explain it."
JOINTS = tuple(f"panda_joint{number}" for number in range(1, 8))


NO_BODIES: dict[str, Any] = {"inertia": None, "rotor": None, "geometry": None}
"""Entries that an estimator without rigid bodies omits from its `parameters`."""


def panda() -> RigidBody:
    """Return the robot that the shipped model was trained on."""
    return RigidBody.from_profile("panda", JOINTS, load_robot("panda").joint_types)


def publish_arm(database: Database, files: Files, model: str, **changed: Any) -> dict[str, Any]:
    """Add a version with the shipped model, its robot's geometry and WARNING; return its manifest.

    changed: other entries of its `parameters`; None removes one.
    """
    source, folder = persistence.read_files(shipped_models() / shipped.SHIPPED), new_id("mv")
    manifest = json.loads(source[MANIFEST])
    report = parameters_of(panda()) | changed
    manifest["parameters"] = {name: value for name, value in report.items() if value is not None}
    manifest["warnings"] = [WARNING] if "geometry" in manifest["parameters"] else []
    source[MANIFEST] = persistence.manifest_bytes(manifest)
    with files.new_version(folder) as target:
        persistence.write_folder(target, source)
    with database.transaction() as session:
        registry.publish(session, model, folder, read_manifest_bytes(source[MANIFEST]), None)
    return manifest


def publish_arm_at(home: Any, model: str, **changed: Any) -> dict[str, Any]:
    """Call `publish_arm` on the home of a service that may be running in another process."""
    settings = Settings(home=home)
    return publish_arm(Database.of(settings), Files.of(settings), model, **changed)
