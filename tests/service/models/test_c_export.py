"""Export of a version as C: two files, with or without what was learnt online."""

import ctypes
import hashlib

import numpy as np
import pytest

from lipcore.data.samples import Array
from tests.lipcore.export.compiled import compile_library, evaluate_library, needs_compiler
from tests.lipcore.export.models import draw_motions
from tests.service.data import error, service_of
from tests.service.models.archives.packing import exported, unpack
from tests.service.models.versions import publish, publish_arm, trained_model


@pytest.fixture(scope="module")
def arm(api) -> str:
    service = service_of(api)
    publish_arm(service.database, service.files, "c-arm")
    publish(api, "c-none", trained_model())
    return "c-arm"


def compile_model(files, folder):
    return compile_library({name: content.decode() for name, content in files.items()}, folder)


def predictions(api, model: str, motion: Array) -> Array:
    answer = api.post(f"/v1/models/{model}/predict", json=dict(zip(("q", "dq", "ddq"), motion.tolist(), strict=True)))
    return np.array([answer.json()["tau"], answer.json()["tau_std"]])


@needs_compiler
def test_exported_c_computes_the_numbers_of_the_api(api, arm, tmp_path):
    files = unpack(exported(api, arm, format="c"))
    assert set(files) == {"lipserve_model.c", "lipserve_model.h"}
    path = compile_model(files, tmp_path)
    assert ctypes.CDLL(str(path)).lipserve_selftest() == 0
    motion = draw_motions(service_of(api).loaded.get(arm, None).model, 300, 1)
    (tau, std), (mean, deviation) = evaluate_library(path, motion), predictions(api, arm, motion)
    np.testing.assert_allclose(tau, mean, rtol=1e-9, atol=1e-12 * np.abs(mean).max())
    np.testing.assert_allclose(std, deviation, rtol=1e-9)


def test_c_file_names_its_model(api, arm):
    digest = hashlib.sha256(unpack(exported(api, arm))["model.safetensors"]).hexdigest()
    header = unpack(exported(api, arm, format="c", version=1))["lipserve_model.h"].decode()
    values = {"MODEL": f'"{arm}"', "VERSION": 1, "REVISION": 0, "JOINTS": 7, "DIGEST": f'"{digest}"'}
    for name, value in values.items():
        assert f"#define LIPSERVE_{name} {value}\n" in header
    answer = api.get(f"/v1/models/{arm}/export", params={"format": "c"})
    assert answer.headers["content-disposition"] == f'attachment; filename="{arm}-v1-c.tar"'


@pytest.mark.slow
@needs_compiler
def test_c_file_includes_online_learning(api, arm, tmp_path):
    name, service = "c-taught", service_of(api)
    publish_arm(service.database, service.files, name)
    served = service.loaded.get(name, None)
    motion = draw_motions(served.model, 200, 1)
    tau = predictions(api, name, motion)[0] + 0.05 * np.sin(np.arange(200))[:, None]
    values = dict(zip(("q", "dq", "ddq", "tau"), (*motion.tolist(), tau.tolist()), strict=True))
    batch = {"stream_id": "s", "sequence": 0, "t": (0.01 * np.arange(200)).tolist(), **values}
    answer = api.post(f"/v1/models/{name}/observations", json=batch)
    assert answer.status_code == 200, answer.text
    found = {}
    for learnt in (True, False):
        files, folder = unpack(exported(api, name, format="c", learnt=learnt)), tmp_path / str(learnt)
        folder.mkdir()
        found[learnt] = evaluate_library(compile_model(files, folder), motion)[0]
        assert (b"LIPSERVE_REVISION 0\n" in files["lipserve_model.h"]) is not learnt
    np.testing.assert_allclose(found[False], served.base.predict(*motion).tau, rtol=1e-9, atol=1e-10)
    assert np.abs(found[True] - found[False]).max() > 1e-6


def test_other_estimators_and_formats_are_rejected(api, arm):
    refusal = error(api.get("/v1/models/c-none/export", params={"format": "c"}), 422, "invalid_request")
    assert "version 1 of model 'c-none' cannot be written as c: estimator is" in refusal["message"]
    estimators = "rigid-body, rigid-body+local, rigid-body+lip-chain"
    expected = {"field": "version", "expected": f"a version of estimator {estimators}"}
    assert refusal["detail"][0].items() >= expected.items()
    refusal = error(api.get(f"/v1/models/{arm}/export", params={"format": "java"}), 422, "invalid_request")
    assert "format" in str(refusal["detail"])
    for params, status in (({"version": 3}, 404), ({"alias": "no"}, 404), ({"alias": "no", "version": 1}, 422)):
        assert api.get(f"/v1/models/{arm}/export", params={"format": "c", **params}).status_code == status, params
