"""The work of the weigher process: follow streams row by row, and refine their payloads in between."""

from __future__ import annotations

import logging
import time
from collections import OrderedDict
from collections.abc import Generator, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection

import numpy as np

from lipcore.model.payload import Carrier
from lipcore.model.torque_model import TorqueModel
from lipcore.online.batch import Rows
from lipcore.online.payload.draws import draw_arms
from lipcore.online.payload.held import TrackedPayload
from lipcore.online.payload.holding import PayloadTracker
from lipcore.online.payload.payload import estimate
from service.foundation.settings import Settings
from service.learning.weigher.messages import (
    MAX_STREAMS,
    Message,
    PosteriorUpdate,
    Stream,
    StreamRows,
    UnknownStream,
    WatchUpdate,
)
from service.models import registry
from service.runtime.companion import BEAT, BEAT_S, receive_work
from service.storage.database import Database
from service.storage.files import Files

logger = logging.getLogger(__name__)

REFINING_SHARE, REFINING_S = 0.15, 2.0
"""CPU time for refining: share of each second, and max saved up, s. The latest payload is refined first."""


def run(settings: Settings, connection: Connection) -> None:
    """Follow the streams of the rows that arrive over the connection, until it ends or None arrives."""
    database, files = Database.of(settings), Files.of(settings)
    weigher = Weigher(Versions(database, files))
    try:
        with suppress(EOFError, ConnectionError):  # the service is gone
            beaten = time.monotonic()
            while (work := receive_work(connection, min(weigher.pause(), BEAT_S))) is not None:
                for about, given in work.items():
                    if isinstance(about, tuple) and not given:
                        weigher.expect(about[0], about[1])
                    elif isinstance(about, tuple):
                        for message in weigher.follow(about, given):
                            connection.send(message)
                    else:  # the name of a deleted model
                        weigher.forget(str(about))
                for message in weigher.refine():
                    connection.send(message)
                if time.monotonic() - beaten >= BEAT_S:
                    connection.send(BEAT)
                    beaten = time.monotonic()
    finally:
        database.close()


WARM_UP_ROWS, WARM_UP_RATE_HZ = 60, 100.0
"""Number and rate of the artificial rows of `Weigher.expect`."""


class Versions:
    """Versions as trained, loaded on first use. most: max versions in memory."""

    def __init__(self, database: Database, files: Files, most: int = 8) -> None:
        self._database, self._files, self._most = database, files, most
        self._known: OrderedDict[tuple[str, int], TorqueModel] = OrderedDict()

    def get(self, model: str, version: int) -> TorqueModel:
        """Return the version; raise NotFoundError or ModelFormatError."""
        key = model, version
        if key not in self._known:
            row = registry.find(self._database, model, version)
            self._known[key] = self._files.load_version(row.folder, row.checksums)
        self._known.move_to_end(key)
        if len(self._known) > self._most:
            self._known.popitem(last=False)
        return self._known[key]

    def forget(self, model: str) -> None:
        """Drop the versions of a model: another model may get its name."""
        for key in [key for key in self._known if key[0] == model]:
            del self._known[key]


@dataclass
class FollowedStream:
    """A stream and its payload."""

    carrier: Carrier
    watch: PayloadTracker
    event: int
    """Event that set the payload before the rows, see `StreamRows`."""
    received: float
    """Unix time at which the latest rows arrived, s."""
    reported: PayloadTracker | None = None
    """Payload that was last sent to the service."""
    refining: Generator[None, None, TrackedPayload] | None = None
    """Refinement that is under way."""


class Weigher:
    """The streams that are followed. versions: loads the version of a model."""

    def __init__(self, versions: Versions) -> None:
        self._versions = versions
        self._streams: OrderedDict[Stream, FollowedStream] = OrderedDict()  # in the order of their last rows
        self._carriers: dict[tuple[str, int], tuple[TorqueModel, Carrier]] = {}
        self._preparing: dict[tuple[str, int], Generator[None, None, object]] = {}
        self._left, self._counted = REFINING_S, time.monotonic()

    def pause(self) -> float:
        """Return the seconds until there is work, if no message arrives."""
        if self._preparing:
            return 0.0
        return np.inf if self._next_refined() is None else max(0.0, -self._credit() / REFINING_SHARE)

    def expect(self, model: str, version: int) -> None:
        """Load a version and estimate the payload of artificial rows, so that all code is compiled before a stream."""
        try:
            carrier = self._carrier((model, version), ())
            limits, n, draw = carrier.model.training_range, carrier.model.n_joints, np.random.default_rng(0).uniform
            q, dq, ddq = (
                draw(limits[name]["min"], limits[name]["max"], (WARM_UP_ROWS, n)) for name in ("q", "dq", "ddq")
            )
            time_ = np.arange(WARM_UP_ROWS) / WARM_UP_RATE_HZ
            tau = carrier.model.predict(q, dq, ddq).tau
            PayloadTracker(n).step(carrier, Rows(time_, q, dq, ddq, tau, np.zeros(WARM_UP_ROWS, np.uint8)))
            estimate(carrier, Rows(time_, q, dq, ddq, 1.1 * tau, np.zeros(WARM_UP_ROWS, np.uint8)).take(slice(0, 10)))
        except Exception:  # its streams raise the error again
            logger.exception("could not prepare version %d of model %s for payloads", version, model)

    def follow(self, stream: Stream, given: Sequence[StreamRows]) -> Iterator[Message]:
        """Follow rows of a stream and yield its payload if it has changed."""
        try:
            followed = self._find_stream(stream, given)
            if followed is None:
                yield UnknownStream(stream)
                return
            rows = Rows.concatenate([each.rows for each in given if each.event == followed.event])
            rows = rows.take(np.argsort(rows.time, kind="stable"))
            followed.watch = followed.watch.step(followed.carrier, rows)
            followed.received = given[-1].received
        except np.linalg.LinAlgError as error:  # of rows that no arm explains
            logger.error("the payload estimate of stream %r of model %s starts again: %s", stream[2], stream[0], error)
            self._streams.pop(stream, None)
            return
        except Exception:
            logger.exception("could not estimate the payload of stream %r of model %s", stream[2], stream[0])
            self._streams.pop(stream, None)
            return
        if followed.refining is None:
            followed.refining = followed.watch.refinement()
        yield from self._report(stream, followed)

    def forget(self, model: str) -> None:
        """Delete everything about a model that was deleted."""
        self._versions.forget(model)
        for stream in [each for each in self._streams if each[0] == model]:
            del self._streams[stream]
        for version in [each for each in self._carriers if each[0] == model]:
            del self._carriers[version]
            self._preparing.pop(version, None)

    def refine(self) -> Iterator[WatchUpdate]:
        """Refine by one step the payload of the stream with the latest rows, if CPU time is left."""
        if self._preparing:
            self._prepare()
            return
        stream, began = self._next_refined(), time.process_time()
        if stream is None or self._credit() <= 0.0:
            return
        followed = self._streams[stream]
        assert followed.refining is not None
        try:
            next(followed.refining)
        except StopIteration as done:
            followed.refining = None
            followed.watch = followed.watch.refined(done.value)
        except np.linalg.LinAlgError as error:
            followed.refining = None
            logger.warning("could not refine the payload of stream %r of model %s: %s", stream[2], stream[0], error)
        self._left -= time.process_time() - began
        yield from self._report(stream, followed)

    def _next_refined(self) -> Stream | None:
        return next((each for each in reversed(self._streams) if self._streams[each].refining is not None), None)

    def _prepare(self) -> None:
        """Compute one step of the arms that a version's training allows. Refining needs them once for each version."""
        key, steps = next(iter(self._preparing.items()))
        try:
            next(steps)
        except (StopIteration, np.linalg.LinAlgError):
            self._preparing.pop(key)

    def _credit(self) -> float:
        """Return the CPU time that refining may use now, s."""
        now = time.monotonic()
        self._left = min(self._left + REFINING_SHARE * (now - self._counted), REFINING_S)
        self._counted = now
        return self._left

    def _find_stream(self, stream: Stream, given: Sequence[StreamRows]) -> FollowedStream | None:
        """Return the stream; None if it is unknown and the service has not sent its payload."""
        carrier = self._carrier(stream[:2], [each.posterior for each in given])
        known = self._streams.get(stream)
        for each in given:
            if each.watch is not None and (known is None or known.event != each.event):
                known = FollowedStream(carrier, each.watch, each.event, each.received)
        if known is None:
            return None
        known.carrier = carrier
        self._streams[stream] = known
        self._streams.move_to_end(stream)
        if len(self._streams) > MAX_STREAMS:
            self._streams.popitem(last=False)
        return known

    def _carrier(self, key: tuple[str, int], revisions: Sequence[PosteriorUpdate | None]) -> Carrier:
        base = self._versions.get(*key)
        known = self._carriers.get(key)
        revised = next((each for each in reversed(revisions) if each is not None), None)
        if known is None or known[0] is not base or revised is not None:
            model = base
            if revised is not None:
                posterior = replace(base.posterior, weights=revised.weights, root=revised.root)
                model = replace(base, posterior=posterior)
            carrier = Carrier(model)
            self._carriers[key] = base, carrier
            if carrier.is_nonlinear:
                self._preparing.setdefault(key, draw_arms(carrier))
        return self._carriers[key][1]

    def _report(self, stream: Stream, followed: FollowedStream) -> Iterator[WatchUpdate]:
        """Yield the payload of a stream if it differs from the last one sent."""
        if followed.reported is not None and followed.reported.has_same_payload(followed.watch):
            return
        followed.reported = followed.watch
        yield WatchUpdate(stream, followed.watch.outline(), followed.received, followed.event)
