"""Both planes in threads of one process, each with a small application, to test connections without a service."""

import asyncio
import socket
import threading
from functools import partial
from pathlib import Path
from tempfile import mkdtemp
from types import SimpleNamespace
from typing import Any, ClassVar
from unittest.mock import patch

import uvicorn

from service.api.limits.requests import PATIENCE, ClientPatience
from service.api.server.connections import guarded
from service.api.server.sockets import DRAIN_S, Server
from service.foundation.settings import Settings
from service.models.changes import Changes
from service.models.snapshot import Snapshot
from service.planes import dataplanes
from service.planes.confirmations import Confirmations
from service.planes.connections import CONNECTION, DataProtocol, DataStream
from service.planes.link import ControlLink
from service.runtime.channel import Channel
from service.telemetry.readiness import StopState
from tests.service.api.limits.serving import Serving
from tests.service.data import DEADLINE, eventually


class NoModels:
    """Loaded models of a service without any."""

    def __init__(self) -> None:
        self.changes, self.snapshot = Changes(), Snapshot()
        self.woken: list[str] = []
        """Models whose learner was woken."""

    def wake(self, model: str) -> None:
        """Wake a learner."""
        self.woken.append(model)


class QueriesApp:
    """The application of the data plane: `app` answers queries, all other requests are handed over.

    answered: number of requests that it has answered. A query whose body begins with "later" is handed over, too.
    """

    def __init__(self, app: Any) -> None:
        self.app, self.answered, self.mine = app, 0, ("/health/live", "/v1/echo")

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] == "websocket":
            await self.app(scope, receive, send)
            return
        message = await receive()
        if scope["path"] not in self.mine or message.get("body", b"").startswith(b"later"):
            scope[CONNECTION].hand_over()
            return

        async def again() -> Any:
            return message

        self.answered += 1
        await self.app(scope, again, send)


class TwoPlanes(Serving):
    """Both planes, running during a `with` block. `app` and `server` belong to the control plane.

    with_app: the application of both planes; unix: a listening Unix-domain socket instead of a port.
    """

    options: ClassVar[dict[str, Any]] = {"lifespan": "off", "log_level": "critical", "loop": "uvloop"}

    def __init__(
        self,
        notice_s: float = 0.0,
        drain_s: int = DRAIN_S,
        patience: ClientPatience = PATIENCE,
        with_app: Any = None,
        unix: socket.socket | None = None,
        **limits: Any,
    ) -> None:
        super().__init__(notice_s, drain_s, patience, with_app, **limits)
        self.queries, self.settings, self.unix = QueriesApp(self.app), Settings(**limits), unix
        self.loaded = NoModels()
        self.folder = Path(mkdtemp(prefix="planes-"))
        self.accepting = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.accepting.bind(str(self.folder / "link"))
        self.accepting.listen(8)
        self.patience, self.keep = patience, {"timeout_keep_alive": self.settings.keep_alive_s}
        self.keep |= {"timeout_graceful_shutdown": drain_s, "server_header": False, "date_header": False}
        self.keep["forwarded_allow_ips"] = self.settings.trusted_proxies
        self.server = Server(self._config(self.app), None, self.stopping, notice_s)
        self.link = ControlLink(self.settings, self.folder / "link", None)
        passing = {"passed": self.link.passed, "control": self.link.pass_on}
        kind = guarded(self.settings, patience, kind=DataProtocol, others=self.link.passed, **passing)
        stream = type("DataStream", (DataStream,), {"control": self.link.pass_on})
        config = self._config(self.queries, http=kind, ws=stream, port=self.port)
        self.data = Server(config, None, StopState(), notice_s)
        self._data_protocol = kind
        self.threads = [threading.Thread(target=run, daemon=True) for run in (self._run_control, self._run_data)]

    def _config(self, app: Any, **more: Any) -> uvicorn.Config:
        return uvicorn.Config(app, **{**self.options, **self.keep, **more})

    def _run_control(self) -> None:
        asyncio.run(self._control())

    async def _control(self) -> None:
        made = partial(guarded, patience=self.patience)
        self.server.config.load()
        self.server.lifespan = self.server.config.lifespan_class(self.server.config)
        state = SimpleNamespace(storage=SimpleNamespace(settings=self.settings), loaded=self.loaded)
        state.learners = SimpleNamespace(loaded=self.loaded)
        state.keyring, state.confirmations = None, Confirmations()
        with patch.object(dataplanes, "guarded", made):
            self.planes = dataplanes.DataPlanes(SimpleNamespace(state=state), self.server)
            connection, _ = await asyncio.to_thread(self.accepting.accept)
            self.planes.add(Channel(connection))
        self.server.started = True
        while not self.server.should_exit:
            await asyncio.sleep(0.01)
        self.planes.close()
        for each in list(self.server.server_state.connections):
            each.transport.abort()

    def _run_data(self) -> None:
        async def run() -> None:
            sockets = None if self.unix is None else [self.unix]
            serving = asyncio.create_task(self.data.serve(sockets))
            while not self.data.started:
                await asyncio.sleep(0.001)
            self.link.start(
                partial(
                    self._data_protocol,
                    config=self.data.config,
                    server_state=self.data.server_state,
                    app_state=self.data.lifespan.state,
                )
            )
            await serving

        asyncio.run(run())

    @property
    def connections(self) -> int:
        """Return the number of open connections of both planes, as the data plane counts them."""
        return len(self.data.server_state.connections) + self.link.passed.count(None)

    def __enter__(self) -> "TwoPlanes":
        for thread in self.threads:
            thread.start()
        eventually(lambda: self.server.started and self.data.started)
        return self

    def __exit__(self, *_: object) -> None:
        self.data.should_exit = True
        self.threads[1].join(DEADLINE)
        self.server.should_exit = True
        self.threads[0].join(DEADLINE)
        self.link.close()
        self.accepting.close()
        assert not any(thread.is_alive() for thread in self.threads)
