"""The ASGI application, built from settings."""

from __future__ import annotations

import logging
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, AsyncExitStack, asynccontextmanager
from functools import partial

from anyio import CapacityLimiter, to_thread
from fastapi import FastAPI
from fastapi_offline import FastAPIOffline
from starlette.routing import BaseRoute
from threadpoolctl import threadpool_limits

from lipcore.posterior.threads import limit_threads
from service import __version__
from service.api import errors, metrics, openapi, requests
from service.api.access.keys import REFRESH_S, Keyring
from service.api.access.middleware import KeyAccess, LocalAccess
from service.api.access.scopes import Rules
from service.api.dashboard import routes as dashboard
from service.api.guide import routes as guide
from service.api.head import HeadAsGet
from service.api.limits.rates import RateLimit
from service.api.limits.requests import MAX_REQUESTS, PATIENCE, BodyLimit, Gate, Turns, body_limits
from service.api.metrics import System, Traffic
from service.api.oip import extension_routes, rpc
from service.api.oip import routes as oip
from service.api.oip.statistics import Statistics
from service.api.requests import MAX_REFUSALS_PER_S, RequestContext, RequestLog
from service.api.routes import (
    audit,
    datasets,
    health,
    jobs,
    learning,
    live,
    models,
    observations,
    predictions,
    robots,
)
from service.api.shared import Shared
from service.api.stream import routes as stream
from service.foundation.settings import Settings
from service.foundation.text import counted
from service.journal import alarms
from service.journal.webhook import Webhook
from service.learning import friction, refresh
from service.learning.learner.learnt import LearntVersions
from service.learning.learners import Learners
from service.learning.metrics import LearningCollector
from service.models import aliases, deletion, shipped
from service.models.loaded import LoadedModels
from service.models.loading import Store
from service.replication import Replication
from service.runtime.confinement import protections
from service.runtime.hourly import run_hourly
from service.runtime.process import SERVING_THREADS
from service.storage import audit as audit_log
from service.storage.files.store import start_sweeping
from service.storage.storage import Storage, lock_home
from service.telemetry.meters import Meters
from service.telemetry.readiness import Probe, Readiness, StopState
from service.training import ended
from service.training.metrics import JobMetrics, check_queue
from service.training.queue import JobQueue, queue_of

logger = logging.getLogger(__name__)

DESCRIPTION = """Learns the inverse dynamics of a manipulator from joint data and answers torques with uncertainty.

Units are SI: rad, rad/s, rad/s², N·m (prismatic joints: m, m/s, m/s², N).
Errors are `{"error": {code, message, detail}}`, below /v2 `{"error": message}` as the Open Inference Protocol has it.
"""


def create_app(settings: Settings | None = None, shared: Shared | None = None, store: Store | None = None) -> FastAPI:
    """Return the application. It opens files and the database only when it starts.

    shared: what it shares with other processes of the service; None if it is alone. store: see `LoadedModels`.
    """
    settings, shared = settings or Settings(), shared or Shared()
    stopping, meters = StopState(), Meters(counters=shared.counters)
    calls = rpc.check_installed(settings)
    burst = settings.max_request_burst
    keyring = Keyring(REFRESH_S, burst, shared.counters, shared.buckets) if settings.keys_needed else None

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        lock = lock_home(settings.home)
        # before a model is loaded: BLAS rounds differently with another number of threads
        threadpool_limits(SERVING_THREADS)
        limit_threads(SERVING_THREADS)
        storage, jobs, learners = await to_thread.run_sync(_open, settings, store)
        webhook = Webhook(storage.database, settings)
        _share(app, storage, jobs, learners, webhook, shared)
        learners.loaded.when_deleted.append(meters.forget)
        stop_following = storage.database.follow_others(lambda: Replication(learners).close)
        try:
            async with AsyncExitStack() as serving:
                if keyring is not None:
                    await serving.enter_async_context(keyring.watching(storage.database))
                await serving.enter_async_context(run_hourly(_chores(storage, learners)))
                if calls:
                    await serving.enter_async_context(_calls(app, settings, stopping, shared))
                webhook.start()
                yield
        finally:
            async with AsyncExitStack() as rest:
                rest.callback(lock.close)
                rest.callback(storage.database.close)
                rest.push_async_callback(to_thread.run_sync, webhook.close)
                rest.push_async_callback(to_thread.run_sync, learners.close)
                rest.push_async_callback(to_thread.run_sync, stop_following)
                await to_thread.run_sync(jobs.close)  # first: the learner needs the CPU to store its state

    hot = [*predictions.hot.routes, *predictions.echo_hot.routes, *oip.hot.routes, *observations.hot.routes]
    if calls:
        hot.append(_calls_route())
    # the documentation page loads nothing from other hosts: robots' networks are often isolated
    app = FastAPIOffline(
        title="LIPServe",
        summary="A model server for robot dynamics",
        description=DESCRIPTION,
        version=__version__,
        lifespan=lifespan,
        redoc_url=None,
        redirect_slashes=False,  # the redirect would go to an address from the client's Host header
        # matched first and without an included router: 50 µs less a request
        routes=hot,
        telemetry=requests.telemetry(settings),
    )
    app.state.stopping, app.state.meters, app.state.confined = stopping, meters, protections()
    app.state.workers = None
    errors.install(app)
    _add_middleware(app, settings, keyring, meters, hot, shared)
    openapi.install(app, settings.keys_needed)
    for router in (
        health.router,
        metrics.router,
        audit.router,
        datasets.router,
        robots.router,
        jobs.router,
        models.router,
        predictions.router,
        learning.router,
        learning.overview_router,
        live.router,
        extension_routes.router,  # before /v2/models/{model}
        oip.router,
        stream.router(shared.counters.gauge("admitted streams")),
    ):
        app.include_router(router)
    dashboard.install(app)
    guide.install(app)
    app.state.rules, app.state.keyring = Rules(app.routes), keyring
    return app


def _calls_route() -> BaseRoute:
    from service.api.oip.rpc.methods import Methods  # noqa: PLC0415 - of an extra

    return Methods()


def _calls(app: FastAPI, settings: Settings, stopping: StopState, shared: Shared) -> AbstractAsyncContextManager[int]:
    from service.api.oip.rpc.listening import listening  # noqa: PLC0415 - of an extra

    return listening(app, settings, stopping, shared.calls)


def _add_middleware(
    app: FastAPI,
    settings: Settings,
    keyring: Keyring | None,
    meters: Meters,
    hot: list[BaseRoute],
    shared: Shared,
) -> None:
    """Add the middleware of all requests, from the inside out."""
    app.add_middleware(HeadAsGet)
    app.add_middleware(
        BodyLimit,
        limits=body_limits(settings),
        seconds=PATIENCE.body_s,
        bytes_per_s=PATIENCE.body_bytes_per_s,
        at_once=MAX_REQUESTS // 4,
    )
    if settings.max_requests_per_s is not None:
        app.add_middleware(
            RateLimit, per_s=settings.max_requests_per_s, burst=settings.max_request_burst, buckets=shared.buckets
        )
    if keyring is None:
        app.add_middleware(LocalAccess)
    else:
        app.add_middleware(KeyAccess, keyring=keyring)
    app.add_middleware(Gate, max_requests=MAX_REQUESTS, admitted=shared.counters.gauge("admitted requests"))
    quiet = (str(getattr(route, "path", "")) for route in hot)
    log = RequestLog(quiet, settings.log_slow_s, MAX_REFUSALS_PER_S)
    app.add_middleware(RequestContext, meters=meters, log=log, tracing=settings.opentelemetry)  # the outermost


def _open(settings: Settings, store: Store | None) -> tuple[Storage, JobQueue, Learners]:
    """Open the home, clean up after an earlier run, and preload models."""
    # s after which a computing thread yields to the event loop. Python's 5 ms exceed a control loop's period.
    # With 0.1 ms the loop was over half a millisecond late two to five times as often beside a stream
    sys.setswitchinterval(3e-5)
    storage = Storage.open(settings)
    database, files = storage.database, storage.files
    database.adapter.settle()
    start_sweeping(database, files)
    shipped.install_shipped(database, files)
    loaded = LoadedModels(storage, LearntVersions(database, files), store=store)
    logger.info("loaded %s of %s", counted(loaded.preload(), "model"), settings.home)

    def trained(model: str, _: int) -> None:
        loaded.changed(model)
        deletion.delete_refreshed(loaded, model)

    jobs = queue_of(settings)(storage, trained)
    if recovered := jobs.recover():
        logger.warning("queued again after an interruption: %s", ", ".join(recovered))
    learners = Learners(loaded)
    learners.weighing.expect()
    refresh.attach(learners, jobs)
    friction.attach(learners)
    return storage, jobs, learners


def _chores(storage: Storage, learners: Learners) -> dict[str, Callable[[], object]]:
    """Return the hourly chores, by the name of what they delete."""
    cleaners = {
        "lines of the audit log": audit_log.clean,
        "alarms": alarms.clean,
        "moves of aliases": aliases.clean,
        "jobs": ended.clean,
    }
    cleaned = {name: partial(clean, storage.database, storage.settings) for name, clean in cleaners.items()}
    return {**cleaned, "observations": learners.retain}


def _share(
    app: FastAPI, storage: Storage, jobs: JobQueue, learners: Learners, webhook: Webhook, shared: Shared
) -> None:
    """Store the parts in the application's state, where routes read them."""
    state, loaded, settings = app.state, learners.loaded, storage.settings
    probes: dict[str, Probe] = {
        **storage.probes(),
        "models": loaded.check,
        "learner": learners.check_process,
        "training": lambda lasting: check_queue(jobs, lasting),
    }
    state.storage, state.loaded, state.jobs, state.learners = storage, loaded, jobs, learners
    state.sequences, state.statistics = shared.sequences, Statistics(shared.counters)
    state.turns = Turns(CapacityLimiter(settings.max_concurrent_predictions))
    state.readiness = Readiness(probes, state.stopping)
    state.collectors = (
        Traffic(state.meters),
        JobMetrics(storage.database),
        LearningCollector(learners),
        webhook,
        System(storage, state.readiness, shared.counters),
    )
