"""The base installation: it serves, learns and shows the dashboard without extras, and names missing ones."""

import os
import pickle
import re
import subprocess
import sys
import tomllib

import numpy as np
import pytest

from lipcore import extras
from lipcore.extras import EXTRAS, MissingExtraError
from lipserve import ApiError, Client, StreamClient
from tests import ROOT
from tests.service.data import DEADLINE, csv, error, eventually, npz, post
from tests.service.robots.test_robots import post_robot, urdf
from tests.service.server import Server

pytestmark = pytest.mark.slow  # starts services without extras

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
BASE = {re.split(r"[^\w-]", line)[0] for line in PROJECT["dependencies"]}
HIDDEN = [name for each in EXTRAS.values() for name in each.modules if name not in BASE]
"""Modules of extras that the dependencies do not include."""
ZEROS = [0.0] * 7


def without(*modules):
    """Return the environment of a process in which these modules are not importable."""
    found = os.pathsep.join(filter(None, [str(ROOT / "tests/packaging/bare"), os.environ.get("PYTHONPATH", "")]))
    return {"PYTHONPATH": found, "LIPSERVE_TEST_HIDDEN": ",".join(modules)}


def recording(rows=200):
    """Return t, q, dq, ddq and tau of two joints."""
    t, rate = np.arange(rows) / 50, np.array([1.7, 2.3])
    angle = np.outer(t, rate)
    q, dq, ddq = np.sin(angle), rate * np.cos(angle), -(rate**2) * np.sin(angle)
    return {"t": t, "q": q, "dq": dq, "ddq": ddq, "tau": 2 * ddq + 0.1 * dq}


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    """Start a service of the base installation."""
    with Server(tmp_path_factory.mktemp("bare") / "home", **without(*HIDDEN)) as started:
        yield started


@pytest.fixture
def client(server):
    with Client(server.url) as opened:
        yield opened


def test_extras_are_those_of_the_project():
    offered = set(PROJECT["optional-dependencies"])
    assert set(EXTRAS) <= offered
    (everything,) = PROJECT["optional-dependencies"]["all"]
    assert set(re.search(r"\[(.*)\]", everything)[1].split(",")) == set(EXTRAS)


def test_health_lists_abilities(client):
    health = client.abilities()
    expected = {name: not any(module in HIDDEN for module in extra.modules) for name, extra in EXTRAS.items()}
    assert health.can == expected
    assert {each.extra: each.install for each in health.missing} == {
        name: f"pip install 'lipserve[{name}]'" for name, there in expected.items() if not there
    }


def test_service_predicts_and_shows_the_dashboard(server, client):
    assert client.predict("panda-sim", ZEROS, ZEROS, ZEROS).tau.shape == (7,)
    page = server.client.get("/")
    assert (page.status_code, page.headers["content-type"].partition(";")[0]) == (200, "text/html")
    assert server.client.get("/dashboard/app.js").status_code == 200
    assert server.client.get("/metrics").status_code == 200


def test_learner_starts_with_the_first_frame_with_torque(server, client):
    assert len(server.started()) == 1  # the weigher
    rng = np.random.default_rng(50)
    with StreamClient("panda-sim", url=server.url, stream_id="robot") as stream:
        for _ in range(5):
            q, dq, ddq = (rng.uniform(-0.5, 0.5, 7) for _ in range(3))
            stream.predict(q, dq, ddq, tau=client.predict("panda-sim", q, dq, ddq).tau)
        assert stream.flush().revision > 0
    eventually(lambda: client.predict("panda-sim", ZEROS, ZEROS, ZEROS).revision > 0, DEADLINE)
    assert len(server.started()) == 2


@pytest.mark.skipif("pyarrow" not in HIDDEN, reason="Arrow is part of the base")
def test_csv_names_its_extra_and_npz_is_read(server):
    columns = recording()
    rows = np.column_stack(list(columns.values()))
    names = ["t", *(f"{name}{joint}" for name in ("q", "dq", "ddq", "tau") for joint in (1, 2))]
    answer = post(server.client, csv(dict(zip(names, rows.T.tolist(), strict=True))), "text/csv")
    missing = error(answer, 501, "not_installed")
    assert missing["message"].endswith(
        "needs the module pyarrow, which is not installed: pip install 'lipserve[ingest]'"
    )
    assert missing["detail"][0] == {"field": "extra", "value": "ingest", "expected": "pip install 'lipserve[ingest]'"}
    answer = post(server.client, npz(**columns))
    assert (answer.status_code, answer.json()["report"]["rows"]) == (201, len(rows))


@pytest.mark.skipif("pinocchio" not in HIDDEN, reason="Pinocchio is part of the base")
def test_urdf_names_its_extra(server):
    missing = error(post_robot(server.client, urdf()), 501, "not_installed")
    assert "pip install 'lipserve[robots]'" in missing["message"]


@pytest.mark.skipif("torch" not in HIDDEN, reason="torch is part of the base")
def test_training_with_torch_names_its_extra(server, client):
    data = post(server.client, npz(**recording())).json()["id"]
    with pytest.raises(ApiError, match=r"pip install 'lipserve\[train\]'") as caught:
        client.train("two", [data], estimator="se")
    assert (caught.value.status, caught.value.code) == (501, "not_installed")


@pytest.mark.parametrize(
    ("command", "module", "extra"),
    [
        ("simulate panda x.npz", "pinocchio", "robots"),
        ("serve --port 0 --grpc-port 0", "grpc", "grpc"),
    ],
)
def test_commands_name_the_extra_and_exit_with_1(command, module, extra, tmp_path):
    options = {"env": {**os.environ, **without(module), "LIPSERVE_HOME": str(tmp_path / "home")}, "cwd": tmp_path}
    words = [sys.executable, "-m", "service", *command.split()]
    done = subprocess.run(words, **options, capture_output=True, text=True, check=False, timeout=DEADLINE)
    assert done.returncode == 1, done.stderr
    assert f"needs the module {module}, which is not installed: pip install 'lipserve[{extra}]'" in done.stderr
    assert "Traceback" not in done.stderr


def test_broken_module_is_distinguished_from_missing_module(tmp_path, monkeypatch):
    (tmp_path / "halfway.py").write_text("raise ImportError('libgomp.so.1: no such file')")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(MissingExtraError, match=r"halfway, which cannot be imported \(libgomp") as caught:
        extras.import_extra("halfway", "robots")
    again = pickle.loads(pickle.dumps(caught.value))
    assert (str(again), again.extra) == (str(caught.value), "robots")
    with pytest.raises(MissingExtraError, match="the module nowhere, which is not installed"):
        extras.import_extra("nowhere.else", "train")
