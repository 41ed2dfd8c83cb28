"""The Open Inference Protocol over gRPC with NVIDIA's client: answers equal those over HTTP."""

import json
import threading
from collections.abc import Iterator

import grpc
import numpy as np
import pytest
import tritonclient.grpc as triton
from google.protobuf.descriptor import FieldDescriptor
from numpy.testing import assert_array_equal
from tritonclient.grpc import service_pb2 as published
from tritonclient.utils import InferenceServerException

from service import __version__
from service.api.limits.requests import ClientPatience
from service.api.oip.query import COMPONENT_TENSORS
from service.api.oip.rpc.messages import MAX_ITEMS
from tests.service.api.oip.grpc import Code, GrpcService, grpc_request, request, start_service
from tests.service.api.oip.requests import (
    BATCH,
    EXTENSIONS,
    MOTION,
    error_message,
    infer_path,
    json_answer,
    message,
    wrong_requests,
)
from tests.service.data import DEADLINE, eventually

pytestmark = pytest.mark.slow  # needs Triton's client

definition = pytest.importorskip("service.api.oip.rpc.definition")
MAX_BYTES = 20_000
BODY_S = 1.0
ROUTE = "/inference.GRPCInferenceService/ModelInfer"


@pytest.fixture(scope="module")
def calls(tmp_path_factory) -> Iterator[GrpcService]:
    settings = {"LIPSERVE_MAX_REQUEST_BYTES": str(MAX_BYTES), "LIPSERVE_LOG_FORMAT": "json"}
    # every rejection is logged
    limits: dict[str, object] = {}
    for place in ("service.app", "service.planes.calls"):
        limits[f"{place}.PATIENCE"] = ClientPatience(body_s=BODY_S)
    for place in ("service.app", "service.planes.answers"):
        limits[f"{place}.MAX_REFUSALS_PER_S"] = 1000
    with start_service(tmp_path_factory.mktemp("grpc") / "home", limits, **settings) as service:
        yield service


@pytest.fixture(scope="module")
def client(calls) -> Iterator[triton.InferenceServerClient]:
    """NVIDIA's client."""
    with triton.InferenceServerClient(f"127.0.0.1:{calls.port}") as connected:
        yield connected


def inputs(motion, datatype="FP64"):
    made = [triton.InferInput(name, list(np.shape(values)), datatype) for name, values in motion.items()]
    for tensor, values in zip(made, motion.values(), strict=True):
        tensor.set_data_from_numpy(np.array(values, {"FP64": np.float64, "FP32": np.float32}[datatype]))
    return made


PARTIAL = {"ModelConfig", "ModelInput", "ModelOutput", "ModelStatistics"}
PARTIAL |= {"RepositoryModelLoadRequest", "RepositoryModelUnloadRequest"}
"""Messages that have further fields, which the service neither reads nor writes."""


def fields(descriptor):
    """Return name, number, type and shape of all fields of a message; numbers encode enumerations."""
    return {
        (
            each.name,
            each.number,
            FieldDescriptor.TYPE_INT32 if each.enum_type else each.type,
            each.is_repeated,
            each.message_type and each.message_type.full_name,
        )
        for each in descriptor.fields
    }


def test_messages_are_the_published_ones():
    names = set()
    for name in definition.POOL.FindFileByName("lipserve/open_inference.proto").message_types_by_name:
        pending = [definition.POOL.FindMessageTypeByName(f"inference.{name}")]
        while pending:
            ours = pending.pop()
            theirs = published.DESCRIPTOR.pool.FindMessageTypeByName(ours.full_name)
            missing = fields(theirs) - fields(ours)
            assert fields(ours) <= fields(theirs), ours.full_name
            assert not missing or ours.name in PARTIAL, ours.full_name
            assert ours.GetOptions().map_entry == theirs.GetOptions().map_entry
            if ours.name not in PARTIAL:
                assert [each.name for each in ours.oneofs] == [each.name for each in theirs.oneofs]
            pending += ours.nested_types
            names.add(ours.full_name)
    assert {"inference.ModelInferRequest.InferInputTensor.ParametersEntry", "inference.InferParameter"} <= names
    types = {each.type for each in definition.message("InferParameter").DESCRIPTOR.fields}
    assert FieldDescriptor.TYPE_DOUBLE in types


def test_client_sees_server_and_model(calls, client):
    assert client.is_server_live()
    assert client.is_server_ready()
    assert client.is_model_ready("panda-sim")
    assert client.is_model_ready("panda-sim", "1")
    seen = client.get_server_metadata(as_json=True)
    assert seen == {"name": "lipserve", "version": __version__, "extensions": EXTENSIONS}
    found = client.get_model_metadata("panda-sim")
    expected = calls.server.client.get("/v2/models/panda-sim").json()
    assert (found.name, list(found.versions), found.platform) == ("panda-sim", ["1"], expected["platform"])
    for ours, theirs in ((found.inputs, expected["inputs"]), (found.outputs, expected["outputs"])):
        assert [(each.name, each.datatype, list(each.shape)) for each in ours] == [
            (each["name"], each["datatype"], each["shape"]) for each in theirs
        ]


def test_client_reads_index_config_and_statistics(calls, client):
    (listed,) = client.get_model_repository_index().models
    assert (listed.name, listed.version, listed.state) == ("panda-sim", "1", "READY")
    found, expected = client.get_model_config("panda-sim", as_json=True)["config"], http_config(calls)
    assert (found["name"], found["backend"]) == ("panda-sim", "lipserve")
    for kind in ("input", "output"):
        described = [(each["name"], each["data_type"], each["dims"]) for each in expected[kind]]
        assert [(each["name"], each["data_type"], [*map(int, each["dims"])]) for each in found[kind]] == described
    before = client.get_inference_statistics("panda-sim", "1").model_stats[0]
    client.infer("panda-sim", inputs(BATCH))
    (after,) = client.get_inference_statistics().model_stats
    assert after.inference_count - before.inference_count == len(BATCH["q"])
    assert after.inference_stats.success.count - before.inference_stats.success.count == 1
    with pytest.raises(InferenceServerException, match="POST /v1/models/import"):
        client.load_model("panda-sim")
    with pytest.raises(InferenceServerException, match="DELETE /v1/models/panda-sim"):
        client.unload_model("panda-sim")


def http_config(calls):
    return calls.server.client.get("/v2/models/panda-sim/config").json()


@pytest.mark.parametrize("motion", [MOTION, BATCH], ids=["query", "batch"])
def test_grpc_answers_equal_http_bit_for_bit(calls, client, motion):
    result = client.infer("panda-sim", inputs(motion), request_id="7")
    response = result.get_response()
    assert (response.id, response.model_name, response.model_version) == ("7", "panda-sim", "1")
    assert response.parameters["revision"].int64_param == 0
    assert response.parameters["torque_convention"].string_param == "gravity_included"
    expected = json_answer(calls.server, motion)
    assert [each.name for each in response.outputs] == list(expected) == ["tau", "tau_std"]
    for name, values in expected.items():
        assert result.as_numpy(name).dtype == np.float64
        assert_array_equal(result.as_numpy(name), values)


@pytest.mark.parametrize("motion", [MOTION, BATCH], ids=["query", "batch"])
def test_client_gets_the_requested_outputs(calls, client, motion):
    names = ("tau_gravity", "covariance", "noise_std", "kinetic_energy", "inertia_matrix_std", "forward_dynamics")
    outputs = [triton.InferRequestedOutput(name) for name in names]
    motion = motion | {"tau": np.ones(np.shape(motion["q"]))}
    result = client.infer("panda-sim", inputs(motion), model_version="1", outputs=outputs)
    for name, values in json_answer(calls.server, motion, *names).items():
        assert_array_equal(result.as_numpy(name), values, err_msg=name)


@pytest.mark.parametrize("datatype", ["FP64", "FP32"])
@pytest.mark.parametrize("motion", [MOTION, BATCH], ids=["query", "batch"])
def test_typed_contents_equal_raw_contents(calls, client, motion, datatype):
    answer = calls.stub.ModelInfer(request(motion, datatype=datatype, raw=False), timeout=DEADLINE)
    raw = client.infer("panda-sim", inputs(motion, datatype))
    assert list(answer.raw_output_contents) == []
    for tensor in answer.outputs:
        values = np.reshape(tensor.contents.fp64_contents, list(tensor.shape))
        assert_array_equal(values, raw.as_numpy(tensor.name))


def changed(change, motion=MOTION, **options):
    made = request(motion, **options)
    change(made)
    return made


REJECTED_REQUESTS = {
    **{kind: (grpc_request(wrong), words) for kind, (wrong, words) in wrong_requests(MOTION, "panda_joint1").items()},
    "too few bytes": (
        changed(lambda r: r.raw_input_contents.__setitem__(1, b"1234")),
        "raw_input_contents[1] is 4 bytes, expected 56 bytes for dq with shape [7] of FP64",
    ),
    "too few raw": (
        changed(lambda r: r.raw_input_contents.pop()),
        "`raw_input_contents` has 2 entries, expected one for each of the 3 inputs.",
    ),
    "raw and typed": (
        changed(lambda r: r.inputs[2].contents.fp64_contents.append(1.0)),
        "Both `ddq.contents` and `raw_input_contents` are given.",
    ),
    "too few numbers": (
        changed(lambda r: r.inputs[0].contents.fp64_contents.pop(), raw=False),
        "`q.contents.fp64_contents` has 6 numbers, expected 7 for shape [7].",
    ),
    "other contents": (
        changed(lambda r: setattr(r.inputs[0], "datatype", "FP32"), raw=False),
        "`q.contents.fp32_contents` has 0 numbers, expected 7",
    ),
    "not finite": (request(MOTION | {"dq": [0.0, *[np.nan] * 6]}), "dq[1] is nan, expected a finite number of FP64"),
    "no model": (request(MOTION, model_name=""), "`model_name` is required."),
}


@pytest.mark.parametrize("kind", REJECTED_REQUESTS)
def test_wrong_requests_are_rejected(calls, kind):
    wrong, words = REJECTED_REQUESTS[kind]
    error = calls.call_error(calls.stub.ModelInfer, wrong)
    assert (error.code(), error.details()[: len(words)]) == (Code.INVALID_ARGUMENT, words)
    assert dict(error.trailing_metadata())["lipserve-error-code"] == "invalid_request"


def test_oversized_repeated_fields_are_rejected_quickly(calls, client):
    """Millions of inputs, outputs or axes: the first wrong one is reported."""
    assert len(client.get_model_metadata("panda-sim").outputs) + len(COMPONENT_TENSORS) < MAX_ITEMS
    for many, words in (
        (changed(lambda r: [r.inputs.add() for _ in range(5000)]), "inputs[3].name is , expected one of q, dq, ddq"),
        (changed(lambda r: [r.outputs.add(name="tau") for _ in range(2000)]), "Output `tau` is requested twice."),
        (changed(lambda r: r.inputs[0].shape.extend([1] * 9000)), "q.shape is [7, 1, 1"),
    ):
        assert calls.call_error(calls.stub.ModelInfer, many).details().startswith(words)


def test_trusted_proxy_names_the_client(calls):
    named = (("x-forwarded-for", "203.0.113.7"), ("x-request-id", "far-1"))
    calls.call_error(calls.stub.ModelInfer, request(MOTION, "x"), metadata=named)
    lines = eventually(lambda: [line for line in calls.server.log.read_text().splitlines() if "far-1" in line])
    assert json.loads(lines[0])["client"] == "203.0.113.7"


def test_errors_have_the_words_of_http(calls, client):
    narrow = {name: [0.0] * 3 for name in MOTION}
    http = error_message(calls.server.client.post(infer_path("panda-sim"), json=message(narrow)))
    assert calls.call_error(calls.stub.ModelInfer, request(narrow)).details() == http
    for name, version in (("nobody", ""), ("panda-sim", "2"), ("panda-sim", "nothing"), ("x" * 5000, "")):
        http = error_message(calls.server.client.post(infer_path(name, version or None), json=message(MOTION)), 404)
        error = calls.call_error(calls.stub.ModelInfer, request(MOTION, model_name=name, model_version=version))
        assert (error.code(), error.details()) == (Code.NOT_FOUND, http)
        for method, kind in (("ModelReady", "ModelReadyRequest"), ("ModelMetadata", "ModelMetadataRequest")):
            query = getattr(published, kind)(name=name, version=version)
            assert calls.call_error(getattr(calls.stub, method), query).code() == Code.NOT_FOUND
    with pytest.raises(InferenceServerException, match=r"INVALID_ARGUMENT.*q\.shape is \[3\], expected \[7\]"):
        client.infer("panda-sim", inputs(narrow))


def test_invalid_protobuf_and_unknown_methods_are_rejected(calls, client):
    method = calls.channel.unary_unary(ROUTE)
    for data in (b"\xff", b"\x0a\x05ab", b"\x0a\x02\xff\xfe"):  # the last name is not UTF-8
        error = calls.call_error(method, data)
        assert error.code() == Code.INVALID_ARGUMENT
        assert error.details().startswith("The message is not a valid inference.ModelInferRequest: ")
    assert calls.call_error(method, b"").details().startswith("`model_name` is required.")
    for call in (client.get_trace_settings, client.get_log_settings):
        with pytest.raises(InferenceServerException) as caught:
            call()
        assert caught.value.status() == "StatusCode.UNIMPLEMENTED"
    # an HTTP request reaches no method
    answer = calls.server.client.post("/inference.GRPCInferenceService/ServerLive", content=b"")
    assert answer.status_code == 404


def test_messages_beyond_the_limit_are_rejected(calls):
    rows = {name: np.zeros((MAX_BYTES // 168 + 1, 7)) for name in MOTION}
    assert calls.call_error(calls.stub.ModelInfer, request(rows)).code() == Code.RESOURCE_EXHAUSTED
    fitting = {name: np.tile(values, (100, 1)) for name, values in MOTION.items()}
    answer = calls.stub.ModelInfer(request(fitting, "tau"), timeout=DEADLINE)
    assert_array_equal(
        np.frombuffer(answer.raw_output_contents[0]).reshape(100, 7), json_answer(calls.server, BATCH)["tau"][[0] * 100]
    )
    error = calls.call_error(calls.stub.ModelInfer, request(fitting), compression=grpc.Compression.Gzip)
    assert error.code() == Code.UNIMPLEMENTED
    padded = (("x-padding", "x" * 100_000),)
    assert calls.call_error(calls.stub.ModelInfer, request(MOTION), metadata=padded).code() == Code.RESOURCE_EXHAUSTED


def test_calls_end_at_their_deadline_or_their_message_timeout(calls):
    enough = threading.Event()

    def never():
        enough.wait(DEADLINE)
        yield b""

    method = calls.channel.stream_unary(ROUTE)
    with pytest.raises(grpc.RpcError) as caught:
        method(never(), timeout=0.05)
    assert (caught.value.code(), caught.value.details()) == (Code.DEADLINE_EXCEEDED, "Deadline Exceeded")
    eventually(lambda: metric_lines(calls, "lipserve_requests_total", 'status="499"'))
    error = calls.call_error(method, never())
    enough.set()
    expected = "The body arrived too slowly: 0 bytes so far."
    assert (error.code(), error.details()) == (Code.DEADLINE_EXCEEDED, expected)


def metric_lines(calls, metric, *labels):
    """Return the lines of an inference metric that have these labels."""
    lines = calls.server.client.get("/metrics").text.splitlines()
    return [line for line in lines if line.startswith(metric) and all(each in line for each in (ROUTE, *labels))]


def test_calls_are_named_counted_and_logged(calls):
    _, call = calls.stub.ModelInfer.with_call(request(MOTION), metadata=(("x-request-id", "cell-3.7"),))
    assert dict(call.trailing_metadata())["x-request-id"] == "cell-3.7"
    error = calls.call_error(calls.stub.ModelInfer, request(MOTION, "x"), metadata=(("x-request-id", "wrong-1"),))
    assert dict(error.trailing_metadata())["x-request-id"] == "wrong-1"
    lines = eventually(lambda: [line for line in calls.server.log.read_text().splitlines() if "wrong-1" in line])
    entry, expected = json.loads(lines[0]), {"status": 422, "code": "invalid_request", "client": "127.0.0.1"}
    assert entry == entry | expected | {"route": ROUTE}
    assert metric_lines(calls, "lipserve_requests_total", 'status="422"')
    assert metric_lines(calls, "lipserve_request_duration_seconds_count", 'model="panda-sim"')
