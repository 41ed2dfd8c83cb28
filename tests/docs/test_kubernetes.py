"""The objects of docs/examples/kubernetes.yaml fit each other, and name settings, commands and paths that there are."""

from __future__ import annotations

import re
import shlex

import click
import pytest
import yaml
from distributed.cli.dask_scheduler import main as dask_scheduler

from service.app import create_app
from service.foundation.settings import Settings
from tests.docs.blocks import ROOT
from tests.docs.test_commands import parse

EXAMPLES = ROOT / "docs/examples"
OBJECTS = list(yaml.safe_load_all((EXAMPLES / "kubernetes.yaml").read_text("utf-8")))
GPU = yaml.safe_load((EXAMPLES / "kubernetes-gpu.yaml").read_text("utf-8"))
"""What a Deployment of workers with a GPU has instead."""


def of_kind(kind: str) -> dict[str, dict]:
    return {each["metadata"]["name"]: each for each in OBJECTS if each["kind"] == kind}


DEPLOYMENTS = of_kind("Deployment")


def given() -> dict[str, str]:
    """What containers have in their environment."""
    return {**of_kind("ConfigMap")["lipserve"]["data"], **of_kind("Secret")["lipserve"]["stringData"]}


def container(deployment: str) -> dict:
    (found,) = DEPLOYMENTS[deployment]["spec"]["template"]["spec"]["containers"]
    return found


def test_settings_are_those_that_there_are(monkeypatch):
    more = {each["name"]: each["value"] for each in container("lipserve").get("env", [])}
    for key, value in {**given(), **more}.items():
        assert isinstance(value, str), f"{key} is {value!r}: quote it"
        if key.startswith("LIPSERVE_"):
            assert key.removeprefix("LIPSERVE_").lower() in Settings.model_fields, key
            monkeypatch.setenv(key, value)
    Settings()


def test_commands_are_those_that_there_are():
    pieces = [each["command"] for each in GPU["spec"]["template"]["spec"]["containers"]]
    for command in [*(container(name)["command"] for name in DEPLOYMENTS), *pieces]:
        if command[0] == "dask":
            dask_scheduler.make_parser(click.Context(dask_scheduler)).parse_args(command[2:])
        else:
            parse(shlex.join(command))


@pytest.mark.parametrize("name", DEPLOYMENTS)
def test_selectors_find_what_is_made(name):
    spec = DEPLOYMENTS[name]["spec"]
    assert spec["selector"]["matchLabels"] == spec["template"]["metadata"]["labels"]
    mounts = {mount["name"] for mount in container(name).get("volumeMounts", [])}
    assert mounts == {volume["name"] for volume in spec["template"]["spec"].get("volumes", [])}
    for source in container(name).get("envFrom", []):
        (kind,) = source
        assert source[kind]["name"] in of_kind({"configMapRef": "ConfigMap", "secretRef": "Secret"}[kind])


def test_services_lead_to_ports_that_are_listened_on():
    for service in of_kind("Service").values():
        found = [
            each
            for each in DEPLOYMENTS.values()
            if each["spec"]["selector"]["matchLabels"] == service["spec"]["selector"]
        ]
        assert len(found) == 1
        ports = {port["name"]: port["containerPort"] for port in container(found[0]["metadata"]["name"])["ports"]}
        for port in service["spec"]["ports"]:
            assert port["targetPort"] in ports
    host, port = re.fullmatch(r"tcp://([\w-]+):(\d+)", given()["LIPSERVE_CLUSTER"]).groups()
    assert of_kind("Service")[host]["spec"]["ports"][0]["port"] == int(port)
    assert f'"{port}"' in str(container("lipserve-scheduler")["command"]).replace("'", '"')
    assert container("lipserve")["ports"][0]["containerPort"] == Settings.model_fields["port"].default


def test_probes_ask_what_there_is(tmp_path):
    paths = create_app(Settings(home=tmp_path)).openapi()["paths"]
    for name in ("startupProbe", "livenessProbe", "readinessProbe"):
        assert container("lipserve")[name]["httpGet"]["path"] in paths


def test_only_members_reach_the_cluster():
    policy = of_kind("NetworkPolicy")["lipserve-cluster"]["spec"]
    wanted = {each["key"]: set(each["values"]) for each in policy["podSelector"]["matchExpressions"]}
    for name in ("lipserve-scheduler", "lipserve-worker"):
        labels = DEPLOYMENTS[name]["spec"]["template"]["metadata"]["labels"]
        assert all(labels[key] in values for key, values in wanted.items())
    service = DEPLOYMENTS["lipserve"]["spec"]["template"]["metadata"]["labels"]
    assert service["part"] not in wanted["part"]
    (source,) = policy["ingress"][0]["from"]
    assert source["podSelector"]["matchLabels"].items() <= service.items()
