"""Export of a version as C: two files, with or without what was learnt online."""

import ctypes
import hashlib

import numpy as np
import pytest

from lipcore.data.samples import Array
from tests.lipcore.export.test_c_writer import compile_library, draw_motions, evaluate_library, needs_compiler
from tests.service.data import error, service_of
from tests.service.models.archives.packing import exported, unpack
from tests.service.models.versions import publish, publish_arm, trained_model

FILES = {"lipserve_model.c", "lipserve_model.h"}


@pytest.fixture(scope="module")
def arm(api) -> str:
    service = service_of(api)
    publish_arm(service.database, service.files, "c-arm")
    publish(api, "c-none", trained_model())
    return "c-arm"


def predictions(api, model: str, motion: Array) -> Array:
    q, dq, ddq = motion.tolist()
    answer = api.post(f"/v1/models/{model}/predict", json={"q": q, "dq": dq, "ddq": ddq}).json()
    return np.array([answer["tau"], answer["tau_std"]])


@needs_compiler
def test_exported_c_computes_the_numbers_of_the_api(api, arm, tmp_path):
    files = unpack(exported(api, arm, format="c"))
    assert set(files) == FILES
    path = compile_library({name: content.decode() for name, content in files.items()}, tmp_path)
    assert ctypes.CDLL(str(path)).lipserve_selftest() == 0
    motion = draw_motions(service_of(api).loaded.get(arm, None).model, 300, 1)
    (tau, std), (mean, deviation) = evaluate_library(path, motion), predictions(api, arm, motion)
    np.testing.assert_allclose(tau, mean, rtol=1e-9, atol=1e-12 * np.abs(mean).max())
    np.testing.assert_allclose(std, deviation, rtol=1e-9)


def test_c_file_names_its_model(api, arm):
    archive = unpack(exported(api, arm))
    header = unpack(exported(api, arm, format="c", version=1))["lipserve_model.h"].decode()
    digest = hashlib.sha256(archive["model.safetensors"]).hexdigest()
    for line in (
        f'LIPSERVE_MODEL "{arm}"',
        "LIPSERVE_VERSION 1",
        "LIPSERVE_REVISION 0",
        "LIPSERVE_JOINTS 7",
        f'LIPSERVE_DIGEST "{digest}"',
    ):
        assert f"#define {line}\n" in header
    answer = api.get(f"/v1/models/{arm}/export", params={"format": "c"})
    assert answer.headers["content-disposition"] == f'attachment; filename="{arm}-v1-c.tar"'


@pytest.mark.slow
@needs_compiler
def test_c_file_includes_online_learning(api, arm, tmp_path):
    name = "c-taught"
    service = service_of(api)
    publish_arm(service.database, service.files, name)
    served = service.loaded.get(name, None)
    motion = draw_motions(served.model, 200, 1)
    tau = predictions(api, name, motion)[0] + 0.05 * np.sin(np.arange(200))[:, None]
    q, dq, ddq = motion.tolist()
    batch = {"stream_id": "s", "sequence": 0, "t": (0.01 * np.arange(200)).tolist()}
    batch |= {"q": q, "dq": dq, "ddq": ddq, "tau": tau.tolist()}
    answer = api.post(f"/v1/models/{name}/observations", json=batch)
    assert answer.status_code == 200, answer.text
    files = {learnt: unpack(exported(api, name, format="c", learnt=learnt)) for learnt in (True, False)}
    found = {}
    for learnt, each in files.items():
        folder = tmp_path / str(learnt)
        folder.mkdir()
        path = compile_library({part: content.decode() for part, content in each.items()}, folder)
        found[learnt] = evaluate_library(path, motion)[0]
    assert b"LIPSERVE_REVISION 0\n" in files[False]["lipserve_model.h"]
    assert b"LIPSERVE_REVISION 0\n" not in files[True]["lipserve_model.h"]
    np.testing.assert_allclose(found[False], served.base.predict(*motion).tau, rtol=1e-9, atol=1e-10)
    assert np.abs(found[True] - found[False]).max() > 1e-6


def test_other_estimators_and_formats_are_rejected(api, arm):
    refusal = error(api.get("/v1/models/c-none/export", params={"format": "c"}), 422, "invalid_request")
    assert "version 1 of model 'c-none' cannot be written as C: estimator is" in refusal["message"]
    assert refusal["detail"][0]["field"] == "version"
    assert (
        refusal["detail"][0]["expected"] == "a version of estimator rigid-body, rigid-body+local, rigid-body+lip-chain"
    )
    refusal = error(api.get(f"/v1/models/{arm}/export", params={"format": "java"}), 422, "invalid_request")
    assert "format" in str(refusal["detail"])
    for params, status in (({"version": 3}, 404), ({"alias": "no"}, 404), ({"alias": "no", "version": 1}, 422)):
        assert api.get(f"/v1/models/{arm}/export", params={"format": "c", **params}).status_code == status, params
