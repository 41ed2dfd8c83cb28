"""The Open Inference Protocol over real sockets, with hand-written messages and with NVIDIA's client."""

from collections.abc import Iterator

import numpy as np
import pytest
import tritonclient.http as triton
from numpy.testing import assert_array_equal
from tritonclient.utils import InferenceServerException

from service import __version__
from tests.service.api.oip.requests import BATCH, EXTENSIONS, MOTION, json_answer
from tests.service.data import DEADLINE

pytestmark = pytest.mark.slow  # needs Triton's client


@pytest.fixture(scope="module")
def client(server) -> Iterator[triton.InferenceServerClient]:
    with triton.InferenceServerClient(server.url.removeprefix("http://"), network_timeout=DEADLINE) as connected:
        yield connected


def inputs(motion, binary=True):
    made = [triton.InferInput(name, list(np.shape(values)), "FP64") for name, values in motion.items()]
    for tensor, values in zip(made, motion.values(), strict=True):
        tensor.set_data_from_numpy(np.array(values, np.float64), binary_data=binary)
    return made


def test_client_sees_server_and_model(server, client):
    assert client.is_server_live()
    assert client.is_server_ready()
    assert client.is_model_ready("panda-sim")
    assert client.is_model_ready("panda-sim", "1")
    assert not client.is_model_ready("panda-sim", "2")
    assert not client.is_model_ready("nobody")
    server_ = {"name": "lipserve", "version": __version__, "extensions": EXTENSIONS}
    assert client.get_server_metadata() == server_
    assert client.get_model_metadata("panda-sim") == server.client.get("/v2/models/panda-sim").json()


@pytest.mark.parametrize("motion", [MOTION, BATCH], ids=["query", "batch"])
@pytest.mark.parametrize("binary", [True, False])
def test_client_gets_the_default_outputs(server, client, motion, binary):
    result = client.infer("panda-sim", inputs(motion, binary=binary), request_id="7")
    response = result.get_response()
    assert (response["id"], response["model_name"], response["model_version"]) == ("7", "panda-sim", "1")
    assert response["parameters"] == {"revision": 0, "torque_convention": "gravity_included"}
    for name, values in json_answer(server, motion).items():
        assert result.as_numpy(name).dtype == np.float64
        assert_array_equal(result.as_numpy(name), values)


@pytest.mark.parametrize("motion", [MOTION, BATCH], ids=["query", "batch"])
def test_client_gets_the_requested_outputs(server, client, motion):
    names = ("tau_gravity", "covariance", "noise_std", "kinetic_energy", "inertia_matrix_std")
    outputs = [triton.InferRequestedOutput(name, binary_data=place % 2 == 0) for place, name in enumerate(names)]
    result = client.infer("panda-sim", inputs(motion), model_version="1", outputs=outputs)
    for name, values in json_answer(server, motion, *names).items():
        assert_array_equal(result.as_numpy(name), values, err_msg=name)


def test_client_reads_index_config_and_statistics(server, client):
    index = [{"name": "panda-sim", "version": "1", "state": "READY", "reason": ""}]
    assert client.get_model_repository_index() == index
    assert client.get_model_config("panda-sim", "1")["max_batch_size"] == 0
    (before,) = client.get_inference_statistics()["model_stats"]
    client.infer("panda-sim", inputs(BATCH))
    (after,) = client.get_inference_statistics("panda-sim", "1")["model_stats"]
    assert after["inference_count"] - before["inference_count"] == len(BATCH["q"])
    with pytest.raises(InferenceServerException, match=r"\[400\] Models are not loaded or unloaded by request"):
        client.load_model("panda-sim")


def test_client_reads_errors(client):
    with pytest.raises(InferenceServerException, match=r"\[404\] No model is named 'nobody'"):
        client.infer("nobody", inputs(MOTION))
    with pytest.raises(InferenceServerException, match=r"\[400\] q\.shape is \[3\], expected \[7\]"):
        client.infer("panda-sim", inputs({name: [0.0] * 3 for name in MOTION}))
