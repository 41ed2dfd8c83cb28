"""What has been learnt reaches answers: through files, by one assignment, whole, and never backwards."""

from __future__ import annotations

import gc
import threading
import weakref

import numpy as np
import pytest

from lipcore.online.batch import Rows
from lipcore.online.learner import OnlineModel
from lipcore.online.transfer import Revision
from service.learning.learner import learnt, publication
from service.learning.learner.learnt import LearntVersions
from service.learning.learner.publication import Published
from service.models.loaded import LoadedModels
from service.storage.files import Files
from tests.service.learning.pendulums import ARM, QUERIES, adopt, at_once, differ, predicted, rows, same, trained


@pytest.fixture
def loaded(arm):
    """What a service has in memory: the model as trained."""
    found = LoadedModels(arm.storage, LearntVersions(arm.database, arm.files), capacity=2)
    found.get(ARM, None)
    return found


def revision(batches, floor=None):
    """The arrays of the trained model after some batches."""
    online = OnlineModel.start(trained(), None, 0.0)
    if batches:
        online = online.learn(Rows.concatenate([rows(number) for number in range(batches)]))
    return Revision.of(online.model(floor))


def published(arm, batches, number=None, **fields):
    """The message of the learner that goes with them."""
    path = publication.write(publication.clear(arm.files), revision(batches))
    number = batches if number is None else number
    usual = {"model": ARM, "version": 1, "revision": number, "number": number, "path": path, "samples": 10.0 * batches}
    return Published(**usual | {"novel_rows": 0, "novel_share": 0.0, "seconds": 0.1, "at": 0.0} | fields)


# files


def test_arrays_come_back_as_they_were_and_their_files_are_gone(arm):
    written = revision(3, floor=np.array([0.5, 0.0]))
    path = publication.write(publication.clear(arm.files), written)
    found = publication.read(path)
    assert not path.exists()
    for name in publication.NAMES:
        np.testing.assert_array_equal(getattr(found, name), getattr(written, name))
    assert found.floor[0] == 0.5


def test_what_nobody_has_read_is_removed_at_the_next_start(arm):
    folder = publication.clear(arm.files)
    publication.write(folder, revision(1))
    assert publication.clear(arm.files) == folder
    assert list(folder.iterdir()) == []


def test_arrays_that_are_gone_are_said_to_be(arm, loaded):
    message = published(arm, 3)
    publication.clear(arm.files)
    with pytest.raises(FileNotFoundError):
        adopt(loaded, message)
    assert loaded.hot(ARM, None).revision == 0


# answers


def test_a_revision_is_answered_with_from_then_on(arm, loaded):
    before = loaded.hot(ARM, None)
    assert adopt(loaded, published(arm, 3))
    after = loaded.hot(ARM, None)
    assert (before.revision, after.revision, after.version) == (0, 3, 1)
    same(after.model, at_once(range(3)))
    same(before.model, at_once())
    assert differ(at_once(range(3)), at_once())
    assert loaded.hot(ARM, 1) is after
    assert after.base is before.base
    single = [after.model.answer(np.ascontiguousarray(QUERIES[:, row])) for row in range(QUERIES.shape[1])]
    np.testing.assert_allclose([tau for tau, _ in single], at_once(range(3))[0], rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose([std for _, std in single], at_once(range(3))[1], rtol=1e-8, atol=1e-8)


def test_only_higher_revisions_are_adopted(arm, loaded):
    assert adopt(loaded, published(arm, 3))
    known = loaded.hot(ARM, None)
    for number in (2, 3):
        assert not adopt(loaded, published(arm, 5, number=number))
        assert loaded.hot(ARM, None) is known
    assert adopt(loaded, published(arm, 1, number=4))  # after a rollback
    same(loaded.hot(ARM, None).model, at_once(range(1)))
    assert loaded.hot(ARM, None).revision == 4


def test_a_revision_is_the_business_of_its_version_alone(arm, loaded):
    arm.publish(candidate=True)
    loaded.get(ARM, 2)
    adopt(loaded, published(arm, 3, version=2))
    assert [loaded.hot(ARM, version).revision for version in (1, 2)] == [0, 3]
    assert loaded.hot(ARM, None).version == 1


def test_a_revision_of_other_arrays_is_refused(arm, loaded):
    wrong = Revision(np.zeros(3), np.zeros((3, 3)), np.zeros(9), np.zeros(2))
    with pytest.raises(ValueError, match="weights has shape"):
        loaded.revise(ARM, 1, 5, wrong)
    assert loaded.hot(ARM, None).revision == 0


def test_a_version_dropped_from_memory_has_what_it_had_learnt_when_it_is_loaded_again(arm, loaded):
    adopt(loaded, published(arm, 3))
    drop(arm, loaded)
    again = loaded.get(ARM, None)
    assert again.revision == 3
    same(again.model, at_once(range(3)))
    adopt(loaded, published(arm, 5))
    same(loaded.hot(ARM, None).model, at_once(range(5)))


def test_what_is_learnt_while_a_version_is_not_in_memory_is_there_when_it_is(arm, loaded):
    drop(arm, loaded)
    assert not adopt(loaded, published(arm, 4))
    assert loaded.hot(ARM, None) is None
    again = loaded.get(ARM, None)
    assert again.revision == 4
    same(again.model, at_once(range(4)))


def test_a_version_dropped_from_memory_that_a_stream_holds_learns_on(arm, loaded):
    held = loaded.get(ARM, None)
    drop(arm, loaded)
    assert adopt(loaded, published(arm, 4))
    assert loaded.hot(ARM, None).revision == 4
    assert loaded.hot(ARM, None).base is held.base
    assert len(loaded._snapshot.served) == loaded.capacity


def test_what_is_learnt_while_a_version_is_being_loaded_is_not_lost(arm, loaded, monkeypatch):
    drop(arm, loaded)
    load = Files.load_version

    def meanwhile(*given):
        model = load(*given)
        assert not adopt(loaded, published(arm, 4))
        return model

    monkeypatch.setattr(Files, "load_version", meanwhile)
    assert loaded.get(ARM, None).revision == 4
    assert loaded.hot(ARM, None).revision == 4


def test_a_service_that_starts_has_what_the_log_says(arm):
    arm.batches(*range(4))
    started = LoadedModels(arm.storage, LearntVersions(arm.database, arm.files), capacity=2)
    assert started.preload() == 1
    found = started.hot(ARM, None)
    assert found.revision == 4
    same(found.model, at_once(range(4)))
    same(found.base, at_once())


def test_a_learner_is_woken_for_what_was_loaded_without_all_of_its_log(arm, monkeypatch):
    monkeypatch.setattr(learnt, "MOST_ROWS", 0)
    woken = []
    started = LoadedModels(arm.storage, LearntVersions(arm.database, arm.files), capacity=2)
    arm.batches(*range(4))
    started.preload()
    started.learn_from(woken.append)
    assert woken == [ARM]
    assert started.hot(ARM, None).revision == 0
    drop(arm, started)
    started.get(ARM, None)
    assert woken == [ARM, ARM]


def test_a_log_that_cannot_be_read_leaves_the_version_as_trained(arm, caplog):
    arm.batches(0)
    with arm.database.transaction() as session:
        session.connection().exec_driver_sql("UPDATE events SET payload = x'00'")
    started = LoadedModels(arm.storage, LearntVersions(arm.database, arm.files), capacity=2)
    started.preload()
    found = started.hot(ARM, None)
    assert found.revision == 0
    same(found.model, at_once())
    assert "what version 1 of model 'arm' has learnt is not known" in caplog.text


def test_revisions_that_nobody_answers_from_are_freed(arm, loaded):
    adopt(loaded, published(arm, 1))
    first = weakref.ref(loaded.hot(ARM, None).model)
    adopt(loaded, published(arm, 2))
    gc.collect()
    assert first() is None


def test_answers_are_whole_while_revisions_come(arm, loaded):
    """Torque, deviation and revision of every answer belong together, in several threads, while all of them change."""
    revisions = [revision(number) for number in range(1, 9)]
    motion = np.ascontiguousarray(QUERIES[:, 7])
    expected = {0: trained().answer(motion)}
    expected |= {n: each.apply(trained()).answer(motion) for n, each in enumerate(revisions, start=1)}
    answers, failed, stop = [[] for _ in range(3)], [], threading.Event()

    def ask(into):
        try:
            while not stop.is_set():
                served = loaded.hot(ARM, None)
                into.append((served.revision, *served.model.answer(motion)))
        except Exception as error:
            failed.append(error)

    threads = [threading.Thread(target=ask, args=(into,)) for into in answers]
    for thread in threads:
        thread.start()
    for number in range(1, 9):
        loaded.revise(ARM, 1, number, revisions[number - 1])
        known = [len(each) for each in answers]  # of three more, two at least have begun since
        while any(len(each) < before + 3 for each, before in zip(answers, known, strict=True)) and not failed:
            pass
    stop.set()
    for thread in threads:
        thread.join()
    assert not failed
    for each in answers:
        numbers = [number for number, _, _ in each]
        assert numbers == sorted(numbers)
        assert numbers[-1] == 8
        for number, tau, std in each:
            np.testing.assert_allclose(tau, expected[number][0], rtol=1e-10)
            np.testing.assert_allclose(std, expected[number][1], rtol=1e-10)
    assert {number for each in answers for number, _, _ in each} >= set(range(1, 9))
    assert len({float(tau[0]) for tau, _ in expected.values()}) == 9


def drop(arm, loaded):
    """Ask for so many other models that this one has to go."""
    for number in range(loaded.capacity):
        other = f"other-{number}"
        if other not in {name for name, _ in loaded._snapshot.served}:
            arm.publish(other)
        loaded.get(other, None)
    assert loaded.hot(ARM, None) is None


def test_the_oracle_tells_revisions_apart():
    assert differ(predicted(revision(1).apply(trained())), at_once(), 1e-6)
