"""A model on disk: the same model back, and anything else refused by name."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors

from lipcore import FitOptions, ModelFormatError, Samples, TorqueModel, copy_model, load, save, train
from lipcore.files import persistence
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Stream, simulate
from tests.choosing import slow


@pytest.fixture(scope="module")
def samples() -> Samples:
    return simulate(load_robot("double-pendulum"), Stream(n_samples=60, speed=10, noise=0.01), seed=1)


@pytest.fixture(scope="module", params=["lip-chain", slow("lip"), slow("lip untied")])
def model(request: pytest.FixtureRequest, samples: Samples) -> TorqueModel:
    name, *untied = request.param.split()
    options = FitOptions(hyperparameter_samples=20, max_iterations=10, starts=1, tied=not untied, device="cpu")
    return train(samples, ("revolute",) * 2, name, options, torque_convention="gravity_compensated")


@pytest.fixture
def folder(model: TorqueModel, tmp_path: Path) -> Path:
    save(model, tmp_path / "model", {"dataset": "d-1"})
    return tmp_path / "model"


def edit_manifest(folder: Path, **changes: Any) -> None:
    path = folder / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def edit_tensors(folder: Path, edit: Callable[[dict[str, torch.Tensor]], object]) -> None:
    """Change the tensors and make the manifest vouch for the change."""
    path = folder / "model.safetensors"
    tensors = load_tensors(path.read_bytes())
    edit(tensors)
    payload = save_tensors(tensors)
    path.write_bytes(payload)
    entry = {"file": path.name, "bytes": len(payload), "sha256": hashlib.sha256(payload).hexdigest()}
    edit_manifest(folder, tensors=entry)


def test_loaded_model_answers_as_the_saved_one(model: TorqueModel, samples: Samples, folder: Path) -> None:
    again = load(folder)
    query = samples.q + 0.1, 0.5 * samples.dq, samples.ddq
    before, after = model.predict(*query, covariance=True), again.predict(*query, covariance=True)
    for name in ("tau", "tau_std", "noise_std", "covariance"):
        assert np.array_equal(getattr(before, name), getattr(after, name)), name
    for name in (
        "joint_names",
        "joint_types",
        "torque_convention",
        "options",
        "fit",
        "compact",
        "training_range",
        "calibration",
    ):
        assert getattr(again, name) == getattr(model, name)
    assert again.estimator.name == model.estimator.name


def test_manifest_can_be_read_and_vouches_for_the_tensors(model: TorqueModel, folder: Path) -> None:
    manifest = json.loads((folder / "manifest.json").read_text())
    payload = (folder / "model.safetensors").read_bytes()
    assert manifest == persistence.read_manifest(folder)
    assert manifest["tensors"]["sha256"] == hashlib.sha256(payload).hexdigest()
    assert manifest["tensors"]["bytes"] == len(payload)
    assert (manifest["format"], manifest["format_version"]) == ("lipserve-model", 3)
    assert manifest["joint_names"] == list(model.joint_names)
    assert manifest["noise_std"] == model.noise_std.tolist()
    assert manifest["torque_convention"] == "gravity_compensated"
    assert manifest["lineage"] == {"dataset": "d-1"}
    assert sorted(path.name for path in folder.iterdir()) == ["manifest.json", "model.safetensors"]


def test_copy_is_the_same_model(folder: Path, tmp_path: Path) -> None:
    copy = tmp_path / "deep" / "copy"
    assert copy_model(folder, copy) == persistence.read_manifest(folder)
    for name in ("manifest.json", "model.safetensors"):
        assert (copy / name).read_bytes() == (folder / name).read_bytes()


def test_existing_folder_is_never_overwritten(model: TorqueModel, folder: Path) -> None:
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(FileExistsError, match="never overwritten"):
        save(model, folder)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_failure_while_saving_leaves_nothing_behind(
    model: TorqueModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = persistence._write

    def full_disk(path: Path, content: bytes) -> None:
        if path.name == "manifest.json":
            raise OSError("no space left on device")
        write(path, content)

    monkeypatch.setattr(persistence, "_write", full_disk)
    with pytest.raises(OSError, match="no space left"):
        save(model, tmp_path / "model")
    assert list(tmp_path.iterdir()) == []


def test_lineage_that_json_cannot_hold_leaves_nothing_behind(model: TorqueModel, tmp_path: Path) -> None:
    with pytest.raises(TypeError):
        save(model, tmp_path / "model", {"object": object()})
    assert list(tmp_path.iterdir()) == []


def test_tampered_tensors_are_refused(folder: Path, tmp_path: Path) -> None:
    path = folder / "model.safetensors"
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    with pytest.raises(ModelFormatError, match=r"model\.safetensors does not match the sha256"):
        load(folder)
    with pytest.raises(ModelFormatError, match="sha256"):
        copy_model(folder, tmp_path / "copy")
    assert not (tmp_path / "copy").exists()


def test_truncated_tensors_are_refused(folder: Path) -> None:
    path = folder / "model.safetensors"
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ModelFormatError, match="sha256"):
        load(folder)


@pytest.mark.parametrize("name", ["manifest.json", "model.safetensors"])
def test_missing_file_is_named(folder: Path, name: str) -> None:
    (folder / name).unlink()
    with pytest.raises(ModelFormatError, match=f"{name} cannot be read"):
        load(folder)


def test_manifest_that_is_not_json_is_refused(folder: Path) -> None:
    path = folder / "manifest.json"
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(ModelFormatError, match=r"manifest\.json cannot be read"):
        load(folder)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format": "zip"}, "not a manifest of format 'lipserve-model'"),
        ({"format_version": 2}, "format_version is 2, expected 3: train the model again"),
        ({"estimator": 7}, "estimator is 7, expected 1 to 100 printable characters"),
        ({"estimator": "oracle"}, "estimator is 'oracle'"),
        ({"joint_names": "joint1"}, "joint_names is 'joint1', expected a list of 1 to 256 names"),
        ({"joint_names": ["joint1"]}, "joint_types is a list of 2 entries, expected a list of 1"),
        ({"joint_types": ["revolute", "ball"]}, r"joint_types\[1\] is 'ball'"),
        ({"joint_types": ["revolute"]}, "joint_types is a list of 1 entries, expected a list of 2"),
        ({"joint_types": ["revolute"] * 3}, "joint_types is a list of 3 entries, expected a list of 2"),
        ({"torque_convention": "unsaid"}, "torque_convention is 'unsaid'"),
        ({"options": []}, "options is a list of 0 entries, expected an object"),
        ({"compact": 3}, "compact is 3, expected an object"),
        ({"compact": {}}, "compact.data_samples is None, expected a number"),
        ({"training_range": []}, "training_range is a list of 0 entries, expected an object"),
        ({"calibration": None}, "calibration is None, expected an object"),
        ({"calibration": {"function_std_factor": 0.9}}, "function_std_factor is 0.9, expected a number from 1 to 100"),
        ({"calibration": {"function_std_factor": "2"}}, "calibration.function_std_factor is '2', expected a number"),
        ({"calibration": {"factor": 2.0}}, "calibration lacks function_std_factor"),
        ({"tensors": {}}, "tensors lacks file"),
    ],
    ids=str,
)
def test_wrong_manifest_entry_is_named(folder: Path, changes: dict[str, Any], message: str) -> None:
    edit_manifest(folder, **changes)
    with pytest.raises(ModelFormatError, match=message):
        load(folder)


@pytest.mark.parametrize(
    ("name", "replacement", "message"),
    [
        ("params/kinetic.log_gap", torch.zeros(3).double(), r"'kinetic.log_gap' has shape \(3,\), expected \(2,\)"),
        ("params/noise.log_std", torch.zeros(1).double(), r"'noise.log_std' has shape \(1,\), expected \(2,\)"),
        ("params/surprise", torch.zeros(1).double(), r"'surprise' has shape \(1,\), expected None"),
        ("params/kinetic.log_scale", None, r"'kinetic.log_scale' has shape None, expected \(\)"),
        ("params/noise.log_std", torch.full((2,), torch.nan).double(), "'params/noise.log_std' is not made of finite"),
        ("statistics/a", torch.full((6,), torch.inf).double(), "statistics/a has shape"),
        ("statistics/b", torch.zeros(40), "'statistics/b' is of type 'F32', expected float64"),
        (
            "statistics/b",
            torch.zeros(3).double(),
            r"statistics/a has shape \(\d+,\), expected M \(M \+ 1\) / 2 numbers, 6",
        ),
        ("statistics/a", torch.zeros(6).double(), r"statistics/a has shape \(6,\), expected M"),
        ("statistics/a", torch.zeros(5).double(), r"statistics/a has shape \(5,\), expected M \(M \+ 1\) / 2 numbers"),
        ("inducing/ddq", torch.zeros(59, 2).double(), r"inducing/ddq has shape \(59, 2\)"),
        ("inducing/q", None, "lacks the tensor 'inducing/q'"),
        ("inducing/outputs", None, "lacks the tensor 'inducing/outputs'"),
        ("inducing/outputs", torch.zeros(2).double(), "'inducing/outputs' is of type float64, expected int64"),
        ("inducing/outputs", torch.tensor([0, 0]), "expected distinct places of torques"),
        ("inducing/outputs", torch.tensor([0, 5000]), "outputs reaches from 0 to 5000"),
        ("inducing/outputs", torch.tensor([-1, 0]), "outputs reaches from -1 to 0"),
    ],
    ids=lambda value: value if isinstance(value, str) and "/" in value else "",
)
def test_wrong_tensor_is_named(folder: Path, name: str, replacement: torch.Tensor | None, message: str) -> None:
    if replacement is None:
        edit_tensors(folder, lambda tensors: tensors.pop(name))
    else:
        edit_tensors(folder, lambda tensors: tensors.update({name: replacement}))
    with pytest.raises(ModelFormatError, match=message):
        load(folder)


def test_jitter_that_was_needed_counts_as_noise(model: TorqueModel, folder: Path) -> None:
    noise = np.sqrt(model.noise_std**2 - model.fit["jitter"] + 0.25)
    edit_manifest(folder, fit={**model.fit, "jitter": 0.25}, noise_std=noise.tolist())
    assert np.allclose(load(folder).noise_std ** 2, model.noise_std**2 - model.fit["jitter"] + 0.25, rtol=1e-12)
