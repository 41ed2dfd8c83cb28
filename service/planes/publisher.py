"""Publishes what answers to the data plane, from the control plane."""

from __future__ import annotations

import logging
import threading
from dataclasses import dataclass, field, replace
from typing import Any

from fastapi import FastAPI

from lipcore.online.transfer import Revision
from service.api.access.keys import list_keys
from service.models import registry
from service.models.loaded import LoadedModels
from service.models.served import Key
from service.planes.channel import Channel
from service.planes.publications import NewRevision, Pointers, StreamState, Version
from service.storage.database import ApiKeyRow

logger = logging.getLogger(__name__)
PUBLISH_S = 0.02
"""Seconds between two looks for changes. The real one is woken by them."""


@dataclass
class Sent:
    """What a data plane has been sent."""

    revisions: dict[Key, int] = field(default_factory=dict)
    factors: dict[Key, object] = field(default_factory=dict)
    payloads: dict[Key, object] = field(default_factory=dict)
    pointers: Pointers | None = None
    keys: object = None


class Publisher:
    """Sends what answers to one data plane, in a thread, until that is gone."""

    def __init__(self, app: FastAPI, channel: Channel) -> None:
        self.app, self.channel = app, channel

    def start(self) -> None:
        """Begin to publish."""
        threading.Thread(target=self._run, daemon=True, name="publisher").start()

    def _run(self) -> None:
        """Send changes until the data plane is gone."""
        sent, woken = Sent(), threading.Event()
        try:
            while self._send_changes(self.channel, sent):
                woken.wait(PUBLISH_S)
        except Exception:
            logger.exception("could not publish to the data plane")
            self.channel.close()

    def _send_changes(self, channel: Channel, sent: Sent) -> bool:
        loaded: LoadedModels = self.app.state.loaded
        snapshot, alive = loaded._snapshot, True
        for key, served in snapshot.served.items():
            if key not in sent.revisions:
                row = registry.find(loaded.database, *key)
                alive &= channel.send(Version(key, row.folder, row.checksums or {}, served.base.scale))
                sent.revisions[key] = 0
            if served.revision > sent.revisions[key]:
                alive &= channel.send(NewRevision(key, served.revision, Revision.of(served.model)))
                sent.revisions[key] = served.revision
            factors, payloads = served.scales._streams, served.payloads._streams
            if sent.factors.get(key) is not factors or sent.payloads.get(key) is not payloads:
                sent.factors[key], sent.payloads[key] = factors, payloads
                alive &= channel.send(StreamState(key, dict(factors), _without_models(served.payloads)))
        serving = {model: each.version for model, each in snapshot.serving.items()}
        dropped = frozenset(sent.revisions.keys() - snapshot.served.keys())
        pointers = Pointers(serving, dict(snapshot.aliases), dropped, frozenset(loaded._deleted))
        if pointers != sent.pointers:
            alive &= channel.send(pointers)
            sent.pointers = pointers
            for key in dropped:
                del sent.revisions[key]
        if self.app.state.storage.settings.keys_needed:
            rows = list_keys(loaded.database)  # the real one: what the keyring has read, once a second
            told = [(row.id, row.revoked_at, row.expires_at, row.scopes) for row in rows]
            if told != sent.keys:
                alive &= channel.send(("keys", [_plain(row) for row in rows]))
                sent.keys = told
        if sent.keys is None and alive:
            alive = channel.send(("published",))
            sent.keys = sent.keys or ()
        return alive


def _plain(row: ApiKeyRow) -> ApiKeyRow:
    names = [column.name for column in ApiKeyRow.__table__.columns]
    return ApiKeyRow(**{name: getattr(row, name) for name in names})


def _without_models(payloads: Any) -> dict[str, Any]:
    streams = dict(payloads._streams)
    if payloads._default is not None:
        streams[""] = payloads._default
    return {name: (each.load, replace(each, model=None, load=None)) for name, each in streams.items()}
