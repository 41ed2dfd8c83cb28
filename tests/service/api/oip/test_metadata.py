"""The Open Inference Protocol: health, and metadata of server and models."""

import pytest

import lipcore
from service.storage.files import Files
from tests.service.api.oip.requests import error_message
from tests.service.data import service_of

EACH = {"tau": [2], "kinetic_energy": [1], "potential_energy": [1], "forward_dynamics": [2], "inertia_matrix": [2, 2]}
EACH |= {f"tau_{part}": [2] for part in ("coriolis", "gravity", "inertial", "friction", "without_gravity")}
ENERGETIC = {name + end: [-1, *shape] for name, shape in EACH.items() for end in ("", "_std")}
ENERGETIC |= {"noise_std": [2], "scale": [2], "covariance": [-1, 2, 2], "fallback": [-1, 2], "tau_mean": [-1, 2]}
ENERGETIC |= {f"tau_external{end}": [-1, 2] for end in ("", "_std", "_z")}
ENERGETIC |= {f"tau_external_{end}": [-1, 1] for end in ("statistic", "p")}
"""Tensors of a model of two joints whose estimator has energies."""


def test_health(api):
    assert api.get("/v2/health/live").json() == {"live": True}
    assert api.get("/v2/health/ready").json() == {"ready": True}


@pytest.mark.parametrize("version", ["", "/versions/1"])
def test_model_describes_its_tensors(api, trained, version):
    result = api.get(f"/v2/models/{trained.name}{version}").json()
    inputs, outputs = result.pop("inputs"), result.pop("outputs")
    assert result == {
        "name": trained.name,
        "versions": ["1"],
        "platform": "lipserve_lip-chain",
        "parameters": {
            "version": "1",
            "revision": 0,
            "torque_convention": "gravity_included",
            "joint_names": "joint1,joint2",
        },
    }
    tensor = {"datatype": "FP64", "shape": [-1, 2]}
    assert inputs[:3] == [{"name": name, **tensor} for name in ("q", "dq", "ddq")]
    assert inputs[3:] == [{"name": "tau", **tensor, "parameters": {"optional": True}}]
    assert {each["name"]: each["shape"] for each in outputs} == ENERGETIC
    assert {each["datatype"] for each in outputs} == {"FP64"}


def test_version_that_cannot_be_loaded_is_not_ready(api, trained, monkeypatch):
    def broken(*_):
        raise lipcore.ModelFormatError("the manifest is missing")

    monkeypatch.setattr(Files, "load_version", broken)
    monkeypatch.setattr(service_of(api).loaded, "_snapshot", type(service_of(api).loaded._snapshot)())
    reply = error_message(api.get(f"/v2/models/{trained.name}/ready"), 503)
    assert reply == f"version 1 of model {trained.name!r} cannot be loaded: the manifest is missing"


@pytest.mark.parametrize("path", ["", "/ready", "/versions/1", "/versions/1/ready"])
@pytest.mark.parametrize("model", ["nobody", "%2e%2e", "panda-sim%00"])
def test_unknown_models_are_404(api, model, path):
    assert "GET /v1/models lists all models." in error_message(api.get(f"/v2/models/{model}{path}"), 404)


@pytest.mark.parametrize("path", ["", "/ready"])
@pytest.mark.parametrize("version", ["2", "0", "01", "x", "9" * 30, "%00", "%C2%B2"])
def test_unknown_version_error_lists_the_existing_ones(api, trained, version, path):
    reply = error_message(api.get(f"/v2/models/{trained.name}/versions/{version}{path}"), 404)
    assert reply.endswith("expected one of 1 of model 'pendulum'")
    assert reply.startswith("version is ")
