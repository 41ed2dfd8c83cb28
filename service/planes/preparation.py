"""What the planes share: imports and models that are in memory before the first process is forked."""

from __future__ import annotations

import gc
import logging
from importlib import import_module

import numpy as np

import lipcore
from lipcore.model.torque_model import TorqueModel
from service.foundation.errors import ServiceError
from service.foundation.settings import Settings, shipped_models
from service.models import registry
from service.models.loading import PRELOADED
from service.runtime.channel import share
from service.storage.database import Database
from service.storage.files import Files

logger = logging.getLogger(__name__)
SHARED_MODULES = (
    "anyio._backends._asyncio",  # AnyIO imports it at its first use
    "lipcore.model.payload",
    "service.learning.learner.worker",
    "service.learning.weigher.worker",
    "uvicorn.lifespan.on",
    "uvloop",
)
"""Modules that no other module of the service imports at its top."""


def share_memory(settings: Settings) -> None:
    """Import what the planes need and load the serving versions, so that forked processes share them.

    A shared store is not even opened: its client has threads, which a process that forks must not have.
    """
    for module in SHARED_MODULES:
        import_module(module)
    if settings.files_url is None:
        _load_models(settings, Files.of(settings))
    if not PRELOADED:  # a new home: compiled code that a model of any kind needs
        warm_up(lipcore.load(shipped_models() / "panda-sim"))
    gc.collect()
    gc.freeze()


def warm_up(model: TorqueModel) -> None:
    """Compile and build all that a model needs for its first answer."""
    from lipcore.model.payload import Carrier  # noqa: PLC0415 - numerics of the weigher

    model.warm_up()
    model.answer(np.zeros((3, model.n_joints)))
    if model.arms == 1:
        Carrier(model).warm_up()


def _load_models(settings: Settings, files: Files) -> None:
    database = Database.of(settings)
    try:
        recent = registry.recent(database, settings.max_loaded_models)
        for model, serving in registry.serving(database, recent).items():
            row = registry.find(database, model, serving.version)
            try:
                version = files.load_version(row.folder, row.checksums)
                version.warm_up()  # shares what it has built, too
                PRELOADED[row.folder] = share(version)
                warm_up(PRELOADED[row.folder])
            except Exception as error:  # the control plane reports it
                PRELOADED.pop(row.folder, None)
                logger.debug("version %s of model %s is not shared: %s", serving.version, model, error)
    except ServiceError:  # a model was deleted meanwhile
        pass
    finally:
        database.close()
