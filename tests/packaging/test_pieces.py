"""The base installation: it serves, learns and shows the dashboard without extras, and names missing ones."""

import os
import pickle
import re
import subprocess
import sys
import tomllib
from io import BytesIO

import numpy as np
import pytest

from lipcore import extras
from lipcore.extras import EXTRAS, MissingExtraError
from lipserve import ApiError, Client, StreamClient
from tests import ROOT
from tests.service.data import DEADLINE, eventually
from tests.service.server import Server

pytestmark = pytest.mark.slow  # starts services without extras

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
BASE = {re.split(r"[^\w-]", line)[0] for line in PROJECT["dependencies"]}
HIDDEN = [name for each in EXTRAS.values() for name in each.modules if name not in BASE]
"""Modules of extras that the dependencies do not include."""
ZEROS = [0.0] * 7
URDF = b"""<robot name="one"><link name="base"/><link name="arm"><inertial><mass value="1"/>
<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
<joint name="turn" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""


def without(*modules):
    """Return the environment of a process in which these modules are not importable."""
    found = os.pathsep.join(filter(None, [str(ROOT / "tests/packaging/bare"), os.environ.get("PYTHONPATH", "")]))
    return {"PYTHONPATH": found, "LIPSERVE_TEST_HIDDEN": ",".join(modules)}


def recording(rows=200):
    """Return t, q, dq, ddq and tau of two joints."""
    t = np.arange(rows) / 50
    angle = np.outer(t, [1.7, 2.3])
    q, dq, ddq = np.sin(angle), np.array([1.7, 2.3]) * np.cos(angle), -(np.array([1.7, 2.3]) ** 2) * np.sin(angle)
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
def test_csv_names_its_extra_and_npz_is_read(server, client):
    columns = recording()
    rows = np.column_stack(list(columns.values()))
    names = ["t", *(f"{name}{joint}" for name in ("q", "dq", "ddq", "tau") for joint in (1, 2))]
    csv = "\n".join([",".join(names), *(",".join(map(repr, map(float, row))) for row in rows)])
    answer = server.client.post("/v1/datasets", content=csv, headers={"content-type": "text/csv"})
    assert answer.status_code == 501
    error = answer.json()["error"]
    assert error["code"] == "not_installed"
    assert error["message"].endswith("needs the module pyarrow, which is not installed: pip install 'lipserve[ingest]'")
    assert error["detail"][0] == {"field": "extra", "value": "ingest", "expected": "pip install 'lipserve[ingest]'"}
    packed = BytesIO()
    np.savez(packed, **columns)
    answer = server.client.post(
        "/v1/datasets", content=packed.getvalue(), headers={"content-type": "application/x-npz"}
    )
    assert answer.status_code == 201
    assert answer.json()["report"]["rows"] == len(rows)


@pytest.mark.skipif("pinocchio" not in HIDDEN, reason="Pinocchio is part of the base")
def test_urdf_names_its_extra(server):
    answer = server.client.post("/v1/robots", content=URDF, headers={"content-type": "application/xml"})
    assert (answer.status_code, answer.json()["error"]["code"]) == (501, "not_installed")
    assert "pip install 'lipserve[robots]'" in answer.json()["error"]["message"]


@pytest.mark.skipif("torch" not in HIDDEN, reason="torch is part of the base")
def test_training_with_torch_names_its_extra(client, tmp_path):
    np.savez(tmp_path / "two.npz", **recording())
    data = client.upload(tmp_path / "two.npz").id
    with pytest.raises(ApiError, match=r"pip install 'lipserve\[train\]'") as caught:
        client.train("two", [data], estimator="se")
    assert (caught.value.status, caught.value.code) == (501, "not_installed")


@pytest.mark.parametrize(
    ("command", "module", "extra"),
    [
        (["simulate", "panda", "x.npz"], "pinocchio", "robots"),
        (["serve", "--port", "0", "--grpc-port", "0"], "grpc", "grpc"),
    ],
)
def test_commands_name_the_extra_and_exit_with_1(command, module, extra, tmp_path):
    environment = {**os.environ, **without(module), "LIPSERVE_HOME": str(tmp_path / "home")}
    done = subprocess.run(
        [sys.executable, "-m", "service", *command],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=DEADLINE,
    )
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
