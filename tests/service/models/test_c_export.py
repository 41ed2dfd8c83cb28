"""A version asked for as C: two files, with what it has learnt, or as it was trained."""

import ctypes
import hashlib

import numpy as np
import pytest

from lipcore.data.samples import Array
from tests.lipcore.test_c_writer import asked, compiled, drawn, needs_compiler
from tests.service.archives.packing import exported, unpack
from tests.service.data import error, service_of
from tests.service.models.versions import publish, publish_arm, trained

FILES = {"lipserve_model.c", "lipserve_model.h"}


@pytest.fixture(scope="module")
def arm(api) -> str:
    service = service_of(api)
    publish_arm(service.database, service.files, "c-arm")
    publish(api, "c-none", trained())
    return "c-arm"


def answers(api, model: str, motion: Array) -> Array:
    q, dq, ddq = motion.tolist()
    answer = api.post(f"/v1/models/{model}/predict", json={"q": q, "dq": dq, "ddq": ddq}).json()
    return np.array([answer["tau"], answer["tau_std"]])


@needs_compiler
def test_its_numbers_are_those_of_the_api(api, arm, tmp_path):
    files = unpack(exported(api, arm, format="c"))
    assert set(files) == FILES
    path = compiled({name: content.decode() for name, content in files.items()}, tmp_path)
    assert ctypes.CDLL(str(path)).lipserve_selftest() == 0
    motion = drawn(service_of(api).loaded.get(arm, None).model, 300, 1)
    (tau, std), (mean, deviation) = asked(path, motion), answers(api, arm, motion)
    np.testing.assert_allclose(tau, mean, rtol=1e-9, atol=1e-12 * np.abs(mean).max())
    np.testing.assert_allclose(std, deviation, rtol=1e-9)


def test_the_file_says_what_it_is_of(api, arm):
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


@needs_compiler
def test_what_was_learnt_online_is_in_it(api, arm, tmp_path):
    name = "c-taught"
    service = service_of(api)
    publish_arm(service.database, service.files, name)
    served = service.loaded.get(name, None)
    motion = drawn(served.model, 200, 1)
    tau = answers(api, name, motion)[0] + 0.05 * np.sin(np.arange(200))[:, None]
    q, dq, ddq = motion.tolist()
    batch = {"stream_id": "s", "sequence": 0, "t": (0.01 * np.arange(200)).tolist()}
    batch |= {"q": q, "dq": dq, "ddq": ddq, "tau": tau.tolist()}
    taught = api.post(f"/v1/models/{name}/observations", json=batch)
    assert taught.status_code == 200, taught.text
    files = {learnt: unpack(exported(api, name, format="c", learnt=learnt)) for learnt in (True, False)}
    found = {}
    for learnt, each in files.items():
        folder = tmp_path / str(learnt)
        folder.mkdir()
        path = compiled({part: content.decode() for part, content in each.items()}, folder)
        found[learnt] = asked(path, motion)[0]
    assert b"LIPSERVE_REVISION 0\n" in files[False]["lipserve_model.h"]
    assert b"LIPSERVE_REVISION 0\n" not in files[True]["lipserve_model.h"]
    np.testing.assert_allclose(found[False], served.base.predict(*motion).tau, rtol=1e-9, atol=1e-10)
    assert np.abs(found[True] - found[False]).max() > 1e-6


def test_other_estimators_and_formats_are_refused(api, arm):
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
