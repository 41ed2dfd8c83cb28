"""compose.yaml: its settings, commands, ports and names exist."""

import re
import shlex

import click
import pytest
import yaml
from distributed.cli.dask_scheduler import main as dask_scheduler

from service.foundation.settings import Settings
from tests.docs.blocks import ROOT
from tests.docs.test_pages import parse

COMPOSE = yaml.safe_load((ROOT / "compose.yaml").read_text("utf-8"))
SERVICES = COMPOSE["services"]
VARIABLE = re.compile(r"\$\{([A-Z0-9_]+)([^}]*)\}")
PORT = Settings.model_fields["port"].default


def environment(name: str) -> dict[str, str]:
    """Return the environment of a Compose container, with a value for every variable."""
    given = SERVICES[name].get("environment", {})
    return {key: VARIABLE.sub("0123456789abcdef", value) for key, value in given.items()}


ENVIRONMENTS = {name: environment(name) for name, each in SERVICES.items() if each["image"] == "lipserve"}


def check_settings(given: dict[str, str], patch: pytest.MonkeyPatch) -> Settings:
    """Check the settings in the environment of a container; return them."""
    for key, value in given.items():
        assert isinstance(value, str), f"{key} is {value!r}: quote it"
        if key.startswith("LIPSERVE_"):
            assert key.removeprefix("LIPSERVE_").lower() in Settings.model_fields, key
            patch.setenv(key, value)
    return Settings(host="0.0.0.0")


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_settings_exist(name, monkeypatch):
    check_settings(ENVIRONMENTS[name], monkeypatch)


def check_command(program: str, *words: str) -> None:
    """Raise if the command does not exist."""
    if program == "dask":
        dask_scheduler.make_parser(click.Context(dask_scheduler)).parse_args(list(words[1:]))
    else:
        parse(shlex.join([program, *words]))


def test_commands_exist():
    for name in ("service", "worker", "scheduler"):
        check_command(*SERVICES[name]["command"])
    program, flag, code = SERVICES["bucket"]["command"]
    assert (program, flag) == ("python", "-c")
    compile(code, "compose.yaml", "exec")
    assert SERVICES["service"]["environment"]["LIPSERVE_FILES_URL"].split("/")[2] in code


def port_of(url: str) -> tuple[str, int]:
    """Return host and port of a URL."""
    named = re.fullmatch(r"\w+://(?:[^@/]*@)?([\w-]+):(\d+)(?:/.*)?", url)
    assert named is not None, url
    return named[1], int(named[2])


def test_addresses_match_services_and_ports():
    urls = environment("service")
    command = SERVICES["scheduler"]["command"]
    assert port_of(urls["LIPSERVE_CLUSTER"]) == ("scheduler", int(command[command.index("--port") + 1]))
    host, port = port_of(urls["AWS_ENDPOINT_URL"])
    assert {f"-{host}.port={port}", f"-ip={host}"} <= set(SERVICES[host]["command"])
    assert port_of(urls["LIPSERVE_DATABASE_URL"]) == ("postgres", 5432)
    user, _, name = re.match(r"postgresql://(\w+):(.*)@.*/(\w+)", urls["LIPSERVE_DATABASE_URL"]).groups()
    database = SERVICES["postgres"]["environment"]
    assert (user, name) == (database["POSTGRES_USER"], database["POSTGRES_DB"])
    published = SERVICES["balancer"]["ports"][0].rpartition(":")[2]
    balancing = COMPOSE["configs"]["haproxy"]["content"]
    assert f"bind :{published}\n" in balancing
    assert set(re.findall(r"server-template \S+ \d+ (\S+)", balancing)) == {f"service:{PORT}"}
    assert set(re.findall(r"uri (\S+)", balancing)) <= {"/health/ready", "/health/live"}


@pytest.mark.parametrize("name", SERVICES)
def test_services_declare_resources_and_limits(name):
    each = SERVICES[name]
    assert set(each.get("networks", [])) <= COMPOSE["networks"].keys()
    assert {config["source"] for config in each.get("configs", [])} <= COMPOSE["configs"].keys()
    mounted = {volume.partition(":")[0] for volume in each.get("volumes", []) if ":" in volume}
    assert mounted <= COMPOSE["volumes"].keys()
    for other, needed in each.get("depends_on", {}).items():
        if needed["condition"] == "service_healthy":
            check = SERVICES[other].get("healthcheck", {"disable": other not in ENVIRONMENTS})
            assert not check.get("disable", False), f"{name} waits for the health of {other}, which has none"
    assert each["deploy"]["resources"]["limits"].keys() == {"cpus", "memory"}
    assert each["restart"] in ("unless-stopped", "on-failure")
    assert re.fullmatch(r"[\w./-]+:[\w.-]+|lipserve", each["image"]), "name a version"


def test_only_balancer_is_published_and_secrets_have_no_default():
    assert COMPOSE["networks"]["inside"] == {"internal": True}
    assert [name for name, each in SERVICES.items() if "ports" in each or "outside" in each["networks"]] == ["balancer"]
    assert SERVICES["service"]["environment"]["LIPSERVE_KEYS"] == "on"
    # each container has its own home: an anonymous volume
    assert SERVICES["service"]["volumes"] == SERVICES["worker"]["volumes"] == ["/data"]
    text = (ROOT / "compose.yaml").read_text("utf-8")
    body = "\n".join(line for line in text.splitlines() if not line.lstrip().startswith("#"))
    for name, rest in VARIABLE.findall(body):
        assert rest.startswith(":?" if re.search("PASSWORD|SECRET|KEY", name) else ":-"), name
    for key, value in re.findall(r"(\w*(?:PASSWORD|SECRET)\w*): (.*)", body):
        assert value.startswith("${"), key
