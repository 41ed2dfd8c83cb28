"""Triton's extensions over HTTP: repository index, configuration and statistics."""

import pytest

import lipcore
from service.storage.files import Files
from tests.service.api.oip.requests import error_message, message
from tests.service.data import service_of

MOTION = {name: [0.1, -0.2] for name in ("q", "dq", "ddq")}


def index(api, **body):
    listed = api.post("/v2/repository/index", json=body).json()
    return {(each["name"], each["version"]): (each["state"], each["reason"]) for each in listed}


def statistics(api, path):
    return api.get(f"/v2/models/{path}stats").json()["model_stats"]


def test_index_lists_every_version(api, trained):
    assert index(api)[trained.name, "1"] == ("READY", "")
    assert api.post("/v2/repository/index").json() == api.post("/v2/repository/index", json={}).json()


def test_index_names_versions_that_cannot_be_read(api, trained, monkeypatch):
    def broken(*_):
        raise lipcore.ModelFormatError("the manifest is missing")

    loaded = service_of(api).loaded
    monkeypatch.setattr(Files, "load_version", broken)
    monkeypatch.setattr(loaded, "_snapshot", type(loaded._snapshot)())
    monkeypatch.setattr(loaded._loader, "_unreadable", {})
    error_message(api.get(f"/v2/models/{trained.name}/ready"), 503)
    state, reason = index(api)[trained.name, "1"]
    assert (state, "the manifest is missing" in reason) == ("UNAVAILABLE", True)
    assert (trained.name, "1") not in index(api, ready=True)


@pytest.mark.parametrize("version", ["", "/versions/1"])
def test_config_agrees_with_the_metadata(api, trained, version):
    described = api.get(f"/v2/models/{trained.name}{version}").json()
    config = api.get(f"/v2/models/{trained.name}{version}/config").json()
    assert (config["name"], config["platform"]) == (described["name"], described["platform"])
    assert (config["max_batch_size"], config["model_transaction_policy"]) == (0, {"decoupled": False})
    for kind in ("input", "output"):
        tensors = [(each["name"], each["dims"]) for each in config[kind]]
        assert tensors == [(each["name"], each["shape"]) for each in described[f"{kind}s"]]
        assert {each["data_type"] for each in config[kind]} == {"TYPE_FP64"}
    assert [each["name"] for each in config["input"] if each["optional"]] == ["tau"]


def test_statistics_count_requests_and_queries(api, trained):
    path = f"{trained.name}/versions/1/"
    (before,) = statistics(api, path)
    batch = {name: [values] * 600 for name, values in MOTION.items()}  # in a thread, as its body is large
    for body in (message(MOTION), message(MOTION, "tau_gravity"), message(batch)):
        assert api.post(f"/v2/models/{trained.name}/infer", json=body).status_code == 200
    error_message(api.post(f"/v2/models/{trained.name}/infer", json=message({"q": [0.0, 0.0]})), 400)
    (after,) = statistics(api, path)
    assert after["inference_count"] - before["inference_count"] == 602
    assert after["execution_count"] - before["execution_count"] == 3
    assert after["last_inference"] > 1.7e12
    old, new = before["inference_stats"], after["inference_stats"]
    counts = {name: new[name]["count"] - old[name]["count"] for name in new}
    served = dict.fromkeys(("success", "queue", "compute_input", "compute_infer", "compute_output"), 3)
    assert counts == {**served, "fail": 1, "cache_hit": 0, "cache_miss": 0}
    spent = {name: new[name]["ns"] - old[name]["ns"] for name in new}
    assert spent["success"] == sum(spent[name] for name in ("queue", "compute_input", "compute_infer"))
    assert all(spent[name] > 0 for name in ("success", "fail", "queue", "compute_input", "compute_infer"))


def test_statistics_of_models_list_their_versions(api, trained):
    assert [each["version"] for each in statistics(api, f"{trained.name}/")] == ["1"]
    assert {"panda-sim", trained.name} <= {each["name"] for each in statistics(api, "")}


@pytest.mark.parametrize("path", ["nobody/stats", "nobody/config", "nobody/versions/1/stats"])
def test_unknown_models_are_404(api, path):
    assert "nobody" in error_message(api.get(f"/v2/models/{path}"), 404)


@pytest.mark.parametrize("action", ["load", "unload"])
def test_loading_is_refused_with_what_to_do(api, action):
    reply = error_message(api.post(f"/v2/repository/models/arm/{action}", json={}), 400)
    assert "POST /v1/models/import" in reply
    assert "DELETE /v1/models/arm" in reply
