"""Tests of saved models: loading, rejection of invalid files by name, and strict JSON."""

import hashlib
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from lipcore import FitOptions, ModelFormatError, Samples, TorqueModel, copy_model, load, save, train
from lipcore.data.motion import Array
from lipcore.files import persistence
from lipcore.files.strict_json import MAX_DEPTH, StrictJsonError, quote, read
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Simulation, simulate
from tests.choosing import slow


@pytest.fixture(scope="module")
def samples() -> Samples:
    return simulate(load_robot("double-pendulum"), Simulation(n_samples=60, speed=10, noise=0.01), seed=1)


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


def edit_tensor(folder: Path, name: str, change: Callable[[Array | None], Array | None]) -> None:
    """Change, add or remove a tensor and update the checksum in the manifest."""
    path = folder / "model.safetensors"
    tensors = load_tensors(path.read_bytes())
    changed = change(tensors.pop(name, None))
    payload = save_tensors(tensors if changed is None else {**tensors, name: np.ascontiguousarray(changed)})
    path.write_bytes(payload)
    entry = {"file": path.name, "bytes": len(payload), "sha256": hashlib.sha256(payload).hexdigest()}
    edit_manifest(folder, tensors=entry)


def test_loaded_model_predicts_like_the_saved_one(model: TorqueModel, samples: Samples, folder: Path) -> None:
    again = load(folder)
    query = samples.q + 0.1, 0.5 * samples.dq, samples.ddq
    before, after = model.predict(*query, covariance=True), again.predict(*query, covariance=True)
    for name in ("tau", "tau_std", "noise_std", "covariance"):
        assert np.array_equal(getattr(before, name), getattr(after, name)), name
    for name in ("joint_names", "joint_types", "torque_convention", "options", "fit", "compact", "training_range"):
        assert getattr(again, name) == getattr(model, name)
    assert again.estimator.name == model.estimator.name


def test_folder_may_be_a_string(folder: Path) -> None:
    q = np.zeros(2)
    assert np.array_equal(load(str(folder)).predict(q, q, q).tau, load(folder).predict(q, q, q).tau)
    missing = str(folder.with_name("nothing"))
    with pytest.raises(ModelFormatError, match=f"{missing}/manifest.json cannot be read: .*No such file"):
        load(missing)


def test_manifest_is_readable_and_has_tensor_checksum(model: TorqueModel, folder: Path) -> None:
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


def test_existing_folder_is_never_overwritten(model: TorqueModel, folder: Path, tmp_path: Path) -> None:
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert copy_model(folder, tmp_path / "deep" / "copy") == persistence.read_manifest(folder)
    assert {path.name: path.read_bytes() for path in (tmp_path / "deep" / "copy").iterdir()} == before
    with pytest.raises(FileExistsError, match="never overwritten"):
        save(model, folder)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_failed_save_leaves_nothing_behind(model: TorqueModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write = persistence._write

    def full_disk(path: Path, content: bytes) -> None:
        if path.name == "manifest.json":
            raise OSError("no space left on device")
        write(path, content)

    monkeypatch.setattr(persistence, "_write", full_disk)
    with pytest.raises(OSError, match="no space left"):
        save(model, tmp_path / "model")
    assert list(tmp_path.iterdir()) == []


def test_tampered_tensors_are_not_copied(folder: Path, tmp_path: Path) -> None:
    path = folder / "model.safetensors"
    path.write_bytes(path.read_bytes()[:-1] + bytes([path.read_bytes()[-1] ^ 1]))
    with pytest.raises(ModelFormatError, match=r"model\.safetensors does not match the sha256"):
        load(folder)
    with pytest.raises(ModelFormatError, match="sha256"):
        copy_model(folder, tmp_path / "copy")
    assert not (tmp_path / "copy").exists()


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        ("manifest.json", lambda path: path.write_bytes(path.read_bytes()[:-20])),
        ("model.safetensors", Path.unlink),
    ],
    ids=["cut", "missing"],
)
def test_unreadable_file_is_named(folder: Path, name: str, damage: Callable[[Path], object]) -> None:
    damage(folder / name)
    with pytest.raises(ModelFormatError, match=f"{re.escape(name)} cannot be read"):
        load(folder)


CONFORMAL = {"scale": [1, 1], "guaranteed": [0.5, 0.5], "blocks": 3}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format": "zip"}, "not a manifest of format 'lipserve-model'"),
        ({"format_version": 2}, "format_version is 2, expected 3: train the model again"),
        ({"estimator": "oracle"}, "estimator is 'oracle'"),
        ({"joint_names": "joint1"}, "joint_names is 'joint1', expected `array`"),
        ({"joint_types": ["revolute", "ball"]}, r"joint_types\[1\] is 'ball'"),
        ({"joint_types": ["revolute"]}, "joint_types is a list of 1 entries, expected 2"),
        ({"torque_convention": "unsaid"}, "torque_convention is 'unsaid'"),
        ({"options": []}, "options is a list of 0 entries, expected `object`"),
        ({"compact": {}}, "compact: Object missing required field `data_samples`"),
        ({"training_range": []}, "training_range is a list of 0 entries, expected `object`"),
        ({"training_torque": {"mean": [0, 0]}}, "training_torque: Object missing required field `std`"),
        ({"training_torque": {"mean": [0], "std": [1, 1]}}, "training_torque.mean is a list of 1 entries"),
        (
            {"training_torque": {"mean": [0, 0], "std": [1, -1]}},
            r"training_torque.std\[1\] is -1, expected `float` >= 0",
        ),
        ({"training_torque": {"mean": [0, None], "std": [1, 1]}}, r"training_torque.mean\[1\] is None"),
        ({"calibration": None}, "calibration is None, expected `object`"),
        ({"calibration": {"function_std_factor": 0.9}}, "function_std_factor is 0.9, expected a number from 1 to 100"),
        ({"calibration": {}}, "calibration: Object missing required field `function_std_factor`"),
        (
            {"calibration": {"function_std_factor": 2.0, "factor": 2.0}},
            "calibration has the entry 'factor', which this release does not know",
        ),
        ({"tensors": {}}, "tensors: Object missing required field `bytes`"),
        ({"conformal": {"scale": [1, 1], "blocks": 3}}, "conformal: Object missing required field `guaranteed`"),
        ({"conformal": CONFORMAL | {"scale": [1, 0.5]}}, r"conformal: scale is \[1.0, 0.5\], expected numbers from 1"),
        ({"conformal": CONFORMAL | {"blocks": True}}, "conformal.blocks is True, expected `int`"),
        ({"conformal": CONFORMAL | {"blocks": 0}}, "conformal: blocks is 0, expected at least 1"),
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
        ("params/kinetic.log_gap", np.zeros(3), r"'kinetic.log_gap' has shape \(3,\), expected \(2,\)"),
        ("params/surprise", np.zeros(1), r"'surprise' has shape \(1,\), expected None"),
        ("params/kinetic.log_scale", None, r"'kinetic.log_scale' has shape None, expected \(\)"),
        ("params/noise.log_std", np.full((2,), np.nan), "'params/noise.log_std' is not made of finite"),
        ("statistics/a", np.full((6,), np.inf), "statistics/a has shape"),
        ("statistics/b", np.zeros(40, np.float32), "'statistics/b' is of type 'F32', expected F64"),
        ("statistics/a", np.zeros(5), r"statistics/a has shape \(5,\), expected M \(M \+ 1\) / 2 numbers"),
        ("inducing/ddq", np.zeros((59, 2)), r"inducing/ddq has shape \(59, 2\)"),
        ("inducing/q", None, "lacks the tensor 'inducing/q'"),
        ("inducing/outputs", np.zeros(2), "'inducing/outputs' is of type 'F64', expected I64"),
        ("inducing/outputs", np.array([0, 0]), "distinct places of torques"),
        ("inducing/outputs", np.array([0, 5000]), "outputs reaches from 0 to 5000"),
        ("misfit", np.zeros((3, 2)), r"'misfit' has shape \(3, 2\), expected \(16, 2\)"),
        ("misfit", np.ones((4, 2)), r"tensor 'misfit' has shape \(4, 2\), expected \(16, 2\)"),  # before 0.2.0
        ("misfit", -np.ones((5, 2)), "'misfit' has a number below zero"),
    ],
    ids=lambda value: value if isinstance(value, str) and "/" in value else "",
)
def test_wrong_tensor_is_named(folder: Path, name: str, replacement: Array | None, message: str) -> None:
    edit_tensor(folder, name, lambda values: replacement)
    with pytest.raises(ModelFormatError, match=message):
        load(folder)


VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**63 - 1)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=20,
)


@given(VALUES)
def test_json_values_are_read_back(value: object) -> None:
    assert read(json.dumps(value).encode(), 10**6) == value


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"NaN", "not JSON: .*invalid character"),
        (b"-1e400", "out of range"),
        (b"9223372036854775808", "too large"),
        (b"-9223372036854775809", "too large"),
        (b"1" * 5000, "out of range"),
        (b'"\\udc00"', "invalid utf-16 surrogate pair"),
        (b'{"\\ud800x": 1}', "not JSON"),
        (b"\xff\xfe[\x00]\x00", "not JSON"),
        (b'"\xff"', "not JSON: .* can't decode byte 0xff"),
        (b"[1,]", "not JSON"),
        (b"", "not JSON"),
        (b"[" * (MAX_DEPTH + 1) + b"]" * (MAX_DEPTH + 1), f"nests more than {MAX_DEPTH} deep"),
        (b"[" * 100_000, f"nests more than {MAX_DEPTH} deep"),
        (b'{"a":' * 100_000, f"nests more than {MAX_DEPTH} deep"),
        (b"[" + b"1," * 500 + b"1]", "1003 bytes, expected at most 1000"),
    ],
    ids=lambda each: repr(each)[:24],
)
def test_ambiguous_or_excessive_json_is_rejected(text: bytes, message: str) -> None:
    with pytest.raises(StrictJsonError, match=message):
        read(text, 1000 if b"1,1" in text else 10**6)


def test_quoted_values_are_short_and_escaped() -> None:
    assert quote("\x1b[2J\u202e") == "'\\x1b[2J\\u202e'"
    assert len(quote("x" * 1000)) < 100
    assert quote([1, 2, 3]) == "a list of 3 entries"
