"""Idempotency races: many threads send requests with the same key at a time, and each is processed once."""

from collections import defaultdict
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import httpx
import numpy as np
import pytest

from tests.attack.attacked import AttackedService, attack_random
from tests.service.data import QUICK, arrays, npz, stream, upload
from tests.system.faults.ledger import ARM, batch, list_items

THREADS, KEYS = 16, 12


@pytest.fixture(scope="module")
def attacked(tmp_path_factory: pytest.TempPathFactory) -> Iterator[AttackedService]:
    with AttackedService(tmp_path_factory.mktemp("races")) as service:
        yield service


def at_once(attacked: AttackedService, sends: list) -> list[httpx.Response]:
    """Send requests from many threads in a random order; return the answers in the order of the requests."""
    with ThreadPoolExecutor(THREADS) as threads:
        answers = list(threads.map(lambda send: send(), sends))
    for answer in answers:
        attacked.check_answer(answer)
    return answers


def test_each_key_makes_one_data_set(attacked):
    """Of two bodies with the same key, the first wins and the other is a conflict."""
    random = attack_random("uploads")
    bodies = [npz(**arrays(stream(samples=40, seed=90 + number))) for number in range(2)]
    wanted = [(f"race-{random.getrandbits(30)}", which) for _ in range(KEYS) for which in (0, 0, 0, 1)]
    wanted += random.choices(wanted, k=2 * KEYS)
    random.shuffle(wanted)

    def send(key: str, which: int) -> httpx.Response:
        headers = {"content-type": "application/x-npz", "Idempotency-Key": key}
        return attacked.client.post("/v1/datasets", content=bodies[which], headers=headers, params={"name": key})

    before = len(list_items(attacked.client, "/v1/datasets"))
    answers = at_once(attacked, [lambda each=each: send(*each) for each in wanted])
    made = defaultdict(set)
    for (key, which), answer in zip(wanted, answers, strict=True):
        assert answer.status_code in (201, 409, 429), answer.text
        if answer.status_code == 201:
            made[key].add((which, answer.json()["id"]))
    assert all(len(found) == 1 for found in made.values()), made
    found = list_items(attacked.client, "/v1/datasets")
    assert len(found) == before + len(made)
    assert {each["id"] for each in found} >= {name for ((_, name),) in made.values()}
    attacked.check_sound()


def test_each_key_queues_one_job(attacked):
    random = attack_random("jobs")
    dataset = upload(attacked.client, stream(samples=40, seed=95))["id"]
    keys = [f"job-{random.getrandbits(30)}" for _ in range(3)]
    wanted = random.choices(keys, k=60)

    def send(key: str) -> httpx.Response:
        body = {"model": key, "datasets": [dataset], "estimator": "lip-chain", "options": QUICK, "holdout": None}
        return attacked.client.post("/v1/jobs", json=body, headers={"Idempotency-Key": key})

    answers = at_once(attacked, [lambda key=key: send(key) for key in wanted])
    assert {answer.status_code for answer in answers} == {202}
    found = [each for each in list_items(attacked.client, "/v1/jobs") if each["model"] in keys]
    assert {answer.json()["id"] for answer in answers} == {each["id"] for each in found}
    assert len(found) == len(set(wanted))
    for each in found:
        attacked.client.post(f"/v1/jobs/{each['id']}/cancel")
    attacked.check_sound()


def test_each_batch_is_learnt_once(attacked):
    """Of two batches of the same sequence, the first is logged."""
    random = attack_random("batches")
    changed = {sequence: batch(sequence) for sequence in range(KEYS)}
    for body in changed.values():
        body["tau"] = (np.array(body["tau"]) * 1.01).tolist()
    wanted = [(sequence, which) for sequence in range(KEYS) for which in (0, 0, 0, 1)] * 2
    random.shuffle(wanted)

    def send(sequence: int, which: int) -> httpx.Response:
        body = changed[sequence] if which else batch(sequence)
        return attacked.client.post(f"/v1/models/{ARM}/observations", json=body)

    answers = at_once(attacked, [lambda each=each: send(*each) for each in wanted])
    first, logged = defaultdict(list), defaultdict(set)
    for (sequence, which), answer in zip(wanted, answers, strict=True):
        assert answer.status_code in (200, 409), answer.text
        if answer.status_code == 200:
            logged[sequence].add(which)
            if not answer.json()["duplicate"]:
                first[sequence].append(answer.json()["revision"])
    assert all(len(found) == 1 for found in logged.values()), logged
    assert all(len(revisions) == 1 for revisions in first.values()), first
    assert len(first) == KEYS
    assert len({revision for (revision,) in first.values()}) == KEYS
    attacked.check_sound()
