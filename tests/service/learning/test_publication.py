"""Publication of revisions: files, adoption for predictions, eviction, and `min_revision`."""

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
from tests.service.learning.learning_models import QUERIES as HTTP_QUERIES
from tests.service.learning.learning_models import observation_batch
from tests.service.learning.pendulums import (
    ARM,
    QUERIES,
    adopt_revision,
    assert_predictions,
    expected_predictions,
    make_rows,
    predictions_differ,
    trained_model,
)


def start_loading(arm):
    """Return the loaded models of a service that has just started: none."""
    return LoadedModels(arm.storage, LearntVersions(arm.database, arm.files), capacity=2)


@pytest.fixture
def loaded_models(arm):
    """Loaded models of a service, with the model as trained."""
    found = start_loading(arm)
    found.get(ARM, None)
    return found


def make_revision(batches, floor=None):
    """Return the revision of the trained model after some batches."""
    online = OnlineModel.start(trained_model(), None, 0.0)
    if batches:
        online = online.learn(Rows.concatenate([make_rows(number) for number in range(batches)]))
    return Revision.of(online.model(floor))


def publish_revision(arm, loaded_models, batches, number=None):
    """Publish the revision after some batches, as the learner does; return whether it is adopted for predictions."""
    path = publication.write(publication.clear(arm.files), make_revision(batches))
    number = batches if number is None else number
    return adopt_revision(loaded_models, Publication(ARM, 1, number, number, path, 10.0 * batches, 0, 0.0, 0.1, 0.0))


def evict_model(arm, loaded_models):
    """Load other models until this one is evicted."""
    for number in range(loaded_models.capacity):
        other = f"other-{number}"
        if other not in {name for name, _ in loaded_models.snapshot.served}:
            arm.publish(other)
        loaded_models.get(other, None)
    assert loaded_models.hot(ARM, None) is None


def test_published_arrays_are_read_once(arm):
    written = make_revision(3, floor=np.array([0.5, 0.0]))
    path = publication.write(publication.clear(arm.files), written)
    found = publication.read(path)
    assert not path.exists()
    for name in publication.ARRAY_NAMES:
        np.testing.assert_array_equal(getattr(found, name), getattr(written, name))
    assert found.floor[0] == 0.5


def test_adopted_revision_is_used_for_predictions(arm, loaded_models):
    before, expected = loaded_models.hot(ARM, None), expected_predictions(range(3))
    assert publish_revision(arm, loaded_models, 3)
    after = loaded_models.hot(ARM, None)
    assert (before.revision, after.revision, after.version) == (0, 3, 1)
    assert_predictions(after.model, expected)
    assert_predictions(before.model, expected_predictions())
    assert predictions_differ(expected, expected_predictions())
    assert loaded_models.hot(ARM, 1) is after
    assert after.base is before.base
    single = [after.model.answer(np.ascontiguousarray(QUERIES[:, row])) for row in range(QUERIES.shape[1])]
    for found, values in zip(zip(*single, strict=True), expected, strict=True):
        np.testing.assert_allclose(found, values, rtol=1e-8, atol=1e-8)


def test_only_higher_revisions_are_adopted(arm, loaded_models):
    assert publish_revision(arm, loaded_models, 3)
    known = loaded_models.hot(ARM, None)
    for number in (2, 3):
        assert not publish_revision(arm, loaded_models, 5, number=number)
        assert loaded_models.hot(ARM, None) is known
    assert publish_revision(arm, loaded_models, 1, number=4)  # a rollback has a higher revision
    assert_predictions(loaded_models.hot(ARM, None).model, expected_predictions(range(1)))
    assert loaded_models.hot(ARM, None).revision == 4


def test_reloaded_version_has_its_learnt_state(arm, loaded_models):
    publish_revision(arm, loaded_models, 3)
    evict_model(arm, loaded_models)
    again = loaded_models.get(ARM, None)
    assert again.revision == 3
    assert_predictions(again.model, expected_predictions(range(3)))
    publish_revision(arm, loaded_models, 5)
    assert_predictions(loaded_models.hot(ARM, None).model, expected_predictions(range(5)))


def test_evicted_version_held_by_a_stream_keeps_learning(arm, loaded_models):
    held = loaded_models.get(ARM, None)
    evict_model(arm, loaded_models)
    assert publish_revision(arm, loaded_models, 4)
    assert loaded_models.hot(ARM, None).revision == 4
    assert loaded_models.hot(ARM, None).base is held.base
    assert len(loaded_models.snapshot.served) == loaded_models.capacity


def test_started_service_restores_from_the_log(arm):
    arm.log_batches(*range(4))
    started = start_loading(arm)
    assert started.preload() == 1
    found = started.hot(ARM, None)
    assert found.revision == 4
    assert_predictions(found.model, expected_predictions(range(4)))
    assert_predictions(found.base, expected_predictions())


def test_revision_published_during_loading_is_kept(arm, loaded_models, monkeypatch):
    evict_model(arm, loaded_models)
    load = Files.load_version

    def publish_while_loading(*given):
        model = load(*given)
        assert not publish_revision(arm, loaded_models, 4)
        return model

    monkeypatch.setattr(Files, "load_version", publish_while_loading)
    assert loaded_models.get(ARM, None).revision == 4
    assert loaded_models.hot(ARM, None).revision == 4


def test_learner_is_woken_for_partially_restored_version(arm, monkeypatch):
    monkeypatch.setattr(learnt, "MAX_PAGES", 0)
    woken = []
    started = start_loading(arm)
    arm.log_batches(*range(4))
    started.preload()
    started.learn_from(woken.append)
    assert woken == [ARM]
    assert started.hot(ARM, None).revision == 0
    evict_model(arm, started)
    started.get(ARM, None)
    assert woken == [ARM, ARM]


def test_unreadable_log_leaves_version_as_trained(arm, caplog):
    arm.log_batches(0)
    with arm.database.transaction() as session:
        session.connection().exec_driver_sql("UPDATE events SET payload = x'00'")
    started = start_loading(arm)
    started.preload()
    found = started.hot(ARM, None)
    assert found.revision == 0
    assert_predictions(found.model, expected_predictions())
    assert "could not read what version 1 of model 'arm' has learnt" in caplog.text


def test_replaced_revisions_are_freed(arm, loaded_models):
    publish_revision(arm, loaded_models, 1)
    first = weakref.ref(loaded_models.hot(ARM, None).model)
    publish_revision(arm, loaded_models, 2)
    gc.collect()
    assert first() is None


@pytest.mark.slow
def test_predictions_are_consistent_while_revisions_change(arm, loaded_models):
    """In several threads, torque, standard deviation and revision of every prediction belong together."""
    revisions = [make_revision(number) for number in range(1, 9)]
    motion = np.ascontiguousarray(QUERIES[:, 7])
    expected = {0: trained_model().answer(motion)}
    expected |= {n: each.apply(trained_model()).answer(motion) for n, each in enumerate(revisions, start=1)}
    answers, stop = [[] for _ in range(3)], threading.Event()

    def predict_until_stopped(into):
        while not stop.is_set():
            served = loaded_models.hot(ARM, None)
            into.append((served.revision, *served.model.answer(motion)))

    with ThreadPoolExecutor(len(answers)) as threads:
        running = [threads.submit(predict_until_stopped, into) for into in answers]
        for number in range(1, 9):
            loaded_models.revise(ARM, 1, number, revisions[number - 1])
            known = [len(each) for each in answers]  # of three more predictions, at least two began after the revision
            while any(len(each) < before + 3 for each, before in zip(answers, known, strict=True)):
                if any(each.done() for each in running):  # a thread failed
                    break
        stop.set()
    for each in running:
        each.result()
    for each in answers:
        numbers = [number for number, _, _ in each]
        assert numbers == sorted(numbers)
        assert numbers[-1] == 8
        for number, tau, std in each:
            np.testing.assert_allclose(tau, expected[number][0], rtol=1e-10)
            np.testing.assert_allclose(std, expected[number][1], rtol=1e-10)
    assert {number for each in answers for number, _, _ in each} >= set(range(1, 9))
    assert len({float(tau[0]) for tau, _ in expected.values()}) == 9


SINGLE_QUERY = {name: rows[0] for name, rows in HTTP_QUERIES.items()}


def test_min_revision_is_waited_for(learning_model):
    learning_model.predict()
    revision, url = learning_model.post("observations", observation_batch(0))["revision"], learning_model.url("predict")
    queries = [query | {"min_revision": revision} for query in (SINGLE_QUERY, HTTP_QUERIES)]
    with ThreadPoolExecutor(2) as threads:  # single queries wait in the event loop, batches in a thread
        answers = list(threads.map(lambda query: learning_model.client.post(url, json=query), queries))
    # a learner that is still starting may take longer than the wait
    assert all(each.status_code in (200, 503) for each in answers)
    learning_model.wait_for_revision(revision)
    for query in queries:
        assert learning_model.post("predict", query)["revision"] == revision


def test_unreached_min_revision_is_an_error(learning_model, monkeypatch):
    woken = []
    monkeypatch.setattr(service_of(learning_model.client).loaded, "_wake", woken.append)
    monkeypatch.setitem(vars(service_of(learning_model.client).settings), "min_revision_wait_s", 0.05)
    for query in (SINGLE_QUERY, HTTP_QUERIES):
        woken.clear()
        answer = learning_model.client.post(learning_model.url("predict"), json=query | {"min_revision": 3})
        (item,) = error(answer, 503, "revision_not_reached")["detail"]
        assert item == {"field": "min_revision", "value": "3", "expected": "at most 0 at present, of version 1"}
        assert answer.headers["retry-after"] == "1"
        assert woken == [learning_model.name]  # once: the service that logged it may not have woken a learner


def test_evaluation_waits_for_min_revision(learning_model, monkeypatch):
    monkeypatch.setitem(vars(service_of(learning_model.client).settings), "min_revision_wait_s", 0.05)
    body = {"dataset": "ds_0", "min_revision": 1}
    learning_model.expect_error("POST", "evaluate", 503, "revision_not_reached", json=body)
    learning_model.expect_error("POST", "evaluate", 404, "not_found", json=body | {"min_revision": 0})


def test_unknown_versions_are_not_waited_for(learning_model):
    query = HTTP_QUERIES | {"min_revision": 1}
    learning_model.expect_error("POST", "predict", 404, "not_found", json=query | {"version": 9})
    error(learning_model.client.post("/v1/models/nobody/predict", json=query), 404, "not_found")


def test_waiters_miss_no_wakeup_and_are_removed():
    waiting = RevisionWaiters()

    async def wait() -> None:
        with waiting.waiter("arm") as first, waiting.waiter("arm") as second:
            waiting.wake("other")
            thread = threading.Thread(target=waiting.wake, args=("arm",))
            thread.start()
            thread.join()
            await asyncio.gather(first.wait(60.0), second.wait(60.0))  # woken before they wait
            await first.wait(0.0)  # woken once

    asyncio.run(wait())
    assert waiting._waiters == {}
    waiting.wake("arm")
