"""gRPC of a service with two planes: the data plane answers queries, and forwards the rest with its client and key."""

import json
import os
import signal
import sys
from collections.abc import Iterator

import pytest
from tritonclient.grpc import service_pb2 as published

from service.api.access import keys
from service.foundation.settings import Settings
from service.storage.database import Database
from tests.service.api.oip.grpc import Code, GrpcService, request, start_service
from tests.service.data import DEADLINE, eventually
from tests.service.planes.test_sums import BATCH, LIVE, MODEL, MOTION, READY, kill, process_of, samples

# slow: needs Triton's client
pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform != "linux", reason="planes need Linux")]
SETTINGS = {"LIPSERVE_DATA_PLANE": "on", "LIPSERVE_LOG_FORMAT": "json"}


@pytest.fixture(scope="module")
def calls(tmp_path_factory) -> Iterator[GrpcService]:
    with start_service(tmp_path_factory.mktemp("calls") / "home", **SETTINGS) as service:
        eventually(lambda: plane_of(service, MOTION) == LIVE)
        yield service


def infer(service, motion, **options):
    """Return the answer and its metadata."""
    return service.stub.ModelInfer.with_call(
        request(motion), **{"timeout": DEADLINE, "wait_for_ready": True, **options}
    )


def plane_of(service, motion) -> str:
    """Return the path of the process that answers a call."""
    process = dict(infer(service, motion)[1].trailing_metadata())["x-request-id"].partition("-")[0]
    ids = {path: service.server.client.get(path).headers["x-request-id"].partition("-")[0] for path in (LIVE, READY)}
    return next(path for path, name in ids.items() if name == process)


def test_queries_are_answered_by_the_data_plane_and_batches_by_the_other(calls):
    assert (plane_of(calls, MOTION), plane_of(calls, BATCH)) == (LIVE, READY)
    one, many = (infer(calls, motion)[0].raw_output_contents for motion in (MOTION, BATCH))
    for short, long in zip(one, many, strict=True):
        assert len(long) == 3 * len(short)


def test_both_planes_count_calls_together(calls):
    def counts() -> tuple[float, int]:
        counted = samples(calls.server, "lipserve_requests_total")
        of_model = calls.stub.ModelStatistics(published.ModelStatisticsRequest(name=MODEL), timeout=DEADLINE)
        (statistics,) = of_model.model_stats
        return counted["POST", "/inference.GRPCInferenceService/ModelInfer", "200"], statistics.inference_count

    before = counts()
    for _ in range(4):
        infer(calls, MOTION)
        infer(calls, BATCH)
    after = counts()
    assert (after[0] - before[0], after[1] - before[1]) == (8, 16)


def test_queries_go_on_without_the_control_plane(calls):
    pid = process_of(calls.server, READY)
    os.kill(pid, signal.SIGSTOP)
    try:
        assert calls.stub.ServerLive(published.ServerLiveRequest(), timeout=DEADLINE).live
        assert len(infer(calls, MOTION)[0].outputs) == 2
        with pytest.raises(Exception, match="Deadline Exceeded"):
            infer(calls, BATCH, timeout=0.5)
    finally:
        os.kill(pid, signal.SIGCONT)
    assert len(infer(calls, BATCH)[0].outputs) == 2


def test_calls_are_answered_again_after_the_end_of_each_plane(calls):
    for path in (READY, LIVE):
        kill(calls.server, path)
        eventually(lambda: len(infer(calls, MOTION)[0].outputs) == 2)
        eventually(lambda: len(infer(calls, BATCH)[0].outputs) == 2)


def test_call_fails_while_there_is_no_control_plane(calls):
    seen = set()
    os.kill(process_of(calls.server, READY), signal.SIGKILL)

    def is_back() -> bool:
        try:
            infer(calls, BATCH)
        except Exception as error:
            seen.add((error.code(), dict(error.trailing_metadata()).get("lipserve-error-code")))
            return False
        return True

    eventually(is_back)
    assert seen <= {(Code.UNAVAILABLE, "not_ready")}


def test_client_of_a_forwarded_call_is_the_real_one(calls):
    pretended = (("lipserve-client", "ipv4:10.9.8.7:1"), ("lipserve-counted", "1"), ("x-request-id", "pretended"))
    error = calls.call_error(calls.stub.ModelInfer, request(MOTION, model_name="nobody"), metadata=pretended)
    assert error.code() == Code.NOT_FOUND
    lines = [json.loads(line) for line in calls.server.log.read_text().splitlines() if '"pretended"' in line]
    assert [line["client"] for line in lines] == ["127.0.0.1"]


def test_forwarded_calls_are_counted_once(tmp_path):
    home = tmp_path / "home"
    database = Database.of(Settings(home=home))
    _, secret = keys.create(database, "own", ["predict"], None, max_requests_per_s=0.4)
    database.close()
    with start_service(home, LIPSERVE_KEYS="on", LIPSERVE_MAX_REQUEST_BURST="100", **SETTINGS) as service:
        allowed = {"metadata": (("authorization", f"Bearer {secret}"),)}
        for _ in range(4):  # 10 s of its rate at once
            infer(service, BATCH, **allowed)
        for motion in (BATCH, MOTION):
            error = service.call_error(service.stub.ModelInfer, request(motion), **allowed)
            assert (error.code(), "at most 0.4 per s" in error.details()) == (Code.RESOURCE_EXHAUSTED, True)
