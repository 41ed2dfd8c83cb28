"""The hot route: it answers simple queries at once, and FastAPI answers all others in the same way.

The reference is the endpoint that pydantic validates: the hot route ignores the media type `application/x+json`.
"""

import gc
import json
import os
import random
import subprocess
import sys
import weakref
from unittest.mock import Mock

import numpy as np
import pytest

from service.inference import predicting as inference
from tests.service.data import DEADLINE, error, service_of

QUERY = {"q": [0.25, -1.5], "dq": [1, 0.125], "ddq": [-2.0, 3e-1]}
BATCH = {name: [values, values[::-1], [0.5, 0]] for name, values in QUERY.items()}
HISTORY = {"t": [0], "q": [[0.25, -1.5]], "dq": [[1, 0.125]]}


def post(api, model, body, media_type="application/json"):
    content = json.dumps(body) if isinstance(body, dict) else body
    return api.post(f"/v1/models/{model}/predict", content=content, headers={"content-type": media_type})


def assert_as_fastapi(api, model, body):
    """Check that the hot route answers a body as the endpoint does; return the answer."""
    result, expected = post(api, model, body), post(api, model, body, "application/x+json")
    assert (result.status_code, result.json()) == (expected.status_code, expected.json())
    assert result.headers["content-type"] == expected.headers["content-type"] == "application/json"
    return result


@pytest.fixture
def no_thread(api, monkeypatch):
    """A service that can answer on the event loop only."""

    monkeypatch.setattr(inference, "predict", Mock(side_effect=AssertionError("computed in a thread")))
    return api


def test_single_query_is_answered_on_the_event_loop(no_thread, trained):
    service_of(no_thread).loaded.get(trained.name, None)  # models of other tests may have replaced it in memory
    for body in (
        QUERY,
        QUERY | {"version": 1},
        QUERY | {"components": [], "covariance": False, "tau": None, "t": None},
    ):
        assert post(no_thread, trained.name, body).status_code == 200
    history = {"t": 0.01, "history": HISTORY}
    for body in (BATCH, QUERY | {"covariance": True}, QUERY | {"components": ["gravity"]}, QUERY | history):
        with pytest.raises(AssertionError, match="computed in a thread"):
            post(no_thread, trained.name, body)


def test_numbers_equal_the_model_bit_for_bit(api, trained):
    motions = np.random.default_rng(8).uniform(-2, 2, (50, 3, 2))
    motions[1] *= 1e-300
    for motion in motions:
        result = post(api, trained.name, dict(zip(("q", "dq", "ddq"), motion.tolist(), strict=True))).json()
        tau, tau_std = trained.model.answer(motion)
        assert result["tau"] == tau.tolist()
        assert result["tau_std"] == tau_std.tolist()
        assert result["noise_std"] == trained.model.noise_std.tolist()


@pytest.mark.parametrize(
    "body",
    [
        QUERY,
        BATCH,
        QUERY | {"covariance": True, "version": 1},
        BATCH | {"covariance": True, "components": ["friction", "gravity"]},
        QUERY | {"components": ["forward_dynamics"], "tau": [0.1, 0]},
        QUERY | {"version": None, "tau": None},
        BATCH | {"t": [0, 0.01, 0.02], "trajectory": True, "components": ["friction"]},
        QUERY | {"t": 0.01, "history": HISTORY},
        QUERY | {"t": None, "trajectory": False, "history": None},
        json.dumps(QUERY).encode("utf-8-sig"),
        f" \n{json.dumps(QUERY, indent=3)}\t",
        '{"\\u0071": [0.25, -1.5], "dq": [1, 0.125], "ddq": [-2e0, 3E-1]}',
        '{"q": [-0, -0.0], "dq": [9007199254740993, 1e-400], "ddq": [0.1000000000000000055511151231257827, 1e22]}',
    ],
)
def test_correct_queries_are_answered_alike(api, trained, body):
    assert assert_as_fastapi(api, trained.name, body).status_code == 200


@pytest.mark.parametrize(
    "body",
    [
        QUERY | {"q": [[]], "dq": [[]], "ddq": [[]]},
        QUERY | {"q": [0.1]},
        BATCH | {"dq": QUERY["dq"]},
        BATCH | {"ddq": [[0, 0], 0, [0, 0]]},
        QUERY | {"q": [0, -12.61]},
        QUERY | {"tau": []},
        QUERY | {"components": ["forward_dynamics"], "tau": [[0], 0]},
        QUERY | {"components": ["gravity", "gravity"]},
        # values that pydantic would convert to a number or a boolean
        QUERY | {"version": True},
        QUERY | {"covariance": 1},
        QUERY | {"min_revision": "0"},
        json.dumps(QUERY).encode("utf-16"),
        '{"q": [9, 9], "\\u0071": [0.25, -1.5], "dq": [1, 0.125], "ddq": [-2e0, 3E-1]}',
        '{"q": [0.25, -1.5], "dq": [1, 0.125], "ddq": [-2e0, 3E-1], "version": 1, "version": null}',
        QUERY | {"version": 2},
        QUERY | {"t": 0.5},
        QUERY | {"t": 0.01, "history": HISTORY | {"dq": [[None, 0]]}},
        QUERY | {"t": 0.01, "history": HISTORY | {"ddq": [[0, 0]]}},
        QUERY | {"dq": [1e200, 0]},
        BATCH | {"dq": [[0, 0], [0, 1e200], [0, 0]]},
        {name: [values] * 1001 for name, values in QUERY.items()},
    ],
)
def test_wrong_queries_are_rejected_alike(api, trained, body):
    reply = assert_as_fastapi(api, trained.name, body).json()["error"]
    assert reply["detail"][0]["field"]


@pytest.mark.slow
def test_corrupted_bodies_are_answered_alike(api, trained):
    """Replace, delete or double one byte of a correct query, 200 times."""
    rng = random.Random(3)
    right = json.dumps(QUERY | {"version": 1, "covariance": False, "components": ["friction"], "tau": None})
    statuses = set()
    for _ in range(200):
        body = bytearray(right.encode())
        at = rng.randrange(len(body))
        other = rng.choice(b'"{}[]:,.-+eE0123456789ntfNI \\\xff\x00')
        body[at : at + 1] = rng.choice((bytes([other]), b"", body[at : at + 1] * 2))
        statuses.add(assert_as_fastapi(api, trained.name, bytes(body)).status_code)
    assert {200, 422} <= statuses


def test_body_may_arrive_in_pieces(no_thread, trained):
    body = json.dumps(QUERY).encode()
    entire = post(no_thread, trained.name, body).json()
    pieces = (body[at : at + 7] for at in range(0, len(body), 7))
    assert post(no_thread, trained.name, pieces).json() == entire


@pytest.mark.parametrize(
    ("dq", "field"), [([1e200, 0], "tau["), ([[0, 0], [0, -1e250]], "tau[1]["), ([1e120, 0], "tau_std[")]
)
def test_non_finite_answer_is_rejected(api, trained, dq, field):
    zeros = np.zeros_like(dq).tolist()
    answer = post(api, trained.name, {"q": zeros, "dq": dq, "ddq": zeros})
    (problem,) = error(answer, 422, "invalid_request")["detail"]
    assert problem["field"].startswith(field)
    assert problem["value"] in ("nan", "inf", "-inf")
    assert problem["expected"] == "a finite number: are dq in rad/s and ddq in rad/s²?"


@pytest.mark.parametrize(
    ("body", "given", "answered"),
    [
        (b"\x00\xff" * 500, "application/x-any", "application/octet-stream"),
        (b"<script>alert(1)</script>", "text/html", "application/octet-stream"),
        (b"", "a/b", "application/octet-stream"),
        (b"{}", "application/json; charset=utf-8", "application/json"),
    ],
)
def test_echo_returns_the_body(api, body, given, answered):
    answer = api.post("/v1/echo", content=body, headers={"content-type": given})
    assert (answer.status_code, answer.content, answer.headers["content-type"]) == (200, body, answered)
    assert answer.headers["x-content-type-options"] == "nosniff"
    plain = api.post("/v1/echo", content=b"abc")
    assert (plain.content, plain.headers["content-type"]) == (b"abc", "application/octet-stream")


COUNT_THREADS = """
import asyncio, sys
from anyio import to_thread
from threadpoolctl import threadpool_info
from service.app import create_app
from service.foundation.settings import Settings

async def main():
    app = create_app(Settings(home=sys.argv[1]))
    async with app.router.lifespan_context(app):
        print(*(pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"))

asyncio.run(main())
"""


@pytest.mark.slow
def test_serving_has_one_thread_of_linear_algebra(home):
    """Use a process of its own, as only the first thread of a process can set the number for BLAS."""
    command, environment = [sys.executable, "-c", COUNT_THREADS, str(home)], {**os.environ, "OMP_NUM_THREADS": "2"}
    assert set(subprocess.check_output(command, env=environment, text=True, timeout=DEADLINE).split()) == {"1"}


@pytest.mark.slow
def test_loaded_versions_are_frozen_for_the_collector_and_freed_once_dropped(api, trained):
    loaded = service_of(api).loaded
    counts, models = [], []
    for _ in range(6):
        loaded._snapshot = type(loaded._snapshot)()
        models.append(weakref.ref(loaded.get(trained.name, None).model))
        counts.append(gc.get_freeze_count())
        assert not any(each is models[-1]() for each in gc.get_objects())
    assert counts[0] > 1000
    assert counts[-1] - counts[0] < 1000
    assert [model() is None for model in models] == [True] * 5 + [False]
