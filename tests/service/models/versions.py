"""Versions put into a running service without training them."""

from __future__ import annotations

from functools import cache
from typing import Any

import lipcore
from lipcore import FitOptions, TorqueModel
from service.models import registry
from service.storage.files import new_id
from tests.service.data import QUICK, service_of, stream
from tests.service.learning.pendulums import trained

__all__ = ["QUERY", "predict", "publish", "trained", "worse"]

QUERY: dict[str, Any] = {"q": [0.3, -0.2], "dq": [0.1, 0.4], "ddq": [1.0, -0.5]}


@cache
def worse() -> TorqueModel:
    """A model of a pendulum with more friction; always the same object."""
    return lipcore.train(stream(viscous=2.0), ["revolute"] * 2, "lip-chain", FitOptions(**QUICK))


def publish(api: Any, model: str, found: TorqueModel | None = None, lineage: Any = None, **arguments: Any) -> int:
    """Add a version to a model of the service, which answers from then on; return its number."""
    service = service_of(api)
    folder = new_id("mv")
    with service.files.new_version(folder) as target:
        manifest = lipcore.save(found or trained(), target, lineage or {})
    with service.database.transaction() as session:
        version = registry.publish(session, model, folder, manifest, None, **arguments)
    service.loaded.announce([model])
    return version


def predict(api: Any, model: str, **chosen: Any) -> Any:
    """Ask for a torque; return the answer."""
    return api.post(f"/v1/models/{model}/predict", json=QUERY | chosen)
