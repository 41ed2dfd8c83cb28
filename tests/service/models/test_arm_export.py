"""Export of the arm that a version has learnt as URDF and MJCF."""

import io
import json
import tarfile
from xml.etree import ElementTree

import numpy as np
import pytest

from lipcore.data.motion import Motion
from lipcore.export.formats import FORMATS
from lipcore.kernels.base import State
from lipcore.kernels.geometry import Geometry
from lipcore.kernels.newton_euler import rigid_body_torque
from lipcore.robots.urdf import RigidBody
from lipcore.vocabulary import EXPORT_FORMATS
from tests.service.data import error, service_of
from tests.service.models.versions import JOINTS, NO_BODIES, panda, publish_arm


@pytest.fixture(scope="module")
def arm(api) -> str:
    service = service_of(api)
    publish_arm(service.database, service.files, "urdf-arm")
    publish_arm(service.database, service.files, "urdf-arm")
    publish_arm(service.database, service.files, "urdf-none", **NO_BODIES)
    return "urdf-arm"


def export(api, model: str, kind: str, **params):
    return api.get(f"/v1/models/{model}/export", params={"format": kind, **params})


def torque_of(robot: RigidBody, motion: Motion) -> np.ndarray:
    geometry = Geometry.from_robot(robot)
    return np.array(rigid_body_torque(geometry, robot.parameters(), State.paired(motion))).T


def test_every_format_has_a_writer():
    assert ("archive", *FORMATS) == EXPORT_FORMATS


def test_urdf_describes_the_robot(api, arm):
    answer = export(api, arm, "urdf")
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "application/xml"
    assert answer.headers["content-disposition"] == 'attachment; filename="urdf-arm-v2.urdf"'
    robot = RigidBody.from_urdf(answer.text, JOINTS, panda().joint_types)
    assert robot.name == "urdf-arm-v2"
    motion = Motion(*np.random.default_rng(0).uniform(-1, 1, (3, 200, len(JOINTS))))
    found, torque = torque_of(robot, motion), torque_of(panda(), motion)
    assert (np.abs(found - torque).max(axis=0) < 0.01 * np.abs(torque).max()).all()
    expected = Geometry.from_robot(panda()).constants
    np.testing.assert_allclose(Geometry.from_robot(robot).constants, expected, atol=1e-12)


def test_mjcf_has_bodies_joints_and_origin(api, arm):
    answer = export(api, arm, "mjcf", version=1)
    assert answer.headers["content-disposition"] == 'attachment; filename="urdf-arm-v1.xml"'
    root = ElementTree.fromstring(answer.text)
    assert [each.get("name") for each in root.iter("joint")] == list(JOINTS)
    about = json.loads(root.find("custom/text").get("data"))
    assert (about["model"], about["version"], about["revision"]) == (arm, 1, 0)
    masses = [float(each.get("mass")) for each in root.iter("inertial")]
    assert len(masses) == len(JOINTS)
    assert min(masses) > 0


def test_version_is_named_by_number_or_alias(api, arm):
    assert api.put(f"/v1/models/{arm}/aliases/best", json={"version": 2}).status_code == 200
    for params in ({"version": 2}, {"alias": "best"}, {"alias": "serving"}):
        assert export(api, arm, "urdf", **params).status_code == 200, params
    for params, status in (({"version": 3}, 404), ({"alias": "no"}, 404), ({"alias": "best", "version": 2}, 422)):
        assert export(api, arm, "urdf", **params).status_code == status, params


@pytest.mark.parametrize("kind", ["urdf", "mjcf"])
def test_version_without_an_arm_is_rejected(api, arm, kind):
    refusal = error(export(api, "urdf-none", kind, version=1), 422, "invalid_request")
    assert "version 1 of model 'urdf-none'" in refusal["message"]
    assert "no rigid bodies" in refusal["message"]
    assert refusal["detail"][0]["field"] == "version"


def test_function_is_written_in_another_process(api, arm):
    answer = export(api, arm, "onnx", version=1)
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-disposition"] == 'attachment; filename="urdf-arm-v1-onnx.tar"'
    with tarfile.open(fileobj=io.BytesIO(answer.content)) as archive:
        assert "urdf-arm/1/model.onnx" in archive.getnames()
        facts = json.load(archive.extractfile("self_test.json"))
    assert (facts["model"], facts["version"], len(facts["self_test"]["tau"])) == (arm, 1, 100)


def test_status_names_outdated_exports(api):
    service = service_of(api)
    publish_arm(service.database, service.files, "exported-arm")
    assert api.get("/v1/models/exported-arm/learning").json()["status"]["exports"] == []
    for kind in ("urdf", "mjcf", "urdf"):
        assert export(api, "exported-arm", kind).status_code == 200

    def outdated():
        made = api.get("/v1/models/exported-arm/learning").json()["status"]["exports"]
        return [(each["format"], each["version"], each["revision"], each["outdated"]) for each in made]

    assert outdated() == [("urdf", 1, 0, False), ("mjcf", 1, 0, False)]
    q = np.zeros((5, 7)).tolist()
    batch = {"stream_id": "s", "sequence": 0, "t": [0.0, 0.01, 0.02, 0.03, 0.04], "q": q, "dq": q, "ddq": q, "tau": q}
    assert api.post("/v1/models/exported-arm/observations", json=batch).status_code == 200
    assert outdated() == [("urdf", 1, 0, True), ("mjcf", 1, 0, True)]
    publish_arm(service.database, service.files, "exported-arm")
    service.loaded.announce(["exported-arm"])
    assert export(api, "exported-arm", "mjcf").status_code == 200
    assert outdated() == [("mjcf", 2, 0, False), ("urdf", 1, 0, True)]
    lines = api.get("/v1/audit", params={"model": "exported-arm", "change": "version exported"}).json()["items"]
    assert [each["after"]["format"] for each in lines] == ["mjcf", "urdf", "mjcf", "urdf"]
