"""Tests of exported functions: the runtime of each format, without LIPServe, passes the self-test."""

import json
import subprocess
import sys
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import onnx
import pytest

from lipcore import TorqueModel
from lipcore.export.formats import FORMATS
from lipcore.export.origin import ModelOrigin
from lipcore.extras import MissingExtraError
from lipcore.vocabulary import ROBOT_ESTIMATORS, ExportFormat
from tests.choosing import slow
from tests.lipcore.export.models import MODELS, draw_motions
from tests.lipcore.export.test_function import ALL, ESTIMATORS, train_estimator
from tests.lipcore.oracles import central_difference

STATES, BATCH = 100_000, 20_000
ORIGIN = ModelOrigin("arm", 3, 7, "0123")
ALONE = """
import json, sys
import numpy as np
sys.modules.update(dict.fromkeys(("lipcore", "lipserve", "service")))  # their import fails
folder = sys.argv[1]
queries = dict(np.load(folder + "/queries.npz"))
"""
"""Start of a program that cannot import LIPServe. It reads queries, and writes results with the prefix `of_`."""
RUNTIMES: dict[ExportFormat, str] = {
    "onnx": """
import onnxruntime
for name in sys.argv[2:]:
    session = onnxruntime.InferenceSession(f"{folder}/{name}/1/model.onnx")
    kind = np.float32 if "float32" in name else np.float64
    for size in (1, len(queries["q"])):
        given = {each.name: queries[each.name][:size].astype(kind) for each in session.get_inputs()}
        tau, std = session.run(None, given)
        assert tau.dtype == std.dtype == kind
        assert tau.shape == std.shape == (size, tau.shape[1])
    np.savez(f"{folder}/{name}.npz", tau=tau, tau_std=std)
""",
    "torch": """
import torch
extra = {"lipserve.json": ""}
call = torch.export.load(folder + "/arm-v3-r7.pt2", extra_files=extra).module()
facts = json.loads(extra["lipserve.json"])
given = [torch.from_numpy(queries[name]) for name in facts["arguments"]]
leaf = given[2].clone().requires_grad_()
tau, std = call(given[0], given[1], leaf, *given[3:])
tau.sum().backward()
assert call(*[each[:1] for each in given])[0].shape == (1, tau.shape[1])
np.savez(folder + "/arm.npz", tau=tau.detach(), tau_std=std.detach(), slope=leaf.grad)
""",
    "jax": """
import jax
from jax import export
jax.config.update("jax_enable_x64", True)
facts = json.load(open(folder + "/arm-v3-r7.json"))
mean, both = (export.deserialize(open(f"{folder}/arm-v3-r7.{name}.jax", "rb").read()).call
              for name in ("torque", "torque_std"))
given = [queries[name] for name in facts["arguments"]]
tau, std = both(*given)
slope = jax.grad(lambda ddq: mean(*given[:2], ddq, *given[3:]).sum())(given[2])
np.testing.assert_allclose(mean(*given), tau, rtol=0, atol=1e-12 * abs(tau).max())
np.savez(folder + "/arm.npz", tau=tau, tau_std=std, slope=slope)
""",
}


def evaluate(
    kind: ExportFormat, folder: Path, queries: dict[str, np.ndarray], *names: str
) -> dict[str, dict[str, np.ndarray]]:
    """Return the results of the runtime by name of the model, in a process without LIPServe."""
    np.savez(folder / "queries.npz", **queries)
    command = [sys.executable, "-c", ALONE + RUNTIMES[kind], str(folder), *names]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder)
    assert done.returncode == 0, done.stderr
    return {name: dict(np.load(folder / f"{name}.npz")) for name in names or ("arm",)}


def write(kind: ExportFormat, model: TorqueModel, folder: Path) -> dict:
    """Write the files of a format; return its facts."""
    files = FORMATS[kind].write(model, {}, ORIGIN)
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    if kind == "torch":
        with zipfile.ZipFile(folder / "arm-v3-r7.pt2") as archive:
            (name,) = (each for each in archive.namelist() if each.endswith("lipserve.json"))
            return json.loads(archive.read(name))
    return json.loads(files["self_test.json" if kind == "onnx" else "arm-v3-r7.json"])


def assert_near(found: np.ndarray, expected: np.ndarray, tolerance: float) -> None:
    np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance * np.abs(expected).max())


CASES: list = [
    ("onnx", MODELS["friction of all kinds"]),
    ("onnx", partial(train_estimator, "se")),
    ("torch", partial(train_estimator, "se")),
    ("jax", partial(train_estimator, "se")),
    *(slow("onnx", make) for make in ALL.values()),
    *(slow(kind, MODELS[name]) for kind in ("torch", "jax") for name in ("panda", "friction of all kinds")),
]


@pytest.mark.parametrize(("kind", "make"), CASES)
def test_runtime_alone_passes_the_self_test(
    kind: ExportFormat, make: Callable[[], TorqueModel], tmp_path: Path
) -> None:
    model = make()
    is_exact = model.estimator.name in ESTIMATORS
    facts = write(kind, model, tmp_path)
    assert {name: facts[name] for name in ("model", "version", "revision", "sha256", "joints")} == {
        "model": "arm",
        "version": 3,
        "revision": 7,
        "sha256": "0123",
        "joints": list(model.joint_names),
    }
    test = {name: np.array(values) for name, values in facts["self_test"].items()}
    assert len(test["q"]) == 100
    known = model.predict(test["q"], test["dq"], test["ddq"], deflections=_deflections(test.get("drive_state")))
    assert_near(test["tau"], known.mean, 1e-6 if is_exact else 1e-9)
    np.testing.assert_allclose(test["tau_std"], known.tau_std, rtol=1e-5)
    has_float32 = not len(model.posterior.basis.outputs)
    names = ("arm", "arm-float32")[: 1 + has_float32] if kind == "onnx" else ()
    found = evaluate(kind, tmp_path, {name: test[name] for name in facts["arguments"]}, *names)
    for name, each in found.items():
        single = name.endswith("float32")
        assert_near(each["tau"], test["tau"], 1e-4 if single else 1e-7 if is_exact else 1e-10)
        assert_near(each["tau_std"], test["tau_std"], 1e-2 if single else 1e-6 if is_exact else 1e-10)
    if kind != "onnx":
        assert_near(found["arm"]["slope"], _slopes(model, test), 1e-5 if is_exact else 1e-7)


def _deflections(state: np.ndarray | None) -> np.ndarray | None:
    """Return middle and half width of each element's interval. The state has q, all lower bounds, all upper bounds."""
    if state is None:
        return None
    low, high = np.split(state[:, 1:], 2, axis=1)
    return np.concatenate([(low + high) / 2, (high - low) / 2], axis=1)


def _slopes(model: TorqueModel, test: dict[str, np.ndarray]) -> np.ndarray:
    """Return the central differences of the sum of all torques by the accelerations, (N, n)."""
    memory = _deflections(test.get("drive_state"))

    def moved(joint: int, step: float) -> np.ndarray:
        ddq = test["ddq"].copy()
        ddq[:, joint] += step
        return model.predict(test["q"], test["dq"], ddq, deflections=memory).mean.sum(axis=1)

    return np.stack([central_difference(partial(moved, joint), 1e-4) for joint in range(model.n_joints)], axis=1)


def test_repository_describes_its_models_to_triton() -> None:
    files = FORMATS["onnx"].write(MODELS["friction of all kinds"](), {}, ORIGIN)
    assert set(files) == {
        "README.md",
        "self_test.json",
        *(f"{name}/{file}" for name in ("arm", "arm-float32") for file in ("config.pbtxt", "1/model.onnx")),
    }
    config = files["arm-float32/config.pbtxt"].decode()
    model = onnx.load_from_string(files["arm-float32/1/model.onnx"])
    assert {each.key for each in model.metadata_props} >= {"model", "version", "revision", "joints", "units", "sha256"}
    for field, tensors in (("input", model.graph.input), ("output", model.graph.output)):
        for each in tensors:
            batch, *shape = each.type.tensor_type.shape.dim
            assert batch.dim_param == "batch"
            dims = ", ".join(str(size.dim_value) for size in shape)
            assert f'{field} {{ name: "{each.name}" data_type: TYPE_FP32 dims: [{dims}] }}' in config


def test_model_with_inducing_torques_has_no_float32_file() -> None:
    files = FORMATS["onnx"].write(train_estimator("se"), {}, ORIGIN)
    assert not any("float32" in name for name in files)
    assert "There is no float32 file" in files["README.md"].decode()


@pytest.mark.parametrize(
    ("kind", "module", "extra"), [("onnx", "onnx", "onnx"), ("torch", "torch", "train"), ("jax", "jax", "jax")]
)
def test_missing_library_names_its_extra(
    kind: ExportFormat, module: str, extra: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingExtraError, match=rf"pip install 'lipserve\[{extra}\]'"):
        FORMATS[kind].write(MODELS["panda"](), {}, ORIGIN)


@pytest.mark.slow
@pytest.mark.parametrize("kind", RUNTIMES)
def test_deviation_over_many_states(kind: ExportFormat, tmp_path: Path) -> None:
    model = MODELS["panda"]()
    assert model.estimator.name in ROBOT_ESTIMATORS
    write(kind, model, tmp_path)
    motions, names = draw_motions(model, STATES, 5), ("arm", "arm-float32") if kind == "onnx" else ("arm",)
    off = dict.fromkeys(names, (0.0, 0.0))
    for motion in np.split(motions, STATES // BATCH, axis=1):
        expected = model.predict(*motion)
        queries = dict(zip(("q", "dq", "ddq"), motion, strict=True))
        for name, each in evaluate(kind, tmp_path, queries, *(names if kind == "onnx" else ())).items():
            tau = np.abs(each["tau"] - expected.mean).max() / np.abs(expected.mean).max()
            off[name] = max(off[name][0], tau), max(off[name][1], np.abs(each["tau_std"] / expected.tau_std - 1).max())
    for name, (tau, std) in off.items():
        print(f"{kind} {name}: max relative deviation of tau {tau:.1e}, of tau_std {std:.1e}")  # noqa: T201 - figures
        assert max(tau, std) < (1e-2 if name.endswith("float32") else 1e-10)
