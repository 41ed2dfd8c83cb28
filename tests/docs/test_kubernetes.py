"""deploy/kubernetes: the objects are valid; their settings, commands, ports and paths exist."""

import shutil
import subprocess
from collections.abc import Iterator
from functools import cache
from typing import Any

import pytest
import yaml

from service.api.server.sockets import DRAIN_S
from service.app import create_app
from service.foundation.settings import Settings
from tests.docs.blocks import ROOT
from tests.docs.test_deployments import PORT, check_command, check_settings, port_of

FOLDER = ROOT / "deploy/kubernetes"
ENTRIES = ("single", "shared", "kserve")
"""Folders that users apply; `shared` is tested with every component."""
VERSIONS = ("1.31.0", "1.37.0")
OWN_NAME = "lipserve"
OPERATORS = ("serving.kserve.io/", "monitoring.coreos.com/")
"""API groups without available schemas; only the pods of their objects are validated."""


def objects_of(folder: str) -> Iterator[dict[str, Any]]:
    """Yield the objects of a folder, without its patches and image names."""
    here = FOLDER / folder
    kustomization = yaml.safe_load((here / "kustomization.yaml").read_text("utf-8"))
    for named in (*kustomization["resources"], *kustomization.get("components", [])):
        target = (here / named).resolve()
        if target.is_dir():
            yield from objects_of(str(target.relative_to(FOLDER)))
        else:
            yield from yaml.safe_load_all(target.read_text("utf-8"))


@cache
def objects(entry: str) -> dict[tuple[str, str], dict[str, Any]]:
    """Return the objects of an entry by kind and name; for `shared` with all components and the patched ConfigMaps."""
    folders = (entry, "gpu", "monitoring") if entry == "shared" else (entry,)
    listed = [each for folder in folders for each in objects_of(folder)]
    made = {(each["kind"], each["metadata"]["name"]): each for each in listed}
    assert len(made) == len(listed)
    if entry == "shared":
        patch = yaml.safe_load((FOLDER / "workers/cluster.yaml").read_text("utf-8"))
        made["ConfigMap", patch["metadata"]["name"]]["data"] |= patch["data"]
    return made


def pod_of(each: dict[str, Any]) -> dict[str, Any] | None:
    """Return the pod specification of an object, if it has one."""
    if each["kind"] == "ServingRuntime":
        return {name: each["spec"][name] for name in ("containers", "volumes")}
    return each["spec"]["template"]["spec"] if each["kind"] in ("Deployment", "StatefulSet") else None


def pods(entry: str) -> dict[str, dict[str, Any]]:
    """Return the pod specifications by name of the owning object."""
    return {name: pod for (_, name), each in objects(entry).items() if (pod := pod_of(each)) is not None}


def environment(entry: str, container: dict[str, Any]) -> dict[str, str]:
    """Return the environment of a container; every source must exist."""
    given: dict[str, str] = {each["name"]: each["value"] for each in container.get("env", [])}
    for source in container.get("envFrom", []):
        ((kind, named),) = source.items()
        found = objects(entry)[{"configMapRef": "ConfigMap", "secretRef": "Secret"}[kind], named["name"]]
        given |= found.get("data", {}) | found.get("stringData", {})
    return given


def containers_of(pod: dict[str, Any] | None) -> list[dict[str, Any]]:
    """Return the containers of a pod."""
    return [] if pod is None else [*pod.get("initContainers", []), *pod["containers"]]


def containers() -> list[Any]:
    """Return every container with its entry and owner."""
    return [
        pytest.param(entry, name, container, id=f"{entry}-{name}-{container['name']}")
        for entry in ENTRIES
        for name, pod in pods(entry).items()
        for container in containers_of(pod)
    ]


@pytest.mark.slow
@pytest.mark.parametrize("entry", ENTRIES)
@pytest.mark.parametrize("version", VERSIONS)
def test_objects_match_kubernetes_schemas(entry, version):
    schemas = pytest.importorskip("kubernetes_validate", reason="the schemas of Kubernetes are not installed")
    core = 0
    for (_, name), each in objects(entry).items():
        checked: dict[str, Any] = each
        if each["apiVersion"].startswith(OPERATORS):
            pod = pod_of(each)
            if pod is None:
                continue
            checked = {"apiVersion": "v1", "kind": "Pod", "metadata": {"name": name}, "spec": pod}
        schemas.validate(checked, version, strict=True)
        core += 1
    assert core >= 3
    broken = {"apiVersion": "v1", "kind": "Service", "metadata": {"name": "x"}, "spec": {"ports": [{"prot": 1}]}}
    with pytest.raises(schemas.ValidationError):
        schemas.validate(broken, version, strict=True)


@pytest.mark.parametrize("entry", ENTRIES)
def test_kustomize_renders_checked_objects(entry):
    kubectl = shutil.which("kubectl")
    if kubectl is None:
        pytest.skip("kubectl is not installed")
    done = subprocess.run([kubectl, "kustomize", FOLDER / entry], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    rendered = {(each["kind"], each["metadata"]["name"]): each for each in yaml.safe_load_all(done.stdout)}
    expected = objects(entry)
    besides = {
        key for key in expected if key[1] == "lipserve-gpu-worker" or key[0] in ("ServiceMonitor", "PrometheusRule")
    }
    assert rendered.keys() == expected.keys() - besides
    for key, each in rendered.items():
        for container in containers_of(pod_of(each)):
            registry, _, image = container["image"].rpartition("/")
            assert registry
            assert image.startswith(f"{OWN_NAME}:")
            container["image"] = OWN_NAME
        assert each == expected[key]


@pytest.mark.slow
@pytest.mark.parametrize(("entry", "name", "container"), containers())
def test_containers_have_valid_settings_commands_and_limits(entry, name, container, monkeypatch):
    settings = check_settings(environment(entry, container), monkeypatch)
    check_command(*container["command"])
    assert container["image"] in (OWN_NAME, "lipserve-cuda")
    assert container["resources"]["limits"]["memory"]
    assert container["resources"]["requests"].keys() == {"cpu", "memory"}
    secured = container["securityContext"]
    assert (secured["readOnlyRootFilesystem"], secured["allowPrivilegeEscalation"]) == (True, False)
    assert secured["capabilities"] == {"drop": ["ALL"]}
    pod = pods(entry)[name]
    of_pod = pod.get("securityContext", secured)
    assert (of_pod["runAsNonRoot"], of_pod["runAsUser"]) == (True, 10001)
    if container["command"][:2] != ["lipserve", "serve"]:
        return
    assert (settings.keys_needed, settings.grpc_port) == (True, 8001)
    ports = {each["name"]: each["containerPort"] for each in container["ports"]}
    assert set(ports.values()) <= {PORT, settings.grpc_port}
    paths = create_app(Settings(home="/nowhere")).openapi()["paths"]
    for probe in ("startupProbe", "livenessProbe", "readinessProbe"):
        if probe in container:
            request = container[probe]["httpGet"]
            assert request["path"] in paths
            assert create_app().state.rules.of("GET", request["path"]).scope is None  # probes send no key
            assert ports.get(request["port"], request["port"]) == PORT
    if "terminationGracePeriodSeconds" in pod:
        assert pod["terminationGracePeriodSeconds"] > settings.stop_notice_s + DRAIN_S


@pytest.mark.parametrize("entry", ENTRIES)
def test_references_between_objects_resolve(entry):
    made = objects(entry)
    for (kind, name), each in made.items():
        spec, pod = each.get("spec", {}), pod_of(each)
        if kind in ("Deployment", "StatefulSet"):
            assert spec["selector"]["matchLabels"] == spec["template"]["metadata"]["labels"]
        if pod is not None:
            volumes = {volume["name"] for volume in pod["volumes"]}
            volumes |= {claim["metadata"]["name"] for claim in spec.get("volumeClaimTemplates", [])}
            assert {mount["name"] for one in containers_of(pod) for mount in one["volumeMounts"]} == volumes
        if kind == "Service":
            (target,) = (
                other["spec"]["template"]["spec"]["containers"][0]
                for other in made.values()
                if other["kind"] in ("Deployment", "StatefulSet")
                and other["spec"]["selector"]["matchLabels"] == spec["selector"]
            )
            ports = {port["name"]: port["containerPort"] for port in target["ports"]}
            assert {port["targetPort"]: port["port"] for port in spec["ports"]} == ports
        if kind == "ServiceMonitor":
            selected = made["Service", OWN_NAME]
            assert spec["selector"]["matchLabels"].items() <= selected["metadata"]["labels"].items()
            (endpoint,) = spec["endpoints"]
            assert endpoint["port"] in {port["name"] for port in selected["spec"]["ports"]}
            assert create_app().state.rules.of("GET", endpoint["path"]).scope == "read"
        if kind == "InferenceService":
            model = spec["predictor"]["model"]
            runtime = made["ServingRuntime", model["runtime"]]["spec"]
            assert model["modelFormat"]["name"] in {form["name"] for form in runtime["supportedModelFormats"]}
            assert model["protocolVersion"] in runtime["protocolVersions"]
            assert runtime["containers"][0]["name"] == "kserve-container"
            assert (ROOT / "models" / name).is_dir()


def test_single_service_has_one_writer_and_a_disk():
    spec = objects("single")["StatefulSet", OWN_NAME]["spec"]
    (claim,) = spec["volumeClaimTemplates"]
    assert (spec["replicas"], claim["spec"]["accessModes"]) == (1, ["ReadWriteOncePod"])
    mounts = spec["template"]["spec"]["containers"][0]["volumeMounts"]
    assert {"name": claim["metadata"]["name"], "mountPath": "/data"} in mounts
    dockerfile = (ROOT / "Dockerfile").read_text("utf-8")
    assert "LIPSERVE_HOME=/data" in dockerfile
    assert "--uid 10001" in dockerfile
    assert "[train,robots,ingest,cluster,grpc]" in dockerfile


def test_only_members_reach_cluster():
    made = objects("shared")
    host, port = port_of(made["ConfigMap", "lipserve-store"]["data"]["LIPSERVE_CLUSTER"])
    assert made["Service", host]["spec"]["ports"][0]["port"] == port
    assert str(port) in pods("shared")[host]["containers"][0]["command"]
    policy = made["NetworkPolicy", "lipserve-cluster"]["spec"]
    members = {each["key"]: set(each["values"]) for each in policy["podSelector"]["matchExpressions"]}
    for name in (host, "lipserve-worker", "lipserve-gpu-worker"):
        labels = made["Deployment", name]["spec"]["template"]["metadata"]["labels"]
        assert all(labels[key] in values for key, values in members.items())
    service = made["Deployment", OWN_NAME]["spec"]["template"]["metadata"]["labels"]
    assert service["part"] not in members["part"]
    (source,) = policy["ingress"][0]["from"]
    assert source["podSelector"]["matchLabels"].items() <= service.items()


def test_files_contain_no_secret():
    for entry in ENTRIES:
        for (kind, _), each in objects(entry).items():
            if kind == "Secret":
                assert all("CHANGE-ME" in value for value in each["stringData"].values())
