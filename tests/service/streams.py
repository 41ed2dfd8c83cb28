"""Frames of a torque stream, packed and parsed as the README documents them, without the service's own code."""

import json
import socket
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from sqlalchemy import select
from sqlalchemy.orm import undefer
from websockets.sync.client import ClientConnection, connect

import lipcore
from lipcore import TorqueModel
from lipcore.online.batch import Rows
from service.foundation.settings import Settings
from service.journal import log
from service.models import registry
from service.storage.database import Database, EventRow
from service.storage.files import Files
from tests.service.data import DEADLINE
from tests.service.server import Server

STD, LATE, ERROR, UNREAD, SCALE, EXTERNAL, PAYLOAD, FALLBACK = 1, 2, 4, 8, 16, 32, 64, 128
GRAVITY, MASS_MATRIX, CORIOLIS = 256, 512, 1024
PARTS = GRAVITY | MASS_MATRIX | CORIOLIS
LEARN, ASK_EXTERNAL = 2, 4
ASK_GRAVITY, ASK_MASS_MATRIX, ASK_CORIOLIS = 8, 16, 32
STREAM = "/v1/models/pendulum/stream"
MOTION = np.array([[0.3, -0.2], [0.1, 0.4], [1.0, -0.5]])
TAU = np.array([5.0, -2.0])


@dataclass(frozen=True)
class Streaming:
    """A server with a model "pendulum", of version 1 alone, and lipcore's copy of that version."""

    server: Server
    dataset: str
    model: TorqueModel


@dataclass(frozen=True)
class Answer:
    """An answer frame; `error` replaces the numbers if the request failed."""

    sequence: int
    flags: int
    version: int
    late: int
    revision: int
    seconds: float
    tau: np.ndarray | None = None
    std: np.ndarray | None = None
    scale: np.ndarray | None = None
    external: np.ndarray | None = None
    payload: np.ndarray | None = None
    part: np.ndarray | None = None
    error: dict[str, Any] | None = None


def frame(
    motion: Any = MOTION,
    sequence: int = 1,
    flags: int = STD,
    n: int | None = None,
    budget: float = 0.0,
    tau: Any = None,
    learn: bool = True,
) -> bytes:
    """Return a request frame.

    motion: q, dq, ddq, or those that a part needs; tau: measured torque, to be learnt unless `learn` is false.
    """
    numbers = np.asarray(motion, "<f8")
    n = numbers.shape[-1] if n is None else n
    torque = b"" if tau is None else np.asarray(tau, "<f8").tobytes()
    return (
        struct.pack("<IHHd", sequence, flags | (LEARN if torque and learn else 0), n, budget)
        + numbers.tobytes()
        + torque
    )


def read(data: bytes) -> Answer:
    """Parse an answer frame, and check that its length matches its header."""
    assert isinstance(data, bytes)
    sequence, flags, n, version, late, revision, seconds = struct.unpack_from("<IHHIIQd", data)
    assert flags & ~(STD | LATE | ERROR | UNREAD | SCALE | EXTERNAL | PAYLOAD | FALLBACK | PARTS) == 0
    assert seconds >= 0
    reply = Answer(sequence, flags, version, late, revision, seconds)
    if flags & ERROR:
        assert n == 0
        body = json.loads(data[32:])
        assert set(body) == {"error"}
        assert set(body["error"]) == {"code", "message", "detail"}
        return Answer(**{**vars(reply), "error": body["error"]})
    lengths = {"part": n * n if flags & MASS_MATRIX else n} if flags & PARTS else {"tau": n}
    lengths |= {"std": n} if flags & STD else {}
    lengths |= {"scale": n} if flags & SCALE else {}
    lengths |= {"external": 3 * n + 2} if flags & EXTERNAL else {}
    lengths |= {"payload": 2} if flags & PAYLOAD else {}
    assert len(data) == 32 + 8 * sum(lengths.values())
    parts = np.split(np.frombuffer(data, "<f8", offset=32), np.cumsum(list(lengths.values()))[:-1])
    return Answer(**{**vars(reply), **dict(zip(lengths, parts, strict=True))})


def open_stream(server: Server, path: str = STREAM, **options: Any) -> connect:
    """Return a connection, to be entered as a context, whose first message is unread."""
    made = socket.create_connection(("127.0.0.1", server.port), DEADLINE)
    made.settimeout(None)
    url = f"ws://127.0.0.1:{server.port}{path}"
    return connect(url, sock=made, legacy=False, close_timeout=DEADLINE, **{"compression": None, **options})


def read_hello(connection: ClientConnection) -> dict[str, Any]:
    """Return the next message, a JSON text that describes the serving version."""
    reply = connection.recv(DEADLINE)
    assert isinstance(reply, str)
    return json.loads(reply)


def send_frame(connection: ClientConnection, request: bytes | str) -> Answer:
    """Send a frame; return its answer."""
    connection.send(request)
    return read(connection.recv(DEADLINE))


def saved_model(server: Server, name: str, version: int) -> TorqueModel:
    """Load a version from a server's home with lipcore."""
    settings = Settings(home=server.home)
    database = Database.of(settings)
    try:
        return lipcore.load(Files.of(settings).version_folder(registry.find(database, name, version).folder))
    finally:
        database.close()


def motions(count: int, n: int = 2, seed: int = 0) -> np.ndarray:
    """Return motions (count, 3, n) in the range of the training data."""
    return np.random.default_rng(seed).uniform(-0.5, 0.5, (count, 3, n))


def logged_batches(server: Server, stream_id: str) -> list[EventRow]:
    """Return the durable batches of a stream in the order of the log."""
    database = Database.of(Settings(home=server.home))
    try:
        with database.session() as session:
            query = select(EventRow).where(EventRow.stream_id == stream_id, EventRow.kind == "batch")
            return list(session.scalars(query.order_by(EventRow.number).options(undefer(EventRow.payload))))
    finally:
        database.close()


def logged_rows(server: Server, stream_id: str) -> Rows:
    """Return all durable rows of a stream."""
    return Rows.concatenate([log.decode(event.payload) for event in logged_batches(server, stream_id)])
