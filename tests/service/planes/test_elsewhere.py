"""Long computations of a service: workers answer as the threads of one process do, errors included."""

import asyncio
import json
from collections.abc import Iterator

import numpy as np
import pytest
from starlette.requests import ClientDisconnect

from service.api.oip.schema import HEADER
from service.api.route import unless_disconnected
from service.inference.predicting import MAX_SHORT_BODY, is_long, queries
from service.planes.workers.pool import WorkerPool
from tests.service.data import service_of, stream, train, upload
from tests.service.warm import fork


@pytest.fixture(scope="module")
def pool(api) -> Iterator[WorkerPool]:
    made = WorkerPool(service_of(api).storage.settings, fork)
    yield made
    made.close()


def rows(count: int, n: int = 2, **more: object) -> dict[str, object]:
    """Return a query of motions."""
    values = np.random.default_rng(count).uniform(-0.5, 0.5, (3, count, n)).tolist()
    return dict(zip(("q", "dq", "ddq"), values, strict=True)) | more


def test_workers_answer_as_threads_do(api, trained, pool, monkeypatch):
    model, panda, data = "/v1/models/pendulum", "/v1/models/panda-sim", trained.dataset
    train(api, "elsewhere", data)
    train(api, "elsewhere", upload(api, stream(seed=9))["id"])
    torque = rows(70)["q"]
    requests = [
        (f"{model}/predict", rows(65)),
        (f"{model}/predict", rows(900)),
        (f"{model}/predict", rows(2, covariance=True)),
        (f"{model}/predict", rows(5, components=["gravity", "inertia_matrix"])),
        (f"{model}/predict", rows(70, tau=torque, components=["forward_dynamics"])),
        (f"{model}/predict", rows(1100)),
        (f"{model}/predict", rows(800, version=7)),
        (f"{model}/predict", rows(800, other=1)),
        (f"{model}/predict", rows(70) | {"q": [[1e3, 0.0]] * 70}),
        (f"{panda}/predict", rows(66, 7, payload={"mass": 0.4, "com": [0.0, 0.0, 0.1]})),
        (f"{panda}/gravity", {"q": rows(80, 7)["q"]}),
        (f"{panda}/wrench", {**rows(3, 7), "tau": rows(3, 7)["q"]}),
        (f"{model}/evaluate", {"dataset": data}),
        (f"{model}/evaluate", {"dataset": data, "part": "held_out"}),
        (f"{panda}/evaluate", {"dataset": data}),
        (f"{model}/evaluate", {"dataset": "ds_none"}),
        (f"{model}/trace", {"dataset": data, "points": 20, "components": ["gravity"]}),
        (f"{model}/trace", {"dataset": data, "start": 1_000_000}),
        ("/v1/models/elsewhere/compare", {"dataset": data, "versions": [1, 2]}),
        ("/v1/models/elsewhere/compare", {"dataset": data, "versions": [1, 1]}),
    ]
    computed = []
    run = pool.run

    async def counted(function, *given):
        computed.append(function)
        return await run(function, *given)

    monkeypatch.setattr(pool, "run", counted)
    in_threads = [api.post(path, json=body) for path, body in requests]
    api.app.state.workers = pool
    try:
        for (path, body), expected in zip(requests, in_threads, strict=True):
            before = len(computed)
            found = api.post(path, json=body)
            assert (found.status_code, found.content) == (expected.status_code, expected.content), (path, body)
            assert len(computed) > before or found.status_code in (404, 422), (path, body)
    finally:
        api.app.state.workers = None
    assert {each.status_code for each in in_threads} == {200, 404, 422}


@pytest.mark.parametrize("outputs", [("tau", "tau_std"), ("tau_mean", "scale"), ("covariance",), ("inertia_matrix",)])
@pytest.mark.parametrize("count", [3, 90, 1200])
def test_workers_infer_as_threads_do(api, pool, count, outputs):
    values = np.random.default_rng(count).uniform(-0.5, 0.5, (3, count, 7))
    inputs = [
        {"name": name, "shape": [count, 7], "datatype": "FP64", "parameters": {"binary_data_size": values[0].nbytes}}
        for name in ("q", "dq", "ddq")
    ]
    wanted = [{"name": each, "parameters": {"binary_data": True}} for each in outputs]
    text = json.dumps({"inputs": inputs, "outputs": wanted}).encode()
    answers = []
    for workers in (None, pool):
        api.app.state.workers = workers
        try:
            headers = {HEADER: str(len(text)), "content-type": "application/octet-stream"}
            answer = api.post("/v2/models/panda-sim/infer", content=text + values.tobytes(), headers=headers)
        finally:
            api.app.state.workers = None
        answers.append((answer.status_code, answer.content))
    assert answers[0] == answers[1]
    assert (answers[0][0] == 200) == (count < 1000 or outputs[0].startswith("tau")) or count == 90


def test_short_queries_stay(api, trained):
    class NoWorkers:
        async def run(self, *_):
            raise AssertionError("a short query was computed elsewhere")

    api.app.state.workers = NoWorkers()
    try:
        for body in (rows(1), rows(64), rows(1, covariance=True), rows(1, components=["gravity"])):
            assert api.post("/v1/models/pendulum/predict", json=body).status_code == 200
        assert api.post("/v1/models/panda-sim/gravity", json={"q": [0.1] * 7}).status_code == 200
    finally:
        api.app.state.workers = None
    for body, long in ((rows(64), False), (rows(65), True), (rows(2, covariance=True), True)):
        assert is_long(queries.decode(json.dumps(body).encode())) is long
    assert len(json.dumps(rows(64, 7))) < MAX_SHORT_BODY


def test_computation_ends_if_the_client_disconnects():
    async def disconnect() -> None:
        left, ended = asyncio.Event(), []

        async def receive():
            await left.wait()
            return {"type": "http.disconnect"}

        async def compute(result):
            try:
                return await result
            finally:
                ended.append(result)

        answer = asyncio.get_running_loop().create_future()
        answer.set_result(3)
        assert await unless_disconnected(receive, compute(answer)) == 3
        never = asyncio.get_running_loop().create_future()
        waiting = asyncio.create_task(unless_disconnected(receive, compute(never)))
        await asyncio.sleep(0)
        left.set()
        with pytest.raises(ClientDisconnect):
            await waiting
        await asyncio.sleep(0)
        assert ended == [answer, never]
        assert never.cancelled()

    asyncio.run(disconnect())
