"""Publishes what answers to the data planes, from the control plane."""

from __future__ import annotations

import logging
import threading
from contextlib import ExitStack
from math import inf
from typing import Any

from service.api.access.keys import Keyring
from service.foundation.errors import NotFoundError, ServiceError
from service.models.loaded import LoadedModels
from service.planes.confirmations import Confirmations
from service.planes.publications import (
    Answering,
    Confirmed,
    Holdings,
    KeysRead,
    LoadRequest,
    NewPayload,
    NewRevision,
    NewVersion,
    NotLoaded,
    Published,
    VersionUse,
)
from service.planes.stream_states import PayloadNumbers
from service.planes.subscriber import Subscriber
from service.runtime.channel import Channel, Package

logger = logging.getLogger(__name__)
PATIENCE_S = 2.0
"""Max seconds that a message waits for room in a socket. A data plane that takes longer has to connect again."""


class Publisher:
    """Tells all data planes what answers. A thread does so after each change; safe to share between threads.

    confirmations: receives the numbers of the publications that the data plane which answers has applied.
    """

    def __init__(self, loaded: LoadedModels, keyring: Keyring | None, confirmations: Confirmations) -> None:
        self._loaded, self._keyring, self._confirmations = loaded, keyring, confirmations
        self._subscribers: dict[Channel, Subscriber] = {}
        self._numbers = PayloadNumbers()
        self._lock, self._closed = threading.Lock(), False
        if keyring is not None:
            keyring.when_changed.append(loaded.changes.note)

    def start(self) -> None:
        """Begin to publish."""
        threading.Thread(target=self._run, daemon=True, name="publisher").start()

    def close(self) -> None:
        """Stop publishing."""
        self._closed = True
        self._loaded.changes.note()

    def _run(self) -> None:
        published = -1
        while not self._closed:
            self._loaded.changes.wait(published)
            published = self.publish()

    def publish(self) -> int:
        """Send every data plane what it lacks; return the number of changes that they now know."""
        with self._lock:
            number = self._loaded.changes.number  # read first: what changes from here on is published again
            with ExitStack() as closing:
                packages = dict[Any, Package]()
                for subscriber in tuple(self._subscribers.values()):
                    if not subscriber.can_follow(number):
                        continue
                    try:
                        sent = self._send_changes(subscriber, number, packages, closing)
                    except Exception:
                        logger.exception("could not publish to a data plane")
                        sent = False
                    if not sent:
                        self._subscribers.pop(subscriber.channel)
                        subscriber.channel.close()
                self._report()
            self._numbers.keep(self._loaded.snapshot.served.values())
        return number

    def _send_changes(
        self, subscriber: Subscriber, number: int, packages: dict[Any, Package], closing: ExitStack
    ) -> bool:
        """Send a data plane what it lacks; return whether it can be reached. packages: of large messages, for all."""
        channel, is_complete = subscriber.channel, subscriber.is_complete  # before the snapshot, which has all then
        for message in subscriber.changes(self._loaded.snapshot, self._numbers, number, is_complete):
            if (name := _name_of(message)) is None:
                sent = channel.send(message)
            else:
                if name not in packages:
                    packages[name] = Package.of(message)
                    closing.callback(packages[name].close)
                sent = channel.send(packages[name])
            if not sent:
                return False
        if self._keyring is not None and subscriber.keys is not (keys := self._keyring.records):
            subscriber.keys = keys
            channel.send(KeysRead(keys))
        subscriber.note_published(number)
        return channel.send(Published(number))

    def subscribe(self, channel: Channel, holdings: Holdings) -> None:
        """Publish to a data plane from now on, and load what it answers with, in a thread."""
        subscriber = Subscriber(channel, holdings)
        channel.limit_wait(PATIENCE_S)
        with self._lock:
            self._subscribers[channel] = subscriber
            self._report()
        self._loaded.changes.note()
        if not subscriber.is_complete:
            threading.Thread(target=self._complete, args=(subscriber, holdings), daemon=True).start()

    def unsubscribe(self, channel: Channel) -> None:
        """Stop publishing to a data plane that is gone."""
        with self._lock:
            self._subscribers.pop(channel, None)
            self._report()

    def receive(self, channel: Channel, message: Answering | Confirmed | LoadRequest | VersionUse) -> None:
        """Act on a message of a data plane; load a version in a thread."""
        subscriber = self._subscribers.get(channel)
        match message:
            case LoadRequest():
                threading.Thread(target=self._load, args=(channel, message), daemon=True).start()
            case _ if subscriber is None:
                pass
            case Confirmed(number):
                subscriber.confirm(number)
                self._report()
                if subscriber.lags(self._loaded.changes.number):
                    self._loaded.changes.note()  # it had to wait
            case Answering():
                subscriber.answers = True
                self._report()
            case VersionUse(used):
                self._loaded.note_use(used)
                subscriber.release(message)

    def _load(self, channel: Channel, request: LoadRequest) -> None:
        try:
            self._loaded.get(request.model, request.version, request.alias)
        except ServiceError:
            channel.send(NotLoaded(request))

    def _complete(self, subscriber: Subscriber, holdings: Holdings) -> None:
        """Load what a data plane held when this process was started."""
        for model in {model for model, _ in holdings.revisions}:
            self._can_load(model, None)  # the serving version
        subscriber.complete({key: self._can_load(*key) for key in holdings.revisions})
        self._loaded.changes.note()

    def _can_load(self, model: str, version: int | None) -> bool | None:
        """Load a version; return whether that is possible, None if it does not exist."""
        try:
            self._loaded.get(model, version)
        except NotFoundError:
            return None
        except ServiceError as error:
            logger.error("%s", error.message)
            return False
        return True

    def _report(self) -> None:
        confirmed = [each.confirmed for each in tuple(self._subscribers.values()) if each.answers]
        self._confirmations.confirm(max(confirmed, default=inf))


def _name_of(message: Any) -> Any:
    """Return what identifies a large message, so that it is pickled once for all data planes; None for a small one."""
    match message:
        case NewVersion(key):
            return "version", key
        case NewRevision(key, revision):
            return "revision", key, revision
        case NewPayload(_, number):
            return "payload", number
    return None
