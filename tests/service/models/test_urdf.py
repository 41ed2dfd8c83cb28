"""The arm that a version has learnt, asked for as a URDF."""

import numpy as np
import pytest

from lipcore.kernels.geometry import Geometry
from lipcore.robots.urdf import RigidBody
from service.client import ApiError
from tests.service.client.conftest import over
from tests.service.data import error, service_of
from tests.service.models.versions import JOINTS, NO_BODIES, WARNING, panda, publish_arm


@pytest.fixture(scope="module")
def arm(api) -> str:
    service = service_of(api)
    publish_arm(service.database, service.files, "urdf-arm", geometry=None)
    publish_arm(service.database, service.files, "urdf-arm")
    publish_arm(service.database, service.files, "urdf-none", **NO_BODIES)
    return "urdf-arm"


def test_it_is_the_robot(api, arm):
    answer = api.get(f"/v1/models/{arm}/urdf")
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "application/xml"
    assert answer.headers["content-disposition"] == 'attachment; filename="urdf-arm-v2.urdf"'
    robot = RigidBody.from_urdf(answer.text, JOINTS, panda().joint_types)
    assert robot.name == "urdf-arm-v2"
    np.testing.assert_allclose(robot.parameters(), panda().parameters(), atol=1e-12)
    expected = Geometry.from_robot(panda()).constants
    np.testing.assert_allclose(Geometry.from_robot(robot).constants, expected, atol=1e-12)


def test_a_version_is_named_by_number_or_alias(api, arm):
    assert api.put(f"/v1/models/{arm}/aliases/best", json={"version": 2}).status_code == 200
    for params in ({"version": 2}, {"alias": "best"}, {"alias": "serving"}):
        assert api.get(f"/v1/models/{arm}/urdf", params=params).status_code == 200, params
    for params, status in (({"version": 3}, 404), ({"alias": "no"}, 404), ({"alias": "best", "version": 2}, 422)):
        assert api.get(f"/v1/models/{arm}/urdf", params=params).status_code == status, params


@pytest.mark.parametrize(
    ("model", "version", "reason"),
    [("urdf-arm", 1, "where its joints lie"), ("urdf-none", 1, "no rigid bodies")],
)
def test_a_version_without_an_arm_is_refused(api, arm, model, version, reason):
    refusal = error(api.get(f"/v1/models/{model}/urdf", params={"version": version}), 422, "invalid_request")
    assert f"version {version} of model {model!r}" in refusal["message"]
    assert reason in refusal["message"]
    assert refusal["detail"][0]["field"] == "version"


def test_the_client_has_its_text_and_shows_the_arm(api, arm):
    with over(api._transport) as client:
        assert client.urdf(arm) == client.urdf(arm, 2) == client.urdf(arm, alias="serving")
        assert client.urdf(arm) == api.get(f"/v1/models/{arm}/urdf").text
        with pytest.raises(ApiError, match="no rigid bodies"):
            client.urdf("urdf-none")
        shown = client.version(arm, 2)
        assert shown.arm.joint_names == JOINTS
        assert str(shown).splitlines()[1] == f"careful: {WARNING}"
        assert "mirror image" in str(shown)
        bare = client.version("urdf-none", 1)
        assert bare.arm is None
        assert str(bare) == f"urdf-none version 1: {bare.estimator}, 7 joints: {', '.join(JOINTS)}"
