"""Workers: they compute what the process that asks would, and nothing that happens to one makes a caller wait."""

import asyncio
import os
import signal
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from lipcore import load
from lipcore.model.body import Body
from lipcore.model.payload import Carrier
from service.foundation.errors import ConflictError, NotReadyError
from service.foundation.settings import Settings
from service.inference.predicting import predict_body
from service.models.loads import StreamPayload, StreamPayloads
from service.models.scales import Factor, Scales
from service.models.served import ServedModel
from service.planes.workers import pool as pools
from service.planes.workers.pool import WorkerPool
from service.storage.storage import Storage
from tests import ROOT
from tests.service.planes import tasks
from tests.service.warm import fork


class Clock:
    """A clock that a test moves."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


class Pool(WorkerPool):
    """A pool that tells which processes it has started."""

    def __init__(self, settings: Settings, clock: Clock) -> None:
        self.started = []

        def start(*given):
            self.started.append(fork(*given))
            return self.started[-1]

        super().__init__(settings, start, clock)
        self.clock = clock


@pytest.fixture(scope="module")
def settings(tmp_path_factory) -> Settings:
    return Settings(home=tmp_path_factory.mktemp("workers") / "home")


@pytest.fixture(scope="module")
def pool(settings) -> Iterator[Pool]:
    made = Pool(settings, Clock())
    yield made
    made.close()
    for each in made.started:
        each.join(60)
        assert not each.is_alive()


@pytest.fixture(scope="module")
def served() -> ServedModel:
    """The shipped Panda, version 3 at revision 7."""
    model = load(ROOT / "models/panda-sim")
    return ServedModel("panda", 3, model, model, frozenset({"ds_1"}), Scales(model.scale), StreamPayloads(), 7)


def pipes(tmp_path: Path) -> tuple[str, str]:
    """Make two named pipes."""
    paths = str(tmp_path / "begun"), str(tmp_path / "end")
    for each in paths:
        os.mkfifo(each)
    return paths


def body(rows: int, more: str = "") -> bytes:
    """Return the JSON of a batch of motions."""
    numbers = np.random.default_rng(rows).uniform(-1, 1, (3, rows, 7)).tolist()
    parts = (f'"{name}": {values}' for name, values in zip(("q", "dq", "ddq"), numbers, strict=True))
    return f"{{{', '.join(parts)}{more}}}".encode()


BODIES = {
    "batch": body(300),
    "covariance": body(100, ', "covariance": true'),
    "components": body(20, ', "components": ["gravity", "inertia_matrix"]'),
    "payload": body(70, ', "payload": {"mass": 0.5, "com": [0.0, 0.0, 0.1]}'),
}


def test_answers_are_those_of_this_process_bit_for_bit(pool, settings, served):
    storage = Storage.open(settings)
    model = served.model
    carrier = Carrier(model)
    loaded = carrier.with_payload(carrier.known(Body(1.0, np.array([0.0, 0.0, 0.1]), None).parameters))
    carrying = ServedModel("panda", 4, model, model, frozenset(), Scales(model.scale), StreamPayloads(), 1)

    async def compare() -> None:
        for given in (served, carrying):
            for name, each in BODIES.items():
                answer = await pool.run(predict_body, given, each)
                assert answer == predict_body(storage, given, each), name
                assert len(answer or b"") > 1000

    asyncio.run(compare())
    # what changes with streams is sent with each task
    carrying.payloads.replace({"": StreamPayload(loaded, (1.0, 0.1), 0.0)})
    wide = 3.0 * model.scale
    carrying.scales.replace({"a": Factor(wide, wide, 0.0)})
    answer = asyncio.run(pool.run(predict_body, carrying, BODIES["batch"]))
    assert answer == predict_body(storage, carrying, BODIES["batch"])
    assert answer != predict_body(storage, served, BODIES["batch"])
    storage.database.close()


def test_versions_stay_the_same_objects_until_other_models_take_their_place(pool, served):
    others = [load(ROOT / "models/panda-sim") for _ in range(pools.MAX_MODELS)]
    versions = [
        ServedModel("other", place, each, each, frozenset(), Scales(each.scale), StreamPayloads())
        for place, each in enumerate(others)
    ]

    async def compute() -> None:
        first = await pool.run(tasks.models, served)
        assert await pool.run(tasks.models, served) == first
        pair = await pool.run(tasks.models, (served, versions[0]))
        assert pair[0] == first[0] != pair[1]
        for each in versions:
            await pool.run(tasks.models, each)
        assert len(await pool.run(tasks.models, (served, *versions[:3]))) == 4

    asyncio.run(compute())


def test_large_and_small_arguments_and_results_travel_unchanged(pool, settings, served):
    big = os.urandom(3_000_001)
    for given in ((b"", 1, "text"), (big, [1.5]), (b"x" * 20_000, os.urandom(100_000)), ("y" * 200_000,)):
        assert asyncio.run(pool.run(tasks.echo, served, *given)) == given
    assert asyncio.run(pool.run(tasks.home, served)) == settings.home


def test_errors_are_raised_as_they_are(pool, served):
    assert asyncio.run(pool.run(tasks.echo, served, 1)) == (1,)
    started = len(pool.started)
    with pytest.raises(ConflictError, match="It changed") as caught:
        asyncio.run(pool.run(tasks.fail, served, "service"))
    assert (caught.value.detail[0].field, caught.value.headers) == ("name", {"Retry-After": "7"})
    with pytest.raises(ZeroDivisionError, match="of numbers"):
        asyncio.run(pool.run(tasks.fail, served, "of numbers"))
    with pytest.raises(RuntimeError, match="LocalError: of no module"):
        asyncio.run(pool.run(tasks.fail, served, "local"))
    assert len(pool.started) == started


def test_task_of_a_killed_worker_is_computed_once_more(pool, served, tmp_path):
    assert asyncio.run(pool.run(tasks.die, served, str(tmp_path / "once"), 2)) == "done"
    assert (tmp_path / "once").stat().st_size == 2
    with pytest.raises(NotReadyError, match="Send a smaller batch"):
        asyncio.run(pool.run(tasks.die, served, str(tmp_path / "always"), 100))
    assert (tmp_path / "always").stat().st_size == pools.ATTEMPTS
    assert asyncio.run(pool.run(tasks.echo, served, 1)) == (1,)


def test_worker_killed_while_idle_or_in_work_is_replaced(pool, served, tmp_path):
    first = asyncio.run(pool.run(tasks.process_id, served))
    os.kill(first, signal.SIGKILL)
    pool.started[-1].join(60)
    assert asyncio.run(pool.run(tasks.process_id, served)) == pool.started[-1].pid != first
    started = len(pool.started)
    begun, end = pipes(tmp_path)

    def kill_and_answer() -> None:
        os.kill(int(Path(begun).read_text()), signal.SIGKILL)
        Path(begun).read_text()  # of the second attempt
        Path(end).write_bytes(b"end")

    thread = threading.Thread(target=kill_and_answer)
    thread.start()
    assert asyncio.run(pool.run(tasks.wait_for, served, begun, end)) == b"end"
    thread.join()
    assert len(pool.started) == started + 1


def test_cancelled_task_ends_its_worker_or_does_not_begin(pool, served, tmp_path):
    begun, end = pipes(tmp_path)

    async def cancel() -> None:
        running = [asyncio.create_task(pool.run(tasks.wait_for, served, begun, end)) for _ in range(2)]
        waiting = asyncio.create_task(pool.run(tasks.die, served, str(tmp_path / "never"), 1))
        pids = set[int]()
        while len(pids) < len(running):
            pids |= {int(each) for each in (await asyncio.to_thread(Path(begun).read_text)).split()}
        for task in (waiting, *running):
            task.cancel()
        for task in (waiting, *running):
            with pytest.raises(asyncio.CancelledError):
                await task
        ended = [each for each in pool.started if each.pid in pids]
        for each in ended:
            await asyncio.to_thread(each.join, 60)
        assert len(ended) == len(pids)
        assert await pool.run(tasks.echo, served, 1) == (1,)

    asyncio.run(cancel())
    assert not (tmp_path / "never").exists()


def test_worker_without_a_task_ends_and_leaves_nothing(pool, served):
    pool.close()
    asyncio.run(pool.run(tasks.echo, served, b"x" * 1_000_000))
    process, used = pool.started[-1], pool.clock.now
    before = len(os.listdir("/proc/self/fd"))
    pool.clock.now = used + pools.IDLE_S - 0.1
    assert pool.end_idle() == 1
    assert process.is_alive()
    pool.clock.now = used + pools.IDLE_S
    assert pool.end_idle() == 0
    process.join(60)
    assert not process.is_alive()
    assert len(os.listdir("/proc/self/fd")) == before - 3  # the connection and two arenas
    assert asyncio.run(pool.run(tasks.echo, served, 2)) == (2,)
