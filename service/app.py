"""The application: settings in, ASGI app out."""

from __future__ import annotations

import logging
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import torch
from anyio import CapacityLimiter, to_thread
from fastapi import FastAPI
from fastapi_offline import FastAPIOffline
from sqlalchemy import select
from threadpoolctl import threadpool_limits

from service import __version__, errors, health
from service.context import Service
from service.database import Database, DatasetRow, SnapshotRow, VersionRow
from service.datasets import routes as datasets
from service.files import Files
from service.home import hold_home
from service.inference import echo
from service.inference import routes as inference
from service.inference.loaded import LoadedModels
from service.limits import BodyLimit
from service.models import registry
from service.models import routes as models
from service.oip import routes as oip
from service.robots import routes as robots
from service.settings import Settings
from service.stream import routes as stream
from service.training import routes as training
from service.training.queue import JobQueue
from service.updates import routes as observations
from service.updates.control import routes as control
from service.updates.quality import metrics
from service.updates.refreshing import routes as refreshing
from service.updates.refreshing.wiring import attach
from service.updates.updates import Updates

logger = logging.getLogger(__name__)

SWITCH_INTERVAL = 1e-4
"""Seconds after which a thread that computes in Python lets the event loop go on. Python's own 5 ms are more than a
control loop has."""
DESCRIPTION = """Learns the inverse dynamics of a manipulator from joint data and answers torques with uncertainty.

Units are SI: rad, rad/s, rad/s², N·m (prismatic joints: m, m/s, m/s², N).
Errors are `{"error": {code, message, detail}}`, below /v2 `{"error": message}` as the Open Inference Protocol has it.
"""


def create_app(settings: Settings | None = None) -> FastAPI:
    """Build the application. Nothing is opened before it starts."""
    settings = settings or Settings()

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        lock = hold_home(settings.home)
        torch.set_num_threads(settings.serving_threads)  # here, for this thread and those that come later
        service = await to_thread.run_sync(_open, settings)
        threadpool_limits(settings.serving_threads)  # of BLAS, whose libraries the models have brought in
        app.state.service = service
        try:
            yield
        finally:
            await to_thread.run_sync(service.updates.close)
            service.jobs.close()
            service.database.close()
            lock.close()

    # the documentation page loads nothing from other hosts: robots' networks often have no way out
    app = FastAPIOffline(
        title="LIPServe",
        summary="A model server for robot dynamics",
        description=DESCRIPTION,
        version=__version__,
        lifespan=lifespan,
        redoc_url=None,
        # tried first, and not through an included router: 50 µs less a request
        routes=[*inference.hot.routes, *echo.hot.routes, *oip.hot.routes, *observations.hot.routes],
    )
    errors.install(app)
    app.add_middleware(
        BodyLimit,
        max_upload_bytes=settings.max_upload_bytes,
        max_urdf_bytes=settings.max_urdf_bytes,
        max_request_bytes=settings.max_request_bytes,
    )
    app.include_router(health.router)
    app.include_router(metrics.router)
    app.include_router(datasets.router)
    app.include_router(robots.router)
    app.include_router(training.router)
    app.include_router(models.router)
    app.include_router(inference.router)
    app.include_router(control.router)
    app.include_router(refreshing.router)
    app.include_router(oip.router)
    app.include_router(stream.router())
    return app


def _open(settings: Settings) -> Service:
    """Open the home, finish what an earlier run left, and load the models that are asked for first."""
    sys.setswitchinterval(SWITCH_INTERVAL)
    database, files = Database(settings.home), Files(settings.home)
    with database.session() as session:
        datasets_known = set(session.scalars(select(DatasetRow.id)))
        versions_known = set(session.scalars(select(VersionRow.folder)))
        snapshots_known = set(session.scalars(select(SnapshotRow.id)))
    if swept := files.sweep(datasets_known, versions_known, snapshots_known):
        logger.warning("removed %d unfinished files of an earlier run", swept)
    registry.install_shipped(database, files)
    loaded = LoadedModels(database, files, settings.max_loaded_models)
    logger.info("loaded %d models", loaded.preload())
    jobs = JobQueue(settings, database, lambda model, _: loaded.adopt(model))
    if recovered := jobs.recover():
        logger.warning("queued again after an interruption: %s", ", ".join(recovered))
    limiter = CapacityLimiter(settings.max_concurrent_predictions)
    updates = Updates(settings, database, files, loaded)
    service = Service(settings, database, files, loaded, jobs, limiter, updates)
    attach(service)
    return service
