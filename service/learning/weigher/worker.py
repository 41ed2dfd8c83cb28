"""What the weigher process does: it follows streams row by row as they come, and refines what they carry in between."""

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
from lipcore.online.payload.draws import arms
from lipcore.online.payload.held import Held
from lipcore.online.payload.holding import Watch
from lipcore.online.payload.payload import estimate
from service.foundation.settings import Settings
from service.learning.weigher.messages import MOST_STREAMS, Asked, Message, Revised, Stream, Unweighed, Weighed
from service.models import registry
from service.runtime.companion import BEAT, BEAT_S, received
from service.storage.database import Database
from service.storage.files import Files

logger = logging.getLogger(__name__)

REFINING_SHARE, REFINING_S = 0.15, 2.0
"""CPU time that refining may take, s a second, and at most at once: what was just taken up is refined first of all."""


def run(settings: Settings, connection: Connection) -> None:
    """Follow the streams whose rows come over the connection, until it ends or None comes."""
    database, files = Database.of(settings), Files.of(settings)
    weigher = Weigher(Versions(database, files))
    try:
        with suppress(EOFError, BrokenPipeError):  # the service is gone
            beaten = time.monotonic()
            while (work := received(connection, min(weigher.pause(), BEAT_S))) is not None:
                for about, given in work.items():
                    if isinstance(about, tuple) and not given:
                        weigher.expect(about[0], about[1])
                    elif isinstance(about, tuple):
                        for message in weigher.follow(about, given):
                            connection.send(message)
                    else:  # a model that was deleted
                        weigher.forget(str(about))
                for message in weigher.refine():
                    connection.send(message)
                if time.monotonic() - beaten >= BEAT_S:
                    connection.send(BEAT)
                    beaten = time.monotonic()
    finally:
        database.close()


EXPECTED, RATE = 60, 100.0
"""Rows that are made up, and how many a second."""


class Versions:
    """Versions as trained, loaded when they are first asked for. most: that are kept."""

    def __init__(self, database: Database, files: Files, most: int = 8) -> None:
        self._database, self._files, self._most = database, files, most
        self._known: OrderedDict[tuple[str, int], TorqueModel] = OrderedDict()

    def get(self, model: str, version: int) -> TorqueModel:
        """The version; raise NotFoundError or ModelFormatError."""
        key = model, version
        if key not in self._known:
            row = registry.find(self._database, model, version)
            self._known[key] = self._files.load_version(row.folder, row.checksums)
        self._known.move_to_end(key)
        if len(self._known) > self._most:
            self._known.popitem(last=False)
        return self._known[key]

    def forget(self, model: str) -> None:
        """Keep nothing of a model: another one may get its name."""
        for key in [key for key in self._known if key[0] == model]:
            del self._known[key]


@dataclass
class Followed:
    """A stream. watch: what it carries; told: what the service knows of that; refining: under way."""

    carrier: Carrier
    watch: Watch
    said: int
    received: float
    told: Watch | None = None
    refining: Generator[None, None, Held] | None = None


class Weigher:
    """The streams that are followed. versions: gives the version of a model."""

    def __init__(self, versions: Versions) -> None:
        self._versions = versions
        self._streams: OrderedDict[Stream, Followed] = OrderedDict()  # in the order of their last rows
        self._carriers: dict[tuple[str, int], tuple[TorqueModel, Carrier]] = {}
        self._preparing: dict[tuple[str, int], Generator[None, None, object]] = {}
        self._left, self._counted = REFINING_S, time.monotonic()

    def pause(self) -> float:
        """Seconds until there is something to do, if nothing comes."""
        if self._preparing:
            return 0.0
        return np.inf if self._refined_next() is None else max(0.0, -self._credit() / REFINING_SHARE)

    def expect(self, model: str, version: int) -> None:
        """Make ready for streams of a version: load it, and take something up once, so that all is compiled."""
        try:
            carrier = self._carrier((model, version), ())
            limits, n, draw = carrier.model.training_range, carrier.model.n_joints, np.random.default_rng(0).uniform
            q, dq, ddq = (draw(limits[name]["min"], limits[name]["max"], (EXPECTED, n)) for name in ("q", "dq", "ddq"))
            time_ = np.arange(EXPECTED) / RATE
            tau = carrier.model.predict(q, dq, ddq).tau
            Watch(n).step(carrier, Rows(time_, q, dq, ddq, tau, np.zeros(EXPECTED, np.uint8)))
            estimate(carrier, Rows(time_, q, dq, ddq, 1.1 * tau, np.zeros(EXPECTED, np.uint8)).take(slice(0, 10)))
        except Exception:  # its streams show the error again
            logger.exception("version %d of model %s cannot be made ready for payloads", version, model)

    def follow(self, stream: Stream, given: Sequence[Unweighed]) -> Iterator[Message]:
        """Follow rows of a stream, and tell what has become of what it carries."""
        try:
            followed = self._followed(stream, given)
            if followed is None:
                yield Asked(stream)
                return
            rows = Rows.concatenate([each.rows for each in given if each.said == followed.said])
            rows = rows.take(np.argsort(rows.time, kind="stable"))
            followed.watch = followed.watch.step(followed.carrier, rows)
            followed.received = given[-1].received
        except np.linalg.LinAlgError as error:  # of rows that no arm explains
            logger.error("the payload of stream %r of model %s is watched anew: %s", stream[2], stream[0], error)
            self._streams.pop(stream, None)
            return
        except Exception:
            logger.exception("the payload of stream %r of model %s is not followed", stream[2], stream[0])
            self._streams.pop(stream, None)
            return
        if followed.refining is None:
            followed.refining = followed.watch.refinement()
        yield from self._told(stream, followed)

    def forget(self, model: str) -> None:
        """Keep nothing of a model that was deleted."""
        self._versions.forget(model)
        for stream in [each for each in self._streams if each[0] == model]:
            del self._streams[stream]
        for version in [each for each in self._carriers if each[0] == model]:
            del self._carriers[version]
            self._preparing.pop(version, None)

    def refine(self) -> Iterator[Weighed]:
        """Go on with what is refined, one step of the stream that has come last, where there is time for it."""
        if self._preparing:
            self._prepare()
            return
        stream, began = self._refined_next(), time.process_time()
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
            logger.warning("the payload of stream %r of model %s is not refined: %s", stream[2], stream[0], error)
        self._left -= time.process_time() - began
        yield from self._told(stream, followed)

    def _refined_next(self) -> Stream | None:
        return next((each for each in reversed(self._streams) if self._streams[each].refining is not None), None)

    def _prepare(self) -> None:
        """One step of the arms that the training of a version allows, with which refining begins: once a version."""
        key, steps = next(iter(self._preparing.items()))
        try:
            next(steps)
        except (StopIteration, np.linalg.LinAlgError):
            self._preparing.pop(key)

    def _credit(self) -> float:
        """CPU time that refining may take now, s."""
        now = time.monotonic()
        self._left = min(self._left + REFINING_SHARE * (now - self._counted), REFINING_S)
        self._counted = now
        return self._left

    def _followed(self, stream: Stream, given: Sequence[Unweighed]) -> Followed | None:
        """The stream as far as it is known; None where the service does not say what is not known here."""
        carrier = self._carrier(stream[:2], [each.revised for each in given])
        known = self._streams.get(stream)
        for each in given:
            if each.known is not None and (known is None or known.said != each.said):
                known = Followed(carrier, each.known, each.said, each.received)
        if known is None:
            return None
        known.carrier = carrier
        self._streams[stream] = known
        self._streams.move_to_end(stream)
        if len(self._streams) > MOST_STREAMS:
            self._streams.popitem(last=False)
        return known

    def _carrier(self, key: tuple[str, int], revisions: Sequence[Revised | None]) -> Carrier:
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
            if carrier.bends:
                self._preparing.setdefault(key, arms(carrier))
        return self._carriers[key][1]

    def _told(self, stream: Stream, followed: Followed) -> Iterator[Weighed]:
        """Tell what the stream carries where the service does not know."""
        if followed.told is not None and followed.told.says(followed.watch):
            return
        followed.told = followed.watch
        yield Weighed(stream, followed.watch.outline(), followed.received, followed.said)
