"""The parent of both planes: it owns the port, imports everything once, forks, and starts again what ended."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import logging
import mmap
import os
import signal
import socket
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import uvicorn

from service.api.server import sockets
from service.api.server.connections import MAX_FRAME_BYTES, StreamProtocol, guarded
from service.app import create_app
from service.foundation.settings import Settings
from service.models import registry
from service.models.loading import PRELOADED
from service.planes import control, data, nursery
from service.planes.confirmations import confirm_answers
from service.runtime import companion
from service.runtime.allocator import limit_free_memory
from service.storage.database import Database
from service.storage.files import Files

logger = logging.getLogger(__name__)
BACKLOG = 2048
PR_SET_PDEATHSIG = 1
POLL_S, MAX_SILENT_S = 0.1, 0.5
"""Seconds between two looks at the data plane's heartbeat, and without one after which it is killed."""
SIGNALS = (signal.SIGCHLD, signal.SIGTERM, signal.SIGINT)


def serve(settings: Settings) -> None:
    """Serve until a signal; see the module's docstring."""
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    listener = socket.create_server((settings.host, settings.port), family=family, backlog=BACKLOG)
    with tempfile.TemporaryDirectory(prefix="lipserve-") as folder:
        link, lock = Path(folder) / "link", Path(folder) / "lock"
        accepting = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        accepting.bind(os.fspath(link))
        accepting.listen(8)
        _import_all(settings)

        def start_control() -> None:
            listener.close()
            _control(settings, accepting)

        def start_data() -> None:
            accepting.close()
            data.run(settings, listener, link, lock, beats)

        beats = mmap.mmap(-1, mmap.PAGESIZE)  # shared with all that are forked
        _supervise({"control": start_control, "data": start_data, "spare": start_data}, beats)


def _import_all(settings: Settings) -> None:
    """Import what both planes need, and load the serving versions, so that their pages are shared."""
    import anyio._backends._asyncio  # noqa: F401, PLC0415 - AnyIO imports it at its first use

    import service.learning.learner.worker  # noqa: PLC0415
    import service.learning.weigher.worker  # noqa: F401, PLC0415
    from lipcore.model.payload import Carrier  # noqa: PLC0415

    database, files = Database.of(settings), Files.of(settings)
    with contextlib.suppress(Exception):  # a new home
        recent = registry.serving(database, registry.recent(database, settings.max_loaded_models))
        for model, serving in recent.items():
            row = registry.find(database, model, serving.version)
            base = PRELOADED[row.folder] = files.load_version(row.folder, row.checksums)
            base.warm_up()
            base.answer(np.zeros((3, base.n_joints)))
            if base.arm is not None:
                Carrier(base).warm_up()
    database.close()
    gc.collect()
    gc.freeze()


def _supervise(kinds: dict[str, Callable[[], None]], beats: mmap.mmap) -> None:
    running, stopping = dict[int, str](), False
    seen, at = (0, 0), time.monotonic()

    def stop() -> None:
        nonlocal stopping
        stopping = True
        for pid, name in running.items():
            if name != "control":
                os.kill(pid, signal.SIGTERM)

    signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    for name, work in kinds.items():
        running[_fork(work, name)] = name
    while running:
        looked = time.monotonic()
        caught = signal.sigtimedwait(SIGNALS, POLL_S)
        if caught is not None and caught.si_signo != signal.SIGCHLD:
            stop()
        now, beat = time.monotonic(), data.BEAT.unpack_from(beats)
        if beat != seen or now - looked > MAX_SILENT_S / 2:  # else this process was stopped too
            seen, at = beat, now
        elif now - at > MAX_SILENT_S and beat[0] in running and not stopping:
            logger.error("the data plane %d hangs and is killed", beat[0])
            os.kill(beat[0], signal.SIGKILL)
            at = now
        pid, status = os.waitpid(-1, os.WNOHANG)
        if not pid:
            continue
        name = running.pop(pid, "")
        if not stopping:
            logger.error(
                "the %s process %d ended (%d); it is started again", name, pid, os.waitstatus_to_exitcode(status)
            )
            running[_fork(kinds[name], name)] = name
        elif set(running.values()) == {"control"}:  # after the data plane, whose last frames it logs
            os.kill(next(iter(running)), signal.SIGTERM)


def _fork(work: Callable[[], None], name: str) -> int:
    pid = os.fork()
    if pid:
        return pid
    try:
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
        limit_free_memory()
        with contextlib.suppress(OSError):
            Path("/proc/self/comm").write_text(f"lip-{name}")
        work()
    except BaseException:
        traceback.print_exc()
        time.sleep(0.2)
        os._exit(1)
    sys.stdout.flush()
    os._exit(0)


def _control(settings: Settings, link: socket.socket) -> None:
    nursery.start()
    companion.FORK = nursery.fork
    served = create_app(settings)
    confirm_answers(served)
    config = uvicorn.Config(
        served,
        log_config=None,
        access_log=False,
        loop="uvloop",
        http=guarded(settings),
        ws=StreamProtocol,
        ws_max_size=MAX_FRAME_BYTES,
        ws_per_message_deflate=False,
        timeout_keep_alive=settings.keep_alive_s,
        timeout_graceful_shutdown=sockets.DRAIN_S,
        forwarded_allow_ips=settings.trusted_proxies,
    )
    server: Any = control.ControlServer(config, None, served.state.stopping, settings.stop_notice_s)
    server.app, server.link = served, link
    server.run()
