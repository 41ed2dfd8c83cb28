"""Export of the arm that a version has learnt as a URDF."""

import numpy as np
import pytest

from lipcore.kernels.geometry import Geometry
from lipcore.robots.urdf import RigidBody
from tests.service.data import error, service_of
from tests.service.models.versions import JOINTS, NO_BODIES, panda, publish_arm


@pytest.fixture(scope="module")
def arm(api) -> str:
    service = service_of(api)
    publish_arm(service.database, service.files, "urdf-arm")
    publish_arm(service.database, service.files, "urdf-arm")
    publish_arm(service.database, service.files, "urdf-none", **NO_BODIES)
    return "urdf-arm"


def test_urdf_describes_the_robot(api, arm):
    answer = api.get(f"/v1/models/{arm}/urdf")
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "application/xml"
    assert answer.headers["content-disposition"] == 'attachment; filename="urdf-arm-v2.urdf"'
    robot = RigidBody.from_urdf(answer.text, JOINTS, panda().joint_types)
    assert robot.name == "urdf-arm-v2"
    np.testing.assert_allclose(robot.parameters(), panda().parameters(), atol=1e-12)
    expected = Geometry.from_robot(panda()).constants
    np.testing.assert_allclose(Geometry.from_robot(robot).constants, expected, atol=1e-12)


def test_version_is_named_by_number_or_alias(api, arm):
    assert api.put(f"/v1/models/{arm}/aliases/best", json={"version": 2}).status_code == 200
    for params in ({"version": 2}, {"alias": "best"}, {"alias": "serving"}):
        assert api.get(f"/v1/models/{arm}/urdf", params=params).status_code == 200, params
    for params, status in (({"version": 3}, 404), ({"alias": "no"}, 404), ({"alias": "best", "version": 2}, 422)):
        assert api.get(f"/v1/models/{arm}/urdf", params=params).status_code == status, params


def test_version_without_an_arm_is_rejected(api, arm):
    refusal = error(api.get("/v1/models/urdf-none/urdf", params={"version": 1}), 422, "invalid_request")
    assert "version 1 of model 'urdf-none'" in refusal["message"]
    assert "no rigid bodies" in refusal["message"]
    assert refusal["detail"][0]["field"] == "version"
