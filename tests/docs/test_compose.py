"""compose.yaml says nothing that there is not: settings, commands, ports, secrets, what depends on what."""

from __future__ import annotations

import re
import shlex

import click
import pytest
import yaml
from distributed.cli.dask_scheduler import main as dask_scheduler

from service.foundation.settings import Settings
from tests.docs.blocks import ROOT
from tests.docs.test_commands import parse

COMPOSE = yaml.safe_load((ROOT / "compose.yaml").read_text("utf-8"))
SERVICES = COMPOSE["services"]
VARIABLE = re.compile(r"\$\{([A-Z0-9_]+)([^}]*)\}")
OURS = [name for name, each in SERVICES.items() if each["image"] == "lipserve"]


def environment(name: str) -> dict[str, str]:
    """Of a container, with something in place of every variable."""
    given = SERVICES[name].get("environment", {})
    return {key: VARIABLE.sub("0123456789abcdef", value) for key, value in given.items()}


def port_of(url: str) -> tuple[str, int]:
    """Host and port that a URL names."""
    found = re.fullmatch(r"\w+://(?:[^@/]*@)?([\w-]+):(\d+)(?:/.*)?", url)
    assert found is not None, url
    return found[1], int(found[2])


@pytest.mark.parametrize("name", OURS)
def test_settings_are_those_that_there_are(name, monkeypatch):
    given = environment(name)
    for key, value in given.items():
        assert isinstance(value, str), f"{name}: {key} is {value!r}: quote it"
        if key.startswith("LIPSERVE_"):
            assert key.removeprefix("LIPSERVE_").lower() in Settings.model_fields, f"{name}: {key}"
            monkeypatch.setenv(key, value)
    Settings()


def test_commands_are_those_that_there_are():
    for name in ("service", "worker"):
        parse(shlex.join(SERVICES[name]["command"]))
    program, kind, *options = SERVICES["scheduler"]["command"]
    assert (program, kind) == ("dask", "scheduler")
    dask_scheduler.make_parser(click.Context(dask_scheduler)).parse_args(options)
    program, flag, code = SERVICES["bucket"]["command"]
    assert (program, flag) == ("python", "-c")
    compile(code, "compose.yaml", "exec")
    assert SERVICES["service"]["environment"]["LIPSERVE_FILES_URL"].split("/")[2] in code


def test_who_is_named_is_there_and_listens():
    given = environment("service")
    command = SERVICES["scheduler"]["command"]
    assert port_of(given["LIPSERVE_CLUSTER"]) == ("scheduler", int(command[command.index("--port") + 1]))
    host, port = port_of(given["AWS_ENDPOINT_URL"])
    assert f"-{host}.port={port}" in SERVICES[host]["command"]
    assert f"-ip={host}" in SERVICES[host]["command"]
    host, port = port_of(given["LIPSERVE_DATABASE_URL"])
    assert (host, port) == ("postgres", 5432)
    user, _, name = re.match(r"postgresql://(\w+):(.*)@.*/(\w+)", given["LIPSERVE_DATABASE_URL"]).groups()
    database = SERVICES["postgres"]["environment"]
    assert (user, name) == (database["POSTGRES_USER"], database["POSTGRES_DB"])
    published = SERVICES["balancer"]["ports"][0].rpartition(":")[2]
    balancing = COMPOSE["configs"]["haproxy"]["content"]
    assert f"bind :{published}\n" in balancing
    listens = f"service:{Settings.model_fields['port'].default}"
    assert set(re.findall(r"server-template \S+ \d+ (\S+)", balancing)) == {listens}
    for path in re.findall(r"uri (\S+)", balancing):
        assert path in ("/health/ready", "/health/live")


@pytest.mark.parametrize("name", SERVICES)
def test_what_is_used_is_declared(name):
    each = SERVICES[name]
    assert set(each.get("networks", [])) <= COMPOSE["networks"].keys()
    assert {config["source"] for config in each.get("configs", [])} <= COMPOSE["configs"].keys()
    mounted = {volume.partition(":")[0] for volume in each.get("volumes", []) if ":" in volume}
    assert mounted <= COMPOSE["volumes"].keys()
    for other, wanted in each.get("depends_on", {}).items():
        healthy = wanted["condition"] == "service_healthy"
        disabled = SERVICES[other].get("healthcheck", {}).get("disable", False)
        assert not (healthy and disabled), f"{name} waits for the health of {other}, which has none"
        assert not (healthy and other not in OURS and "healthcheck" not in SERVICES[other])


@pytest.mark.parametrize("name", SERVICES)
def test_everything_has_limits_and_starts_again(name):
    each = SERVICES[name]
    assert each["deploy"]["resources"]["limits"].keys() == {"cpus", "memory"}
    assert each["restart"] in ("unless-stopped", "on-failure")
    assert re.fullmatch(r"[\w./-]+:[\w.-]+|lipserve", each["image"]), "name a version"


def test_only_the_balancer_is_published():
    assert COMPOSE["networks"]["inside"] == {"internal": True}
    assert [name for name, each in SERVICES.items() if "ports" in each or "outside" in each["networks"]] == ["balancer"]
    assert SERVICES["service"]["environment"]["LIPSERVE_KEYS"] == "on"


def test_no_secret_has_a_default():
    text = (ROOT / "compose.yaml").read_text("utf-8")
    body = "\n".join(line for line in text.splitlines() if not line.lstrip().startswith("#"))
    for name, rest in VARIABLE.findall(body):
        if re.search("PASSWORD|SECRET|KEY", name):
            assert rest.startswith(":?"), name
        else:
            assert rest.startswith(":-"), name
    for key, value in re.findall(r"(\w*(?:PASSWORD|SECRET)\w*): (.*)", body):
        assert value.startswith("${"), key


def test_there_are_two_of_each():
    assert SERVICES["service"]["deploy"]["replicas"] == SERVICES["worker"]["deploy"]["replicas"] == 2
    # each container has a home of its own: a volume without a name
    assert SERVICES["service"]["volumes"] == SERVICES["worker"]["volumes"] == ["/data"]
