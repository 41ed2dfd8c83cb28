"""A version exported and imported again: equal answers, and its origin is recorded."""

import hashlib
import json
import shutil
import subprocess

import numpy as np
import pytest

from service.models import lineage
from tests.service.data import arrays, service_of, stream
from tests.service.models.archives.packing import (
    MANIFEST,
    exported,
    import_archive,
    imported,
    pack,
    unpack,
    with_json,
)
from tests.service.models.versions import predict_json


def test_archive_describes_and_hashes_its_contents(api, trained, archive):
    files = unpack(archive)
    assert set(files) == {"checksums.json", "export.json", "manifest.json", "model.safetensors"}
    sums = json.loads(files.pop("checksums.json"))
    assert sums == {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
    about = json.loads(files["export.json"])
    assert (about["model"], about["version"], about["revision"], about["learnt"]) == (trained.name, 1, 0, False)
    assert about["software"] == lineage.software()
    folder = service_of(api).files.versions
    stored = [path.read_bytes() for path in folder.glob("*/model.safetensors")]
    assert files["model.safetensors"] in stored
    assert unpack(exported(api, trained.name, alias="serving"))["model.safetensors"] == files["model.safetensors"]


def test_imported_version_answers_alike_bit_for_bit(api, trained, archive):
    answer = import_archive(api, archive, name="taken-in")
    assert answer.status_code == 201, answer.text
    assert answer.headers["location"] == "/v1/models/taken-in/versions/1"
    query = {**arrays(stream(seed=12, samples=15), "q", "dq", "ddq"), "covariance": True, "version": 1}
    before, after = (predict_json(api, model, **query) for model in (trained.name, "taken-in"))
    for name in ("tau", "tau_std", "noise_std", "covariance"):
        assert before[name] == after[name]


def test_imported_version_names_its_origin(api, trained, archive):
    version = imported(api, archive, name="import-again")
    original = api.get(f"/v1/models/{trained.name}/versions/1").json()
    origin = version["lineage"].pop("imported")
    assert version["lineage"] == original["lineage"]
    assert [(each["model"], each["version"], each["revision"]) for each in origin] == [(trained.name, 1, 0)]
    assert version["job"] is None
    for name in ("joint_names", "noise_std", "options", "fit", "compact", "calibration", "training_range"):
        assert version[name] == original[name]
    again = imported(api, exported(api, "import-again", version=1), name="import-again")
    assert [each["model"] for each in again["lineage"]["imported"]] == [trained.name, "import-again"]
    assert again["version"] == 2


def test_import_drops_the_signature_of_an_earlier_build(api, files):
    signature = b'{"algorithm": "ed25519", "signer": "ed25519:AAAA", "signature": "of something else"}'
    version = imported(api, pack({"signature.json": signature, **files}), name="signed")
    assert "signed_by" not in version["lineage"]["imported"][0]
    assert set(unpack(exported(api, "signed", version=1))) == set(files)


def test_lineage_with_a_signer_is_read_and_passed_on(api, files):
    signer = "ed25519:11qYAYKxCrfVS/7TyWQHOg7hcvPapiMlrwIaaPcHURo="
    before = [{"model": "arm", "version": 3, "signed_by": signer}]
    signed = with_json(files, MANIFEST, lambda manifest: manifest["lineage"].update(imported=before))
    once = imported(api, pack(signed), name="once-signed")
    again = imported(api, exported(api, "once-signed", version=1), name="again")
    for version in (once, again):
        assert version["lineage"]["imported"][0] == before[0]


def test_archive_has_the_name_of_its_model(api, files):
    named = with_json(files, "export.json", lambda about: about.update(model="named-inside"))
    assert imported(api, pack(named))["model"] == "named-inside"


@pytest.mark.skipif(shutil.which("tar") is None, reason="needs tar")
def test_archive_packed_by_tar_is_imported(api, files, tmp_path):
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    packed = subprocess.run(["tar", "-C", tmp_path, "-cf", "-", *files], capture_output=True, check=True).stdout
    assert imported(api, packed, name="by-tar")


def test_version_has_its_software_hyperparameters_and_metrics(api, trained):
    version = api.get(f"/v1/models/{trained.name}/versions/1").json()
    params = trained.model.posterior.params
    assert version["hyperparameters"] == {name: value.tolist() for name, value in params.items()}
    assert version["lineage"]["software"].keys() >= {"lipserve", "model_format", "python", "scipy", "numpy"}
    assert version["calibration"] == {"function_std_factor": trained.model.calibration.function_std_factor}
    metrics = version["lineage"]["training_metrics"]
    answer = trained.model.predict(trained.samples.q, trained.samples.dq, trained.samples.ddq)
    rmse = np.sqrt(np.mean((answer.tau - trained.samples.tau) ** 2, axis=0))
    assert np.allclose(metrics["rmse"], rmse, rtol=1e-6)
    assert metrics["samples"] == metrics["of"] == len(trained.samples)
    assert all(0 <= each <= 1 for each in metrics["coverage"])


def test_commit_is_known_in_a_checkout_only(tmp_path):
    assert lineage.git_commit(tmp_path) is None
    (tmp_path / ".git").mkdir()  # git finds no repository
    assert lineage.git_commit(tmp_path / ".") is None
