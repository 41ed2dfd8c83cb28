"""Python client as a separate distribution: imports, address of the service, records. Its wheel: tests/packaging."""

import json
import runpy
import subprocess
import sys

import pytest

import lipserve
from lipserve import AsyncClient, Client, StreamClient, StreamError
from lipserve.address import DEFAULT_URL
from tests import ROOT

SOURCE = ROOT / "clients/python"
SERVER = {"fastapi", "starlette", "pydantic", "torch", "scipy", "numba", "sqlalchemy", "uvicorn", "service", "lipcore"}
SERVER |= {"pinocchio", "matplotlib", "pandas"}


def test_client_imports_neither_service_nor_lipcore():
    paths = [each.relative_to(SOURCE).with_suffix("") for each in sorted((SOURCE / "lipserve").rglob("*.py"))]
    names = [".".join((path.parent if path.name == "__init__" else path).parts) for path in paths]
    assert "lipserve.records.jobs" in names
    script = f"import sys, json, {', '.join(names)}\nprint(json.dumps(sorted(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    loaded = set(json.loads(done.stdout))
    assert "lipserve.sync" in loaded
    assert loaded.isdisjoint(SERVER)


def test_exported_names_exist():
    assert set(lipserve.__all__) <= set(dir(lipserve))
    assert all(getattr(lipserve, name) is not None for name in lipserve.__all__)
    with pytest.raises(AttributeError, match="no attribute 'Clinet'"):
        lipserve.Clinet  # noqa: B018


def test_records_match_the_services_schemas():
    made = runpy.run_path(str(SOURCE / "records.py"))
    target, documents = made["TARGET"], made["documents"]()
    records = {f"records/{each.name}" for each in (target / "records").glob("*.py") if each.stem != "__init__"}
    assert records == {name for name in documents if name.startswith("records/")}
    written = {name: (target / name).read_text("utf-8") for name in documents}
    assert written == documents, "run: python clients/python/records.py"


def test_clients_use_address_and_key_of_the_environment(monkeypatch):
    monkeypatch.setenv("LIPSERVE_URL", "http://robots.example:9000")
    monkeypatch.setenv("LIPSERVE_API_KEY", "lip_abc")
    for client in (Client(), AsyncClient()):
        assert client.url == "http://robots.example:9000"
        assert str(client._http.base_url) == "http://robots.example:9000"
        assert client._http.headers["authorization"] == "Bearer lip_abc"
    assert Client("http://other.example").url == "http://other.example"
    for name in ("LIPSERVE_URL", "LIPSERVE_API_KEY"):
        monkeypatch.setenv(name, "")
    assert Client().url == DEFAULT_URL
    assert "authorization" not in Client()._http.headers


@pytest.mark.slow
def test_client_of_a_service_in_a_process_of_its_own(server, monkeypatch, tmp_path):
    zeros = [0.0] * 7
    monkeypatch.setenv("LIPSERVE_URL", server.url)
    with StreamClient("panda-sim") as stream, Client() as client:
        expected = client.predict("panda-sim", zeros, zeros, zeros).tau.tolist()
        assert stream.predict(zeros, zeros, zeros).tau.tolist() == pytest.approx(expected, abs=1e-12)
        for record, path in (
            (client.model("panda-sim"), "/v1/models/panda-sim"),
            (client.version("panda-sim", 1), "/v1/models/panda-sim/versions/1"),
            (client.health(), "/health/ready"),
            (client.profile("panda"), "/v1/robots/profiles/panda"),
        ):
            assert record.as_dict() == server.client.get(path).json()
    monkeypatch.setenv("LIPSERVE_URL", f"unix://{tmp_path}/none.sock")
    with pytest.raises(StreamError, match=r"no service answers at .*none\.sock"):
        StreamClient("panda-sim")
