"""Both published distributions: built, checked, installed in an empty environment, used. Needs a package index."""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import venv
from pathlib import Path
from urllib.parse import urlparse

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from lipserve import __version__
from tests.clients.python.test_package import SERVER
from tests.docs.blocks import ROOT, all_pages
from tests.packaging.test_pieces import BASE
from tests.service.server import Server

pytestmark = pytest.mark.slow
PIP = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
PLAIN = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
SOURCES = {"clients/python": "lipserve-client", ".": "lipserve"}
"""Folder and name of each distribution."""
MAX_CLIENT_MB, MAX_SERVICE_MB = 90, 450
DEPENDENCIES = {"numpy", "httpx", "httpcore", "h11", "anyio", "idna", "certifi", "websockets", "msgspec"}
MORE = {"typing-extensions", "typing_extensions", "sniffio"}
"""Further dependencies of some versions."""

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
    frame = stream.predict(zeros, zeros, zeros)
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
def dist(tmp_path_factory):
    """Return the folder of both sdists and of their wheels."""
    pytest.importorskip("build", reason="build is missing: pip install build")
    folder = tmp_path_factory.mktemp("dist")
    for source in SOURCES:
        command = [sys.executable, "-m", "build", "--outdir", str(folder), str(ROOT / source)]
        subprocess.run(command, check=True, capture_output=True)
    return folder


def installed(place: Path, dist: Path, name: str) -> Path:
    """Create an environment with only a distribution and its dependencies; return its folder of packages."""
    venv.create(place, with_pip=False)
    python = str(place / "bin/python")
    command = [*PIP, "--quiet", "--python", python, "install", "--no-compile", "--find-links", str(dist)]
    subprocess.run([*command, f"{name}=={__version__}"], check=True)
    subprocess.run([*PIP, "--python", python, "check"], check=True)
    (packages,) = place.glob("lib/python3*/site-packages")
    return packages


class Installed(Server):
    """`lipserve serve` of an environment."""

    patience = 300  # it compiles its kernels
    place: Path

    def _spawned(self, arguments, environment):
        environment = {name: value for name, value in environment.items() if name != "PYTHONPATH"}
        with self.log.open("ab") as log:
            return subprocess.Popen(
                [str(self.place / "bin/lipserve"), *arguments], env=environment, cwd=self.place, stdout=log, stderr=log
            )


@pytest.fixture(scope="module")
def server(dist, tmp_path_factory):
    """Start a service of the wheel in a separate environment."""
    Installed.place = tmp_path_factory.mktemp("environment")
    installed(Installed.place, dist, "lipserve")
    with Installed(tmp_path_factory.mktemp("server") / "home") as started:
        yield started
    shutil.rmtree(Installed.place)  # pytest would keep gigabytes


def test_distributions_have_one_version_and_valid_metadata(dist):
    pytest.importorskip("twine", reason="Twine is missing: pip install twine")
    names = {each.name for each in dist.iterdir()}
    stems = {f"{name.replace('-', '_')}-{__version__}" for name in SOURCES.values()}
    assert names == {stem + end for stem in stems for end in (".tar.gz", "-py3-none-any.whl")}
    files = [str(each) for each in sorted(dist.iterdir())]
    command = [sys.executable, "-m", "twine", "--no-color", "check", "--strict", *files]
    done = subprocess.run(command, cwd=dist, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    assert done.stdout.count("PASSED") == len(names)


def test_wheel_of_the_service_serves_model_pages_and_guide(server):
    zeros = [0.0] * 7
    answer = server.client.post("/v1/models/panda-sim/predict", json={"q": zeros, "dq": zeros, "ddq": zeros})
    assert len(answer.json()["tau"]) == len(zeros)
    assert server.client.get("/openapi.json").json()["info"]["version"] == __version__
    for page, shown in {"/": "LIPServe", "/guide/operations/": "Operate the service"}.items():
        assert shown in server.client.get(page).text
    assert server.client.get("/guide/screenshots/live.webp").headers["content-type"] == "image/webp"


@pytest.mark.skipif("torch" in BASE, reason="torch is part of the base")
def test_service_is_small_and_includes_the_libraries_of_the_dashboard(server):
    files = (each for each in Installed.place.rglob("*") if each.is_file() and not each.is_symlink())
    # without bytecode and compiled kernels, which the start has written
    size = sum(each.stat().st_size for each in files if "__pycache__" not in each.parts)
    assert size < MAX_SERVICE_MB * 1_000_000
    assert len(server.client.get("/dashboard/plotly/cartesian.js", follow_redirects=True).content) > 1_000_000
    for name in ("preact-11.2.0.js", "preact-hooks-11.2.0.js", "htm-3.1.1.js"):
        assert server.client.get(f"/dashboard/libraries/{name}").status_code == 200


def test_wheel_of_the_client_works_alone(server, dist, tmp_path):
    place = tmp_path / "environment"
    packages = installed(place, dist, "lipserve-client")
    environment = {**PLAIN, "LIPSERVE_URL": server.url}
    command = [str(place / "bin/python"), "-c", ASKING]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    seen = json.loads(done.stdout)

    first, second, framed = seen["tau"]
    assert first == second
    assert framed == pytest.approx(first, abs=1e-12)
    assert (len(seen["joints"]), seen["event"]) == (7, "LiveStatus")
    assert set(seen["names"]) - MORE == DEPENDENCIES | {"lipserve-client"}
    assert set(seen["modules"]).isdisjoint(SERVER)
    assert seen["missing"] == "Progress bars need Rich: pip install 'lipserve-client[progress]'"
    assert (packages / "lipserve/py.typed").is_file()
    size = sum(each.stat().st_size for each in packages.rglob("*") if each.is_file())
    assert size < MAX_CLIENT_MB * 1_000_000


INSTALLING = re.compile(r"pip install((?: +(?:'[^']+'|[\w.\[\]/:=-]+))+)")
TORCH_OF_CPUS = "https://download.pytorch.org/whl/cpu"


def lines() -> dict[str, str]:
    """Return every `pip install` of pages and code, by its requirements."""
    code = [path for name in ("lipcore", "service", "clients", "benchmarks") for path in (ROOT / name).rglob("*.py")]
    pages = [*all_pages(), *sorted((ROOT / "docs/examples").iterdir()), *(ROOT / "clients").glob("*/README.md")]
    texts = (path.read_text("utf-8") for path in [*pages, *code])
    return {" ".join(requirements(line)): line for text in texts for line in INSTALLING.findall(text)}


def requirements(line: str) -> list[str]:
    """Return the requirements in the arguments of pip; folders of the checkout become their distributions."""
    words = shlex.split(line)
    if "--index-url" in words:
        at = words.index("--index-url")
        assert words == ["torch", "--index-url", TORCH_OF_CPUS], "that index has only torch"
        del words[at:]
    wanted = []
    for word in (each for each in words if each != "-e"):
        folder, bracket, extras = word.removeprefix("./").partition("[")
        wanted.append(SOURCES.get(folder, folder) + bracket + extras)
    return wanted


def resolved(dist: Path, folder: Path, *arguments: str) -> list[dict]:
    """Return the packages that pip would install, with their metadata."""
    report = folder / "report.json"
    command = [*PIP, "install", "--dry-run", "--ignore-installed", "--find-links", str(dist), "--report", str(report)]
    done = subprocess.run([*command, *arguments], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(report.read_text("utf-8"))["install"]


def missing(install: list[dict], wanted: str) -> list[str]:
    """Return requirements, or extras of them, that are missing from the packages to install."""
    offered = {
        canonicalize_name(each["metadata"]["name"]): each["metadata"].get("provides_extra", []) for each in install
    }
    lacking = []
    for each in map(Requirement, wanted.split()):
        extras = offered.get(canonicalize_name(each.name))
        lacking += (
            [str(each)] if extras is None else [f"{each.name}[{one}]" for one in each.extras if one not in extras]
        )
    return lacking


def test_documented_requirements_exist(dist, tmp_path):
    wanted = sorted(lines())
    assert {"lipserve-client", "lipserve[cluster]"} <= set(wanted)
    # resolve all of them at once
    install = resolved(dist, tmp_path, *dict.fromkeys(word for each in wanted for word in each.split()))
    assert {lines()[each]: lack for each in wanted if (lack := missing(install, each))} == {}
    for each in install:
        if each["metadata"]["name"] in SOURCES.values():  # that of this checkout, not of the index
            assert Path(urlparse(each["download_info"]["url"]).path).parent == dist


def test_missing_extras_and_names_are_detected(dist, tmp_path):
    install = resolved(dist, tmp_path, "--no-deps", "lipserve-client[bars]")
    assert missing(install, "lipserve-client[bars]") == ["lipserve-client[bars]"]
    assert missing(install, "lipserve-client[progress] lipserve") == ["lipserve"]
