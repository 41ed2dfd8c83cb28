"""What has been learnt reaches answers: through files, by one assignment, whole, never backwards; and is waited for."""

import asyncio
import gc
import threading
import weakref
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from lipcore.online.batch import Rows
from lipcore.online.learner import OnlineModel
from lipcore.online.transfer import Revision
from service.learning.learner import learnt, publication
from service.learning.learner.learnt import LearntVersions
from service.learning.learner.publication import Publication
from service.models.loaded import LoadedModels
from service.models.served import RevisionWaiters
from service.storage.files import Files
from tests.service.data import error, service_of
from tests.service.learning.lessons import QUERIES as ASKED
from tests.service.learning.lessons import lesson
from tests.service.learning.pendulums import ARM, QUERIES, adopt, at_once, differ, rows, same, trained


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
    return Publication(**usual | {"novel_rows": 0, "novel_share": 0.0, "seconds": 0.1, "at": 0.0} | fields)


def test_arrays_come_back_as_they_were_and_their_files_are_gone(arm):
    written = revision(3, floor=np.array([0.5, 0.0]))
    path = publication.write(publication.clear(arm.files), written)
    found = publication.read(path)
    assert not path.exists()
    for name in publication.ARRAY_NAMES:
        np.testing.assert_array_equal(getattr(found, name), getattr(written, name))
    assert found.floor[0] == 0.5


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


def test_a_version_dropped_from_memory_has_what_it_had_learnt_when_it_is_loaded_again(arm, loaded):
    adopt(loaded, published(arm, 3))
    drop(arm, loaded)
    again = loaded.get(ARM, None)
    assert again.revision == 3
    same(again.model, at_once(range(3)))
    adopt(loaded, published(arm, 5))
    same(loaded.hot(ARM, None).model, at_once(range(5)))


def test_a_version_dropped_from_memory_that_a_stream_holds_learns_on(arm, loaded):
    held = loaded.get(ARM, None)
    drop(arm, loaded)
    assert adopt(loaded, published(arm, 4))
    assert loaded.hot(ARM, None).revision == 4
    assert loaded.hot(ARM, None).base is held.base
    assert len(loaded._snapshot.served) == loaded.capacity


def test_a_service_that_starts_has_what_the_log_says(arm):
    arm.batches(*range(4))
    started = LoadedModels(arm.storage, LearntVersions(arm.database, arm.files), capacity=2)
    assert started.preload() == 1
    found = started.hot(ARM, None)
    assert found.revision == 4
    same(found.model, at_once(range(4)))
    same(found.base, at_once())


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


def test_a_learner_is_woken_for_what_was_loaded_without_all_of_its_log(arm, monkeypatch):
    monkeypatch.setattr(learnt, "MAX_PAGES", 0)
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


SINGLE = {name: rows[0] for name, rows in ASKED.items()}


def test_what_was_taught_is_in_the_answer(pupil):
    pupil.predict()
    said = pupil.post("observations", lesson(0))
    with ThreadPoolExecutor(2) as threads:  # through the event loop, which goes on, and through a thread
        asked = [
            threads.submit(pupil.client.post, pupil.url("predict"), json=query | {"min_revision": said["revision"]})
            for query in (SINGLE, ASKED)
        ]
        answers = [each.result() for each in asked]
    # a learner that is only started may take longer than they wait
    assert all(each.status_code in (200, 503) for each in answers)
    pupil.settled(said["revision"])
    for query in (SINGLE, ASKED):
        assert pupil.post("predict", query | {"min_revision": said["revision"]})["revision"] == said["revision"]


def test_a_revision_that_does_not_come_is_refused(pupil, monkeypatch):
    woken = []
    monkeypatch.setattr(service_of(pupil.client).loaded, "_wake", woken.append)
    monkeypatch.setitem(vars(service_of(pupil.client).settings), "min_revision_wait_s", 0.05)
    for query in (SINGLE, ASKED):
        woken.clear()
        answer = pupil.client.post(pupil.url("predict"), json=query | {"min_revision": 3})
        (item,) = error(answer, 503, "revision_not_reached")["detail"]
        assert item == {"field": "min_revision", "value": "3", "expected": "0 or less now, of version 1"}
        assert answer.headers["retry-after"] == "1"
        assert woken == [pupil.model]  # once: who has logged it may have told nobody


def test_a_data_set_is_compared_with_what_was_taught(pupil, monkeypatch):
    monkeypatch.setitem(vars(service_of(pupil.client).settings), "min_revision_wait_s", 0.05)
    body = {"dataset": "ds_0", "min_revision": 1}
    error(pupil.client.post(pupil.url("evaluate"), json=body), 503, "revision_not_reached")
    pupil.refused("POST", "evaluate", 404, "not_found", json=body | {"min_revision": 0})


def test_what_is_not_there_is_not_waited_for(school, pupil):
    pupil.refused("POST", "predict", 404, "not_found", json=ASKED | {"min_revision": 1, "version": 9})
    answer = school.client.post("/v1/models/nobody/predict", json=ASKED | {"min_revision": 1})
    error(answer, 404, "not_found")


def test_a_waiter_misses_nothing_and_leaves_nothing():
    waiting = RevisionWaiters()

    async def wait() -> None:
        with waiting.waiter("arm") as first, waiting.waiter("arm") as second:
            waiting.wake("other")
            thread = threading.Thread(target=waiting.wake, args=("arm",))
            thread.start()
            thread.join()
            await asyncio.gather(first.wait(60.0), second.wait(60.0))  # told before they wait
            await first.wait(0.0)  # told once

    asyncio.run(wait())
    assert waiting._waiters == {}
    waiting.wake("arm")
