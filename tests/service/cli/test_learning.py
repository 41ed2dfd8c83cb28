"""`lipserve learning`, `alarms` and `robots`; every route has a command, or a reason not to have one."""

import ast
import inspect
from pathlib import Path

import pytest

from lipserve import Client
from lipserve.call import ROUTES
from lipserve.wording import percent
from service import cli
from tests.service.cli.conftest import QUICKLY, lacking
from tests.service.data import eventually
from tests.service.learning.learning_models import observation_batch
from tests.service.models.archives.packing import TAR
from tests.service.robots.test_robots import urdf

INFERENCE = "of the Open Inference Protocol, which has clients of its own"
REASONS = {
    "GET /metrics": "for Prometheus, in its own format",
    "GET /v1/overview": "the dashboard's first page; `models list`, `learning show`, `payload` print it",
    "GET /v1/datasets/{dataset}/preview": "rows for the plots of the data set's page",
    "POST /v1/models/{model}/trace": "rows for the plots of the model's page; `evaluate` prints the figures",
    "GET /v1/models/{model}/live": "does not end, for pages: `lipserve open MODEL --live` tells their address",
    "POST /v1/models/{model}/observations": "batches of programs; `lipserve stream` teaches from the shell",
    "POST /v1/models/{model}/gravity": "`predict --components gravity` prints it",
    "POST /v1/models/{model}/wrench": "for programs that measure torque",
    "POST /v1/echo": "measures what transport costs, for clients and benchmarks",
    "GET /v1/jobs/{job}/events": "for pages; `jobs follow` asks for the job again and again",
    "GET /health/live": "for what watches over the service",
    "GET /v2": INFERENCE,
    "GET /v2/health/live": INFERENCE,
    "GET /v2/health/ready": INFERENCE,
    "GET /v2/models/{model}": INFERENCE,
    "GET /v2/models/{model}/ready": INFERENCE,
    "GET /v2/models/{model}/versions/{version}": INFERENCE,
    "GET /v2/models/{model}/versions/{version}/ready": INFERENCE,
    "POST /v2/models/{model}/infer": INFERENCE,
    "POST /v2/models/{model}/versions/{version}/infer": INFERENCE,
}
"""Routes without a command, and the reason."""


def methods(source, owner):
    """Return the methods that a source calls on the name `owner`."""
    nodes = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Attribute)]
    return {node.attr for node in nodes if isinstance(node.value, ast.Name) and node.value.id == owner}


def used_by_commands():
    """Return the client calls that commands use, also indirectly; the demo does not count."""
    commands = [path for path in Path(cli.__file__).parent.glob("*.py") if path.name != "demo.py"]
    sources = [path.read_text() for path in commands]
    used = set().union(*(methods(source, "client") for source in sources))
    for node in ast.walk(ast.parse(inspect.getsource(Client))):
        if isinstance(node, ast.FunctionDef) and node.name in used:
            used |= methods(ast.unparse(node), "self")
    return used


def test_every_route_has_a_command_or_a_reason(api):
    used, kinds = used_by_commands(), ("get", "post", "put", "patch", "delete")
    paths = api.get("/openapi.json").json()["paths"]
    routes = {(method.upper(), path) for path, found in paths.items() for method in found if method in kinds}
    assert set(REASONS) <= set(map(" ".join, routes)), "a reason for a route that there is not"
    for route in sorted(routes):
        reason = REASONS.get(" ".join(route))
        assert (ROUTES[route] in used) != (reason is not None), (route, "a command, or else a reason")
        assert reason is None or len(reason) > 10


@pytest.fixture
def pupil(server, arm):
    """Separate model that has learnt two batches."""
    archive = server.client.get(f"/v1/models/{arm[0]}/export").content
    query = {"name": "cli-pupil", "promotion": "always"}
    made = server.client.post("/v1/models/import", content=archive, headers=TAR, params=query)
    assert made.status_code == 201, made.text
    for number in range(2):
        answer = server.client.post("/v1/models/cli-pupil/observations", json=observation_batch(number))
        assert answer.status_code == 200, answer.text
    eventually(lambda: server.client.get("/v1/models/cli-pupil/learning").json()["status"]["published"] == 2)
    yield "cli-pupil"
    assert server.client.delete("/v1/models/cli-pupil").status_code == 204


@pytest.mark.slow
def test_learning_is_shown_set_and_undone(run_command, run_rejected_command, server, pupil):
    rows = server.client.get(f"/v1/models/{pupil}/quality").json()["windows"][-1]["rows"]
    predicted = f"prediction of {rows} rows of the last 3600 s, before learning from them"
    assert lacking(run_command("learning", "show", pupil), "revision 2 of 2: learning is active", predicted) == []
    assert run_command("learning", "show", pupil, "--json")["quality"]["revision"] == 2
    assert "revision 2 of 2 serving" in run_command("models", "show", pupil)

    options = ("contact_threshold=100", "on_change=learn", "auto_refresh=false")
    assert "on_change = learn" in run_command("learning", "set", pupil, *options)
    options = server.client.get(f"/v1/models/{pupil}/learning").json()["options"]
    assert (options["contact_threshold"], options["auto_refresh"], options["payloads"]) == (100.0, False, True)
    assert "forgetting_s" in run_rejected_command("learning", "set", pupil, "forgetting_s=0.1")

    newest, first = run_command("learning", "batches", pupil, "--json")
    assert (newest["sequence"], first["sequence"]) == (1, 0)
    assert "learnt" in run_command("learning", "batches", pupil, "--stream", "arm")
    assert f"no batches of {pupil}" in run_command("learning", "batches", pupil, "--stream", "nobody")
    batch = (pupil, "arm", 1)
    seen = run_command("learning", "batch", *batch)
    assert f"{newest['accepted']} of {newest['rows']} rows accepted" in seen
    assert len(run_command("learning", "batch", *batch, "--rows", "--json")["observed"]["q"]) == newest["rows"]
    assert "batch 1 of arm unlearnt" in run_command("learning", "unlearn", *batch, "--yes")
    assert "unlearnt" in run_command("learning", "batch", *batch)
    assert "has been unlearnt" in run_rejected_command("learning", "replay", *batch)
    assert f"stream arm of {pupil} deleted" in run_command("learning", "forget", pupil, "arm", "--yes")
    assert run_command("learning", "show", pupil, "--json")["learning"]["status"]["streams"] == []


def test_alarms_are_listed(run_command, pupil):
    assert f"no alarms of {pupil}" in run_command("alarms", pupil)
    assert run_command("alarms", pupil, "--json") == []


@pytest.mark.slow
def test_every_list_shows_the_verdict(run_command, server, recording):
    path = recording(21, samples=120, rate=10.0)
    run_command("train", path, "--model", "cli-listed", *QUICKLY, "--promotion", "always")
    verdict = server.client.get("/v1/models/cli-listed").json()["versions"][0]["verdict"]
    coverage = percent(sum(each["coverage"] for each in verdict["joints"]) / 2)
    error = percent(max(each["range_share"] for each in verdict["joints"]), 1)
    for command in (("models", "list"), ("models", "show", "cli-listed"), ("jobs", "list")):
        lines = run_command(*command).splitlines()
        assert any(coverage in line and error in line for line in lines), lines


def test_robots_are_added_listed_shown_and_deleted(run_command, run_rejected_command, tmp_path):
    path = tmp_path / "one.urdf"
    path.write_bytes(urdf(kind="revolute", joints=("j",)))
    robot = run_command("robots", "add", path, "--json")["id"]
    assert lacking(run_command("robots", "list"), robot, "panda") == []
    shown = run_command("robots", "show", robot)
    assert "sha256" in shown
    assert "-1" in next(line for line in shown.splitlines() if " j " in line)
    assert "7 joints" in run_command("robots", "show", "panda")
    assert f"{robot} deleted" in run_command("robots", "delete", robot, "--yes")
    assert "no robot" in run_rejected_command("robots", "show", robot)
    assert "is no .urdf, .xacro, .sdf or .zip file" in run_rejected_command("robots", "add", Path(__file__))
