"""The data plane answers as the control plane does, after any sequence of publications."""

import gc
import os
import threading

import numpy as np
import pytest

from lipcore import TorqueModel
from lipcore.online.transfer import Revision
from service.foundation.errors import NotFoundError, NotReadyError
from service.models import aliases, deletion
from service.models.loads import StreamPayload
from service.models.scales import Factor
from service.planes.publications import (
    Confirmed,
    NewPayload,
    NewRevision,
    NewVersion,
    Pointers,
    Published,
    StreamStates,
)
from service.planes.subscriber import MAX_UNCONFIRMED
from service.runtime.channel import Package
from tests.choosing import slow
from tests.service.data import eventually
from tests.service.planes.following import (
    KINDS,
    Planes,
    assert_same_answers,
    held,
    random_factors,
    random_payloads,
    revised,
    trained,
    with_payload,
)


@pytest.fixture
def planes(tmp_path, monkeypatch):
    """Both planes, with version 1 of every model in the home and none in memory."""
    found = Planes(tmp_path / "home", monkeypatch)
    for name in KINDS:
        assert found.publish(name) == 1
    yield found
    found.close()


def assert_same(planes, seed=0):
    """Assert that both planes answer equally with all versions and aliases."""
    snapshot, published = planes.loaded.snapshot, planes.published
    for key, expected in snapshot.served.items():
        assert_same_answers(published.hot(*key), expected, seed)
    for model in KINDS:
        if model in snapshot.serving:
            assert published.newest(model) == planes.loaded.newest(model)
        for alias in ("first", "second"):
            assert published.newest(model, alias) == planes.loaded.newest(model, alias)
        for version in range(1, 6):
            # the data plane also knows what an earlier control plane has deleted
            assert published.is_deleted(model, version) >= planes.loaded.is_deleted(model, version)


class Operations:
    """Random operations on the control plane; `models` are those that were not deleted."""

    def __init__(self, planes, seed):
        self.planes, self.rng, self.models = planes, np.random.default_rng(seed), list(KINDS)
        self.revisions, self.deleted = {}, set()

    def pick(self, values):
        """Return one of several values."""
        return values[self.rng.integers(len(values))]

    def served(self):
        """Return a version that is in memory, or is now."""
        known = list(self.planes.loaded.snapshot.served.values())
        return self.pick(known) if known else self.planes.loaded.get(self.pick(self.models), None)

    def load(self):
        self.planes.loaded.get(self.pick(self.models), None)

    def revise(self):
        served = self.served()
        key = served.name, served.version
        number = served.revision + int(self.rng.integers(1, 4))
        self.revisions[key] = number, revised(served.base, number)
        self.planes.loaded.revise(*key, *self.revisions[key])

    def adapt_widths(self):
        served = self.served()
        served.scales.replace(random_factors(self.rng, served.model.n_joints))

    def change_payloads(self):
        served = self.served()
        if served.model.arms == 1:
            known = [each.model for each in served.payloads.streams().values() if each.model is not None]
            more = [with_payload(served.model, float(self.rng.uniform(0.5, 2.0)))]
            served.payloads.replace(random_payloads(self.rng, [*known[:2], *more]))

    def add_version(self):
        model = self.pick(self.models)
        self.planes.publish(model)
        self.planes.loaded.changed(model)

    def move_alias(self):
        served, alias = self.served(), self.pick(["first", "second"])
        version = self.pick([None, served.version])
        with self.planes.arm.database.transaction() as session:
            aliases.point(session, served.name, alias, version)
        self.planes.loaded.point(served.name, alias, version)

    def delete(self):
        served = self.served()
        if served.name == "panda":
            return  # so that some model is left
        deletion.delete_model(self.planes.loaded, served.name)
        self.models.remove(served.name)

    def restart(self):
        before = {key: self.planes.published.hot(*key) for key in held(self.planes)}
        self.planes.messages.clear()
        self.planes.restart_control()
        for key, revision in self.revisions.items():  # the learner has a log
            self.planes.loaded.revise(*key, *revision)
        for key, served in before.items():  # no gap: a new control plane takes nothing away
            assert self.planes.published.hot(*key) is served or planes_deleted(self.planes, key)
        complete(self.planes)

    def reconnect(self):
        self.planes.messages.clear()
        self.planes.disconnect()
        self.planes.connect()
        complete(self.planes)


def planes_deleted(planes, key):
    """Return whether a version was deleted."""
    return planes.published.is_deleted(*key)


def complete(planes):
    """Wait until the control plane has loaded what the data plane held."""
    eventually(lambda: any(isinstance(each, Pointers) and each.kept is not None for each in planes.messages))


NAMES = [name for name in vars(Operations) if not name.startswith("_") and name not in ("pick", "served")]


@pytest.mark.parametrize("seed", [0, slow(1), slow(2), slow(3), slow(4)])
def test_planes_agree_after_every_operation(planes, seed):
    operations = Operations(planes, seed)
    order = [name for name in NAMES for _ in range(2 if name in ("delete", "restart") else 4)]
    operations.rng.shuffle(order)
    for step, name in enumerate(order):
        getattr(operations, name)()
        planes.synchronise()
        assert_same(planes, step)
        assert len(planes.loaded.snapshot.served) <= planes.capacity
        assert held(planes) == set(planes.loaded.snapshot.served)


def test_arrays_of_versions_and_revisions_are_passed_on_without_a_copy(planes):
    """They are in memory once: the control plane answers with the pages that the data plane maps."""
    base = planes.loaded.get("panda", None).base
    planes.loaded.revise("panda", 1, 7, revised(base, 0))
    served = planes.loaded.hot("panda", 1)
    messages = {
        "version": NewVersion(("panda", 1), base),
        "revision": NewRevision(("panda", 1), 7, Revision.of(served.model)),
    }
    arrays = served.model.posterior.root.nbytes + served.model.evaluator.packed.nbytes
    for name, message in messages.items():
        package = Package.of(message)
        assert package.size < 0.2 * arrays, name
        package.close()
    planes.synchronise()
    assert planes.published.hot("panda", 1).revision == 7
    assert_same(planes)


def test_only_what_changed_is_sent(planes):
    served = planes.loaded.get("panda", None)
    factor, model = Factor(np.full(7, 1.5), np.full(7, 1.2), 10.0), with_payload(served.model, 1.0)
    served.scales.replace({"a": factor, "b": factor})
    served.payloads.replace({"a": StreamPayload(model, (1.0, 0.1), 9.0), "b": StreamPayload(model, (1.0, 0.1), 9.0)})
    planes.synchronise()
    planes.messages.clear()
    planes.synchronise()
    assert {type(each) for each in planes.messages} == {Published}
    # equal factors in other arrays, as each batch makes them
    again = Factor(factor.values.copy(), factor.others.copy(), 10.0)
    served.scales.replace({"a": again, "c": factor})
    served.payloads.replace({"a": StreamPayload(model, (1.0, 0.1), 11.0), "c": StreamPayload(None, None, 1.0)})
    planes.synchronise()
    (state,) = [each for each in planes.messages if isinstance(each, StreamStates)]
    assert (set(state.factors), set(state.payloads)) == ({"c"}, {"a", "c"})
    assert (state.without_factors, state.without_payloads) == (("b",), ("b",))
    assert not any(isinstance(each, NewPayload | NewVersion) for each in planes.messages)
    assert_same(planes)


def test_payload_models_that_no_stream_has_are_freed(planes):
    served = planes.loaded.get("panda", None)
    for mass in (1.0, 2.0, 3.0):
        served.payloads.replace({"a": StreamPayload(with_payload(served.model, mass), (mass, 0.1), mass)})
        planes.synchronise()
    found = planes.published.hot("panda", 1)
    assert found.payloads.mass("a") == (3.0, 0.1)
    planes.messages.clear()
    gc.collect()
    panda = served.model.joint_names
    models = [each for each in gc.get_objects() if type(each) is TorqueModel and each.joint_names == panda]
    with_payloads = [each for each in models if "payload" in each.estimator.terms]
    assert len(with_payloads) == 2  # one in each plane


def test_version_that_streams_keep_goes_on_learning(planes):
    """The data plane's stream has the version; the control plane has dropped it."""
    planes.loaded.capacity = 1
    planes.loaded.get("panda", None)
    planes.synchronise()
    stream = planes.published.hot("panda", None)
    planes.loaded.get("chain", None)
    planes.synchronise()
    assert planes.published.hot("panda", None) is None
    assert planes.published.newest("panda") == 1
    gc.collect()
    planes.published.report_use()
    assert planes.loaded.revise("panda", 1, 4, revised(trained("panda"), 4))
    planes.synchronise()
    found = planes.published.hot("panda", None)
    assert (found.revision, found.scales) == (4, stream.scales)
    assert_same_answers(found, planes.loaded.hot("panda", None), 0)
    planes.loaded.get("chain", None)
    planes.synchronise()
    del stream, found
    gc.collect()
    planes.published.report_use()  # no stream has it any more
    eventually(lambda: gc.collect() >= 0 and ("panda", 1) not in planes.loaded._held)


def test_versions_used_in_the_data_plane_are_dropped_last(planes):
    planes.loaded.capacity = 2
    for name in ("panda", "chain"):
        planes.loaded.get(name, None)
    planes.synchronise()
    assert planes.published.hot("panda", None) is not None
    planes.published.report_use()
    eventually(lambda: planes.loaded._used["panda", 1] > planes.loaded._used["chain", 1])
    planes.loaded.get("arms", None)
    planes.synchronise()
    assert held(planes) == {("panda", 1), ("arms", 1)}


def test_new_control_plane_drops_what_it_does_not_need(planes):
    for name in ("panda", "chain", "arms"):
        planes.loaded.get(name, None)
    planes.synchronise()
    planes.capacity = 2
    planes.messages.clear()
    planes.restart_control()
    complete(planes)
    planes.synchronise()
    assert held(planes) == set(planes.loaded.snapshot.served)
    assert len(held(planes)) == 2


def test_versions_deleted_while_the_control_plane_was_gone_are_dropped(planes):
    for name in ("panda", "chain"):
        planes.loaded.get(name, None)
    planes.synchronise()
    planes.messages.clear()
    planes.disconnect()
    deletion.delete_model(planes.loaded, "chain")
    planes.publisher.close()
    planes.start_control()
    complete(planes)
    planes.synchronise()
    assert held(planes) == {("panda", 1)}
    assert planes.published.is_deleted("chain", 1)
    assert planes.published.newest("chain") is None
    with pytest.raises(NotFoundError):
        planes.loaded.get("chain", None)


def test_missing_versions_are_requested(planes):
    assert planes.published.hot("panda", None) is None
    found = planes.published.get("panda", None)
    assert_same_answers(found, planes.loaded.hot("panda", None), 1)
    assert planes.published.get("chain", 1).name == "chain"
    for unknown in (("nobody", None, None), ("panda", 9, None), ("panda", None, "none")):
        with pytest.raises(NotReadyError, match="is not loaded"):  # at once: the control plane has refused it
            planes.published.get(*unknown)
    planes.disconnect()
    with pytest.raises(NotReadyError):
        planes.published.get("arms", None)
    assert planes.published.get("panda", None) is found
    planes.connect()


def test_many_queries_for_a_version_request_it_once(planes):
    results = []
    threads = [threading.Thread(target=lambda: results.append(planes.published.get("arms", None))) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(set(map(id, results))) == 1


def test_slow_data_plane_gets_changes_together(planes, monkeypatch):
    served = planes.loaded.get("panda", None)
    planes.synchronise()
    go, apply = threading.Event(), planes.published.apply

    def apply_later(message):
        go.wait()
        apply(message)

    monkeypatch.setattr(planes.published, "apply", apply_later)
    planes.messages.clear()
    for number in range(1, 101):
        planes.loaded.revise("panda", 1, number, revised(served.base, number))
        planes.publisher.publish()
    go.set()
    planes.synchronise()
    assert planes.published.hot("panda", 1).revision == 100
    assert sum(isinstance(each, NewRevision) for each in planes.messages) <= MAX_UNCONFIRMED + 2


def test_descriptors_do_not_leak(planes):
    planes.loaded.get("local", None)
    planes.synchronise()
    for number in range(1, 30):
        planes.loaded.revise("local", 1, number, revised(trained("local"), number))
        planes.synchronise()
        if number == 1:  # the control plane keeps the file of the present revision
            before = len(os.listdir("/proc/self/fd"))
    assert len(os.listdir("/proc/self/fd")) == before
    for _ in range(3):
        planes.disconnect()
        planes.connect()
        planes.synchronise()
    assert len(os.listdir("/proc/self/fd")) <= before + 2


def test_failed_publication_ends_the_connection_alone(planes, monkeypatch, caplog):
    served = planes.loaded.get("panda", None)
    planes.synchronise()
    learnt = revised(served.base, 3)
    monkeypatch.setattr("service.planes.subscriber.Revision.of", lambda _: 1 / 0)
    planes.loaded.revise("panda", 1, 3, learnt)
    eventually(lambda: "could not publish" in caplog.text)
    monkeypatch.undo()
    assert planes.published.hot("panda", None).revision == 0
    planes.disconnect()
    planes.connect()
    planes.synchronise()
    assert planes.published.hot("panda", None).revision == 3


def test_confirmations_follow_publications(planes):
    planes.loaded.get("panda", None)
    planes.synchronise()
    sent = []
    planes.published._send, send = sent.append, planes.published._send
    planes.loaded.point("panda", "first", 1)
    eventually(lambda: planes.published.newest("panda", "first") == 1)
    assert planes.confirmations.are_missing
    eventually(lambda: sent)
    for message in sent:
        assert isinstance(message, Confirmed)
        send(message)
    eventually(lambda: not planes.confirmations.are_missing)
    planes.published._send = send
