"""The Python client as a distribution of its own: what it imports, where it finds a service, its records, its wheel."""

import json
import os
import runpy
import subprocess
import sys
import venv
from pathlib import Path

import pytest

import lipserve
from lipserve import AsyncClient, Client, StreamClient, StreamError
from lipserve.address import DEFAULT_URL
from tests.service.server import Server

ROOT = Path(__file__).parents[2]
SOURCE = ROOT / "clients/python"
SERVER = {"fastapi", "starlette", "pydantic", "torch", "scipy", "numba", "sqlalchemy", "uvicorn", "service", "lipcore"}
SERVER |= {"pinocchio", "matplotlib", "pandas"}
MOST_MB = 90
DEPENDENCIES = {"numpy", "httpx", "httpcore", "h11", "anyio", "idna", "certifi", "websockets", "msgspec"}
MORE = {"typing-extensions", "typing_extensions", "sniffio"}
"""What some versions of these need on some versions of Python."""

ASKING = """
import asyncio, json, sys
from importlib.metadata import distributions
from lipserve import AsyncClient, Client, StreamClient
zeros = [0.0] * 7
with Client() as client:
    answer = client.predict("panda-sim", zeros, zeros, zeros)
    record = client.version("panda-sim", 1)
    following = client.live("panda-sim")
    event = next(following)
async def again():
    async with AsyncClient() as client:
        return (await client.predict("panda-sim", zeros, zeros, zeros)).tau.tolist()
with StreamClient("panda-sim") as stream:
    frame = stream.ask(zeros, zeros, zeros)
try:
    import lipserve.progress
except ModuleNotFoundError as error:
    missing = str(error)
print(json.dumps({
    "missing": missing, "tau": [answer.tau.tolist(), asyncio.run(again()), frame.tau.tolist()],
    "joints": record.joint_names, "event": type(event).__name__,
    "modules": sorted(sys.modules), "names": sorted(each.name for each in distributions()),
}))
"""


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    """A service in a process of its own."""
    with Server(tmp_path_factory.mktemp("server"), warm=True) as started:
        yield started


def modules_of(package: Path) -> list[str]:
    """Every module of a package, by its name."""
    parts = (each.relative_to(package.parent).with_suffix("").parts for each in sorted(package.rglob("*.py")))
    return [".".join(each[:-1] if each[-1] == "__init__" else each) for each in parts]


def test_no_module_of_the_client_imports_the_server_or_the_method():
    names = modules_of(SOURCE / "lipserve")
    assert "lipserve.records.jobs" in names
    script = f"import sys, json, {', '.join(names)}\nprint(json.dumps(sorted(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    loaded = set(json.loads(done.stdout))
    assert "lipserve.sync" in loaded
    assert loaded.isdisjoint(SERVER)


def test_its_names_are_those_that_it_offers():
    assert set(lipserve.__all__) <= set(dir(lipserve))
    assert all(getattr(lipserve, name) is not None for name in lipserve.__all__)
    with pytest.raises(AttributeError, match="no attribute 'Clinet'"):
        lipserve.Clinet  # noqa: B018


def test_records_are_those_of_the_services_schemas():
    made = runpy.run_path(str(SOURCE / "records.py"))
    written = {each.name: each.read_text("utf-8") for each in made["TARGET"].glob("*.py") if each.stem != "__init__"}
    assert written == made["documents"](), "run: python clients/python/records.py"


def test_without_arguments_clients_ask_the_service_of_the_environment_with_its_key(monkeypatch):
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


def test_streams_go_to_the_service_of_the_environment(server, monkeypatch, tmp_path):
    zeros = [0.0] * 7
    monkeypatch.setenv("LIPSERVE_URL", server.url)
    with StreamClient("panda-sim") as stream, Client() as client:
        expected = client.predict("panda-sim", zeros, zeros, zeros).tau.tolist()
        assert stream.ask(zeros, zeros, zeros).tau.tolist() == pytest.approx(expected, abs=1e-12)
    monkeypatch.setenv("LIPSERVE_URL", f"unix://{tmp_path}/none.sock")
    with pytest.raises(StreamError, match=r"no service answers at .*none\.sock"):
        StreamClient("panda-sim")


def test_a_record_is_the_document_that_it_was_read_from(server):
    with Client(server.url) as client:
        for record, path in (
            (client.model("panda-sim"), "/v1/models/panda-sim"),
            (client.version("panda-sim", 1), "/v1/models/panda-sim/versions/1"),
            (client.health(), "/health/ready"),
            (client.profile("panda"), "/v1/robots/profiles/panda"),
        ):
            assert record.as_dict() == server.client.get(path).json()


@pytest.mark.slow
def test_the_wheel_alone_asks_a_service(server, tmp_path):
    """In an environment that has nothing else: needs a package index."""
    place = tmp_path / "environment"
    venv.create(place, with_pip=False)
    (packages,) = place.glob("lib/python3*/site-packages")
    wheels = tmp_path / "wheels"
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    subprocess.run([*pip, "wheel", "--no-deps", "--wheel-dir", str(wheels), str(SOURCE)], check=True)
    (wheel,) = wheels.glob("lipserve_client-*.whl")
    subprocess.run([*pip, "--python", str(place / "bin/python"), "install", "--no-compile", str(wheel)], check=True)

    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    command = [str(place / "bin/python"), "-c", ASKING]
    environment |= {"LIPSERVE_URL": server.url}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    seen = json.loads(done.stdout)

    first, second, framed = seen["tau"]
    assert first == second
    assert framed == pytest.approx(first, abs=1e-12)
    assert (len(seen["joints"]), seen["event"]) == (7, "LiveStatus")
    assert set(seen["names"]) - MORE == DEPENDENCIES | {"lipserve-client"}
    assert set(seen["modules"]).isdisjoint(SERVER)
    assert seen["missing"] == "bars need Rich: pip install 'lipserve-client[progress]'"
    assert (packages / "lipserve/py.typed").is_file()
    size = sum(each.stat().st_size for each in packages.rglob("*") if each.is_file())
    assert size < MOST_MB * 1_000_000
