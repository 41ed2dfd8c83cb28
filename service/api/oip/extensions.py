"""Triton's extensions of the protocol for its tools: repository index, model configuration and statistics.

The answers are plain documents, which HTTP sends as JSON and gRPC as messages with the same fields.
"""

from __future__ import annotations

from typing import Any

from sqlalchemy import select

from service.api.oip import schema
from service.api.oip.query import shapes
from service.api.oip.statistics import Statistics
from service.foundation.errors import InvalidRequestError, invalid_request, not_found
from service.models.loaded import LoadedModels, ServedModel
from service.storage.database import Database, VersionRow

DOUBLE = "TYPE_FP64"


def index(loaded: LoadedModels, ready: bool) -> list[dict[str, Any]]:
    """Return all versions with their state; ready: only those that can answer. Blocking: use it in a thread.

    A version that is not in memory is `READY` too: its first request loads it.
    """
    broken = loaded.unreadable()
    found = []
    for model, version in _versions(loaded.database, None):
        reason = broken.get((model, version), "")
        if not (ready and reason):
            state = "UNAVAILABLE" if reason else "READY"
            found.append({"name": model, "version": str(version), "state": state, "reason": reason})
    return found


def config(served: ServedModel, datatype: str | int = DOUBLE) -> dict[str, Any]:
    """Return the configuration of a version. datatype: FP64 in the transport's form.

    `max_batch_size` is 0: shapes include the number of queries, as in the metadata.
    """
    model = served.model
    inputs = [
        {"name": name, "data_type": datatype, "dims": [-1, model.n_joints], "optional": name == schema.TORQUE}
        for name in (*schema.INPUTS, schema.TORQUE)
    ]
    return {
        "name": served.name,
        "platform": f"lipserve_{model.estimator.name}",
        "backend": "lipserve",
        "max_batch_size": 0,
        "input": inputs,
        "output": [{"name": name, "data_type": datatype, "dims": list(shape)} for name, shape in shapes(model).items()],
        "model_transaction_policy": {"decoupled": False},
    }


def statistics(counted: Statistics, loaded: LoadedModels, model: str | None) -> list[dict[str, Any]]:
    """Return the statistics of all versions of a model; None: of all models. Blocking: use it in a thread.

    Raise NotFoundError.
    """
    versions = _versions(loaded.database, model)
    if model is not None and not versions:
        raise not_found("model", model)
    return [counted.show(*each) for each in versions]


def refuse_loading(model: str) -> InvalidRequestError:
    """Return the error for a request to load or unload a model."""
    message = (
        "Models are not loaded or unloaded by request: the first query of a version loads it. Add a version with POST "
        f"/v1/models/import or a training job; delete a model with DELETE /v1/models/{model[:200]}."
    )
    return invalid_request("model", model, "no request to load or unload", message)


def _versions(database: Database, model: str | None) -> list[tuple[str, int]]:
    query = select(VersionRow.model, VersionRow.version).order_by(VersionRow.model, VersionRow.version)
    if model is not None:
        query = query.where(VersionRow.model == model)
    with database.session() as session:
        return [(name, version) for name, version in session.execute(query)]
