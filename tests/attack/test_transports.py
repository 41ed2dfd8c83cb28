"""One answer a revision: all transports return the same numbers, while the model learns."""

import json
from collections import defaultdict
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from threading import Event
from typing import Any

import grpc
import httpx
import numpy as np
import pytest
from tritonclient.grpc.service_pb2_grpc import GRPCInferenceServiceStub

from tests.attack.attacked import DEADLINE, AttackedService, attack_random
from tests.service.api.oip.grpc import request
from tests.service.api.oip.requests import HEADER, binary_input, binary_tensors, message, pack_numbers, tensors
from tests.service.data import eventually
from tests.service.server import free_port
from tests.service.streams import STD, frame, open_stream, read_hello, send_frame
from tests.system.faults.ledger import ARM, batch, predict_queries

BATCHES = 40
OUTPUTS = ("tau", "tau_std")
Motion = dict[str, list[float]]
Answer = tuple[int, int, tuple[float, ...]]
"""Version, revision, and the numbers: tau and its standard deviation."""


@pytest.fixture(scope="module")
def attacked(tmp_path_factory: pytest.TempPathFactory) -> Iterator[AttackedService]:
    settings = {"GRPC_PORT": str(free_port())}
    with AttackedService(tmp_path_factory.mktemp("transports"), **settings) as service:
        yield service


def numbers(version: Any, revision: Any, *values: Any) -> Answer:
    return int(version), int(revision), tuple(np.concatenate([np.ravel(each) for each in values]).tolist())


class Transports:
    """Connections to a service; each method asks for the torque of a motion."""

    def __init__(self, attacked: AttackedService, stack: ExitStack) -> None:
        self.client = stack.enter_context(httpx.Client(base_url=attacked.server.url, timeout=DEADLINE))
        channel = stack.enter_context(grpc.insecure_channel(f"127.0.0.1:{attacked.settings['LIPSERVE_GRPC_PORT']}"))
        self.stub = GRPCInferenceServiceStub(channel)
        self.streams = {}
        for name, path in (("fast", f"/v1/models/{ARM}/stream"), ("rich", f"/v1/models/{ARM}/stream?rich=1")):
            self.streams[name] = stack.enter_context(open_stream(attacked.server, path))
            read_hello(self.streams[name])

    def post(self, path: str, body: Any, **headers: str) -> httpx.Response:
        content = body if isinstance(body, bytes) else json.dumps(body).encode()
        headers = {"content-type": "application/json", **headers}
        answer = self.client.post(path, content=content, headers=headers)
        assert answer.status_code == httpx.codes.OK, answer.text
        return answer

    def one(self, motion: Motion) -> Answer:
        seen = self.post(f"/v1/models/{ARM}/predict", motion).json()
        return numbers(seen["version"], seen["revision"], seen["tau"], seen["tau_std"])

    def first_of_a_batch(self, motion: Motion) -> Answer:
        body = {name: [values, [0.0, 0.0]] for name, values in motion.items()}
        seen = self.post(f"/v1/models/{ARM}/predict", body).json()
        return numbers(seen["version"], seen["revision"], seen["tau"][0], seen["tau_std"][0])

    def inference(self, motion: Motion) -> Answer:
        seen = self.post(f"/v2/models/{ARM}/infer", message(motion, *OUTPUTS)).json()
        found = tensors(seen)
        revision = seen["parameters"]["revision"]
        return numbers(seen["model_version"], revision, *(found[name] for name in OUTPUTS))

    def binary_inference(self, motion: Motion) -> Answer:
        body = {
            "inputs": [binary_input(name, values) for name, values in motion.items()],
            "outputs": [{"name": name, "parameters": {"binary_data": True}} for name in OUTPUTS],
        }
        text, payload = json.dumps(body).encode(), b"".join(map(pack_numbers, motion.values()))
        headers = {HEADER: str(len(text)), "content-type": "application/octet-stream"}
        head, found = binary_tensors(self.post(f"/v2/models/{ARM}/infer", text + payload, **headers))
        return numbers(head["model_version"], head["parameters"]["revision"], *(found[name] for name in OUTPUTS))

    def remote_call(self, motion: Motion) -> Answer:
        reply = self.stub.ModelInfer(request(motion, *OUTPUTS, model_name=ARM), timeout=DEADLINE)
        found = [np.frombuffer(each, "<f8") for each in reply.raw_output_contents]
        return numbers(reply.model_version, reply.parameters["revision"].int64_param, *found)

    def fast_stream(self, motion: Motion) -> Answer:
        return self._of_stream("fast", motion)

    def rich_stream(self, motion: Motion) -> Answer:
        return self._of_stream("rich", motion)

    def _of_stream(self, name: str, motion: Motion) -> Answer:
        seen = send_frame(self.streams[name], frame(list(motion.values()), flags=STD))
        assert seen.error is None
        return numbers(seen.version, seen.revision, seen.tau, seen.std)


TRANSPORTS: tuple[Callable[[Transports, Motion], Answer], ...] = (
    *(Transports.one, Transports.first_of_a_batch, Transports.inference, Transports.binary_inference),
    *(Transports.remote_call, Transports.fast_stream, Transports.rich_stream),
)


def test_transports_agree_in_every_revision(attacked):
    random = attack_random("transports")
    motion = {name: [random.uniform(-1.0, 1.0) for _ in range(2)] for name in ("q", "dq", "ddq")}
    learnt = Event()

    def learn() -> None:
        try:
            for sequence in range(BATCHES):
                answer = attacked.client.post(f"/v1/models/{ARM}/observations", json=batch(sequence))
                assert answer.status_code == httpx.codes.OK, answer.text
                if sequence % 4 == 0:  # else the model might learn all batches in one revision
                    wanted = answer.json()["revision"]
                    eventually(lambda least=wanted: predict_queries(attacked.client, ARM)["revision"] >= least)
        finally:
            learnt.set()

    def ask() -> dict[tuple[int, int], dict[tuple[float, ...], set[str]]]:
        found = defaultdict(lambda: defaultdict(set))
        with ExitStack() as stack:
            transports, rest = Transports(attacked, stack), 50
            while rest:
                transport = random.choice(TRANSPORTS)
                version, revision, values = transport(transports, motion)
                found[version, revision][values].add(transport.__name__)
                rest -= learnt.is_set()
            for transport in TRANSPORTS:  # each answers at the last revision
                version, revision, values = transport(transports, motion)
                found[version, revision][values].add(transport.__name__)
        return found

    with ThreadPoolExecutor(4) as threads:
        learning = threads.submit(learn)
        askers = [threads.submit(ask) for _ in range(3)]
        learning.result()
        every = defaultdict(lambda: defaultdict(set))
        for asker in askers:
            for key, answers in asker.result().items():
                for values, names in answers.items():
                    every[key][values] |= names
    for key, answers in every.items():
        assert_same(key, answers)
    assert max(len(set().union(*answers.values())) for answers in every.values()) == len(TRANSPORTS)
    assert len(every) > 5
    attacked.check_sound()


def assert_same(key: tuple[int, int], answers: dict[tuple[float, ...], set[str]]) -> None:
    """Check that all answers of a revision are equal to the last bits of their arithmetic."""
    first = next(iter(answers))
    for values, names in answers.items():
        np.testing.assert_allclose(values, first, rtol=1e-9, atol=1e-12, err_msg=f"{key}: {names}")
