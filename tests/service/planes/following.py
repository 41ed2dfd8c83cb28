"""A control plane's models and a data plane that follows them over a real channel, in one process."""

from __future__ import annotations

import itertools
import socket
import threading
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import lipcore
from lipcore import TorqueModel
from lipcore.kernels.drive.play import ELEMENTS
from lipcore.model.body import Body
from lipcore.model.payload import Carrier
from lipcore.online.transfer import Revision
from service.learning.learner.learnt import LearntVersions
from service.models import registry
from service.models.loaded import LoadedModels
from service.models.loads import StreamPayload
from service.models.scales import Factor
from service.models.served import Key, ServedModel
from service.planes.confirmations import Confirmations
from service.planes.publications import Holdings, Published
from service.planes.published import PublishedModels
from service.planes.publisher import Publisher
from service.runtime.channel import Channel, share
from service.storage.files import Files
from tests.lipcore.export.models import MODELS, PANDA
from tests.service.data import eventually
from tests.service.learning.pendulums import Arm, trained_model

KINDS: dict[str, Callable[[], TorqueModel]] = {
    "panda": lambda: lipcore.load(PANDA),
    "chain": trained_model,
    "local": MODELS["local"],
    "braked": MODELS["friction of all kinds, alternatives"],
    "arms": MODELS["two arms"],
}
"""Models by name: a rigid body, one without bodies, a local correction, friction with memory, two arms."""
STREAMS = ("", "a", "b", "c", "d")
"""Streams; the empty name is the default for all others."""


@cache
def trained(name: str) -> TorqueModel:
    """Return the model of a name; always the same object."""
    return KINDS[name]()


def revised(model: TorqueModel, seed: int) -> Revision:
    """Return the arrays of a model that has learnt something."""
    rng, posterior = np.random.default_rng(seed), model.posterior
    weights = posterior.weights * rng.uniform(0.8, 1.2, posterior.weights.shape)
    floor = rng.uniform(0.0, 0.1, model.n_joints)
    changed = replace(posterior, weights=weights, root=posterior.root * 0.9, floor=floor, statistics=None)
    return Revision.of(replace(model, posterior=changed))


def with_payload(model: TorqueModel, mass: float) -> TorqueModel:
    """Return the model with a payload."""
    carrier = Carrier(model)
    return carrier.with_payload(carrier.known(Body(mass, np.array([0.0, 0.02, 0.1]), None).parameters))


def random_factors(rng: np.random.Generator, n: int) -> dict[str, Factor]:
    """Return width factors of some streams."""
    names = [name for name in STREAMS if name and rng.random() < 0.6]
    return {
        name: Factor(
            rng.uniform(1, 3, n), rng.uniform(1, 3, n), 1000.0 + float(rng.integers(0, 100)), rng.random() < 0.2
        )
        for name in names
    }


def random_payloads(rng: np.random.Generator, models: list[TorqueModel]) -> dict[str, StreamPayload]:
    """Return payloads of some streams, with these models."""
    found = {}
    for name in STREAMS:
        model = models[rng.integers(len(models))] if models and rng.random() < 0.5 else None
        if rng.random() < 0.6:
            received = 1000.0 + float(rng.integers(0, 100))
            found[name] = StreamPayload(model, None if model is None else (float(rng.random()), 0.1), received)
    return found


class Planes:
    """The home, the control plane's loaded models, and what the data plane has been told."""

    def __init__(self, home: Path, monkeypatch: Any, capacity: int = 8) -> None:
        # versions are those of KINDS: files cannot hold all of them
        monkeypatch.setattr(Files, "load_version", lambda _, folder, checksums: trained(folder.split("_")[1]))
        self.arm, self.capacity = Arm.open(home), capacity
        self.published = PublishedModels(self.arm.settings, self._send)
        self.channel: Channel | None = None
        self.published.begin_answering()
        self.messages: list[Any] = []
        self.failure: Exception | None = None
        self._folders = itertools.count(1)
        self._threads: list[threading.Thread] = []
        self.start_control()

    def start_control(self) -> None:
        """Start a control plane, with the aliases of the database and no version, and connect the data plane."""
        storage = self.arm.storage
        self.loaded = LoadedModels(storage, LearntVersions(storage.database, storage.files), self.capacity, share)
        self.confirmations = Confirmations()
        self.confirmations.watch(self.loaded.changes)
        self.publisher = Publisher(self.loaded, None, self.confirmations)
        self.publisher.start()
        self.connect()

    def connect(self) -> None:
        """Connect the data plane to the control plane."""
        before = len(self.messages)
        ours, theirs = (Channel(each) for each in socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET))
        self.channel, self.control_end = theirs, ours
        for target in (self._receive_in_control, self._receive_in_data):
            thread = threading.Thread(target=target, args=(ours, theirs, self.publisher), daemon=True)
            self._threads.append(thread)
            thread.start()
        eventually(lambda: any(isinstance(each, Published) for each in self.messages[before:]))

    def _receive_in_control(self, ours: Channel, _: Channel, publisher: Publisher) -> None:
        while (received := ours.receive()) is not None:
            message = received[0]
            if isinstance(message, Holdings):
                publisher.subscribe(ours, message)
            else:
                publisher.receive(ours, message)
        publisher.unsubscribe(ours)

    def _receive_in_data(self, _: Channel, theirs: Channel, __: Publisher) -> None:
        try:
            theirs.send(self.published.start_connection())
            while (received := theirs.receive()) is not None:
                self.published.apply(received[0])
                self.messages.append(received[0])
        except Exception as error:
            self.failure = error

    def _send(self, message: Any) -> bool:
        return self.channel is not None and self.channel.send(message, wait=False)

    def disconnect(self) -> None:
        """End the connection, as the end of either process does."""
        assert self.channel is not None
        channel, self.channel = self.channel, None
        channel.close()
        self.control_end.close()
        for thread in self._threads:
            thread.join()
        self._threads.clear()

    def restart_control(self) -> None:
        """Kill the control plane, and start another one."""
        self.disconnect()
        self.publisher.close()
        self.start_control()

    def publish(self, model: str) -> int:
        """Add a version to the home, which serves from then on; return its number."""
        folder = f"mv_{model}_{next(self._folders)}"
        with self.arm.files.new_version(folder) as target:
            manifest = lipcore.save(trained_model(), target)
        with self.arm.database.transaction() as session:
            return registry.publish(session, model, folder, manifest, None)

    def synchronise(self) -> None:
        """Wait until the data plane has confirmed all changes."""
        self.loaded.changes.note()
        eventually(lambda: self.failure is not None or not self.confirmations.are_missing)
        if self.failure is not None:
            raise self.failure

    def close(self) -> None:
        """End both planes."""
        self.disconnect()
        self.publisher.close()
        self.arm.database.close()


def assert_same_answers(found: ServedModel, expected: ServedModel, seed: int) -> None:
    """Assert that a version answers equally in both planes, alone and for each stream."""
    assert (found.name, found.version, found.revision) == (expected.name, expected.version, expected.revision)
    rng, n = np.random.default_rng(seed), expected.model.n_joints
    assert found.scales.default_factors == expected.scales.default_factors
    motion = rng.normal(size=(3, n))
    if expected.model.remembers:
        motion = np.concatenate([motion, rng.uniform(0, 1, (2 * len(ELEMENTS), n))])
    for name in (None, *STREAMS[1:], "unknown"):
        np.testing.assert_array_equal(found.scales.of(name), expected.scales.of(name))
        assert found.payloads.mass(name) == expected.payloads.mass(name)
        assert (found.payloads.model_for(name) is None) == (expected.payloads.model_for(name) is None)
        ours, theirs = found.model_for(name), expected.model_for(name)
        for one, other in ((ours, theirs), (ours.fast, theirs.fast)):
            for mine, its in zip(
                one.answer_fully(motion, True, True), other.answer_fully(motion, True, True), strict=True
            ):
                assert (mine is None) == (its is None)
                if isinstance(mine, np.ndarray):
                    np.testing.assert_allclose(mine, its, rtol=0, atol=1e-12 * max(1.0, float(np.abs(its).max())))
    assert found.noise_std == expected.noise_std
    assert found.guaranteed == expected.guaranteed
    np.testing.assert_array_equal(found.model.position_limits(7.0), expected.model.position_limits(7.0))


def held(planes: Planes) -> set[Key]:
    """Return the versions in the data plane's memory."""
    return set(planes.published.versions())
