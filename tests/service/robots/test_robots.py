"""Robots: upload of URDFs, rejected files, and training with rigid bodies."""

import hashlib
import io
import zipfile

import numpy as np
import pytest
from sqlalchemy import update

import lipcore
from lipcore.robots.library import ROBOTS, load_robot, profile_urdf
from lipcore.robots.urdf import RigidBody
from lipcore.robots.urdf_units import SYSTEMS, UNITS, scaled
from lipserve import ApiError, Client
from service.foundation.errors import InvalidRequestError
from service.models import registry
from service.robots import store
from service.storage.database import RobotRow
from tests.fuzz.seeds import SDF
from tests.service.cli.conftest import lipserve  # noqa: F401 - a fixture
from tests.service.data import QUICK, columns, error, post, queue, service_of, stream, train, upload
from tests.service.data import csv as csv_file

LINK = '<link name="{}"><inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>'
LINK += "</inertial></link>"
JOINT = '<joint name="{}" type="{}"><parent link="{}"/><child link="{}"/><axis xyz="0 1 0"/>'
JOINT += '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'


def urdf(name="arm", kind="continuous", joints=("joint1", "joint2")):
    parts = [LINK.format(f"l{i}") for i in range(len(joints) + 1)]
    parts += [JOINT.format(joint, kind, f"l{i}", f"l{i + 1}") for i, joint in enumerate(joints)]
    return f'<robot name="{name}">{"".join(parts)}</robot>'.encode()


def post_robot(api, body, media_type="application/xml", **params):
    return api.post("/v1/robots", content=body, headers={"content-type": media_type}, params=params)


def add_robot(api, body, media_type="application/xml", **params):
    answer = post_robot(api, body, media_type, **params)
    assert answer.status_code == 201, answer.text
    return answer.json()


@pytest.fixture(scope="module")
def panda(api):
    """A short recording of a Panda with friction."""
    return upload(api, stream("panda", 60, viscous=0.4), name="panda")


@pytest.fixture
def empty(strict):
    """The service with small limits and without robots."""
    yield strict
    while left := strict.get("/v1/robots").json()["items"]:
        for robot in left:
            assert strict.delete(f"/v1/robots/{robot['id']}").status_code == 204


@pytest.mark.parametrize("form", [True, False])
def test_uploaded_robot_is_shown_with_its_joints(api, form):
    body = urdf()
    file = ("arm.urdf", body)
    answer = api.post("/v1/robots", files={"file": file}) if form else post_robot(api, body, "text/xml; charset=utf-8")
    assert answer.status_code == 201, answer.text
    robot = answer.json()
    assert robot["id"].startswith("urdf_")
    assert (robot["name"], robot["sha256"]) == ("arm", hashlib.sha256(body).hexdigest())
    assert robot["joints"] == [{"name": f"joint{i}", "type": "revolute"} for i in (1, 2)]
    assert answer.headers["location"] == f"/v1/robots/{robot['id']}"
    assert api.get(answer.headers["location"]).json() == robot


def test_robots_are_paged_and_deleted(empty):
    robots = [add_robot(empty, urdf(), name=f"arm {i}") for i in range(4)]
    first = empty.get("/v1/robots").json()
    assert first["items"] == robots[:0:-1]
    second = empty.get("/v1/robots", params={"cursor": first["next_cursor"]}).json()
    assert second == {"items": robots[:1], "next_cursor": None}
    path = f"/v1/robots/{robots[0]['id']}"
    assert empty.delete(path).status_code == 204
    assert "urdf_" in error(empty.get(path), 404, "not_found")["message"]
    error(empty.delete(path), 404, "not_found")


def test_profiles_are_listed(api):
    answer = api.get("/v1/robots/profiles").json()
    assert answer["next_cursor"] is None
    result = {profile["name"]: profile for profile in answer["items"]}
    assert set(ROBOTS) | {"fr3", "ur5e", "xarm6"} <= set(result)
    assert {name for name, profile in result.items() if profile["urdf_available"]} == set(ROBOTS)
    assert result["panda"]["urdf_note"] is None
    assert "has no URDF" in result["fr3"]["urdf_note"]
    for name, profile in result.items():
        assert api.get(f"/v1/robots/profiles/{name}").json() == profile


def test_profile_of_an_uploaded_urdf(empty):
    robot = add_robot(empty, urdf(kind="revolute"), name="mine")
    profile = empty.get(f"/v1/robots/profiles/{robot['id']}").json()
    assert (profile["name"], profile["effort"], profile["urdf_available"]) == ("mine", "unknown", True)
    assert [(joint["name"], joint["max_torque"]) for joint in profile["joints"]] == [("joint1", 1.0), ("joint2", 1.0)]
    assert "r2d2" in error(empty.get("/v1/robots/profiles/r2d2"), 404, "not_found")["message"]
    database = service_of(empty).database
    assert store.profile_of(database, robot["id"]).urdf == urdf(kind="revolute").decode()
    assert store.profile_of(database, "fr3").title == "Franka Research 3"
    with pytest.raises(InvalidRequestError, match=r"robot is r2d2, expected one of panda, fr3.*uploaded URDF"):
        store.profile_of(database, "r2d2")


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (b"", "not well-formed XML"),
        (urdf().decode().encode("utf-16"), "not text in UTF-8"),
        (b'<!DOCTYPE r [<!ENTITY a "aa"><!ENTITY b "&a;&a;">]>' + urdf("&amp;b;"), "document type or an entity"),
        (b'<!DOCTYPE r SYSTEM "file:///etc/passwd">' + urdf(), "document type or an entity"),
        (urdf(kind="floating"), "joint 'joint1' is of type 'floating': expected a fixed base"),
        (urdf(joints=()), "no joint that moves"),
        (urdf().replace(b"0 1 0", b"0 0 0"), "<axis xyz> of joint 'joint1' is '0 0 0'"),
        (urdf().replace(b"0 1 0", b"1e300 0 0"), "<axis xyz> of joint 'joint1' is '1e300 0 0'"),
        (urdf().replace(b'ixx="1"', b'ixx="inf"'), "<inertia ixx> of link 'l0' is 'inf'"),
        (urdf().replace(b'child link="l1"', b'child link="l0"'), "expected a tree"),
    ],
)
def test_unusable_urdf_is_rejected(empty, body, message):
    reply = error(post_robot(empty, body), 422, "invalid_data")
    assert message in reply["message"]
    assert reply["detail"][0]["field"] == "urdf"
    assert empty.get("/v1/robots").json()["items"] == []


def test_unusable_stored_robot_is_reported(empty):
    text = urdf(joints=("joint1",))
    robot = add_robot(empty, text)["id"]
    with service_of(empty).database.transaction() as session:
        bad = text.replace(b"0 1 0", b"0 0 0").decode()
        session.execute(update(RobotRow).where(RobotRow.id == robot).values(urdf=bad))
    table = {name: values for name, values in columns(stream()).items() if not name.endswith("2")}
    answer = post(empty, csv_file(table), "text/csv", robot=robot)
    message = error(answer, 422, "invalid_data")["message"]
    assert f"robot {robot} can no longer be used: <axis xyz> of joint 'joint1' is '0 0 0'" in message


def test_job_with_an_unsuitable_robot_is_rejected(api, pendulum):
    before = api.get("/v1/jobs").json()
    other = add_robot(api, urdf(joints=("shoulder", "elbow")))["id"]
    sliding = add_robot(api, urdf(kind="prismatic"))["id"]
    base = {"model": "refused", "datasets": [pendulum["id"]], "estimator": "rigid-body", "options": QUICK}
    fixed = {"options": {**QUICK, "geometry": "fixed"}}
    for request, field, *messages in (
        (fixed, "robot", "geometry is 'fixed', which needs a robot: a profile such as panda, or a URDF"),
        ({"robot": "panda"}, "robot", *ROBOTS["panda"].free, "joint1, joint2"),
        ({"robot": other}, "robot", "shoulder, elbow; the data have joint1, joint2"),
        ({"robot": sliding}, "robot", "joint 'joint1' is revolute in the data", "is prismatic"),
        ({"robot": "r2d2"}, "robot", "robot is 'r2d2', expected one of panda, ur3", "uploaded URDF"),
        ({"robot": "fr3"}, "robot", "the profile of Franka Research 3 has no URDF", "upload a URDF"),
        (
            {"robot": "double-pendulum", "estimator": "lip-chain"},
            "robot",
            "'lip-chain' does not use a robot, only rigid-body",
        ),
        ({"options": {"prior": "flat"}}, "options.prior"),
    ):
        reply = error(api.post("/v1/jobs", json=base | request), 422, "invalid_request")
        assert reply["detail"][0]["field"] == field
        assert all(message in reply["message"] for message in messages), reply["message"]
    assert api.get("/v1/jobs").json() == before


def test_robot_in_use_is_kept(no_worker, empty):
    dataset, robot = upload(empty, stream())["id"], add_robot(empty, urdf())["id"]
    few = {**QUICK, "posterior_samples": 40}
    job = queue(empty, "waits", dataset, estimator="rigid-body", robot=robot, options=few)
    assert job["robot"] == robot
    assert job["id"] in error(empty.delete(f"/v1/robots/{robot}"), 409, "conflict")["message"]
    assert empty.post(f"/v1/jobs/{job['id']}/cancel").status_code == 200
    assert empty.delete(f"/v1/robots/{robot}").status_code == 204


@pytest.mark.slow
def test_profile_trains_and_predicts(api, panda):
    """The Panda's own URDF predicts the Panda; its joints are found although the data number them."""
    body = csv_file(columns(stream("panda", 60, viscous=0.4)))
    numbered = post(api, body, "text/csv").json()
    assert numbered["joint_names"] == [f"joint{i}" for i in range(1, 8)]
    for dataset, matched in ((panda, "name"), (numbered, "order")):
        job = train(api, f"rigid-{matched}", dataset["id"], estimator="rigid-body", robot="panda")
        assert (job["robot"], job["estimator"]) == ("panda", "rigid-body")
        version = api.get(f"/v1/models/rigid-{matched}/versions/1").json()
        robot = version["robot"]
        assert (robot["name"], robot["matched"], robot["prior"]) == ("panda", matched, "urdf")
        assert robot["joints"] == list(ROBOTS["panda"].free)
        assert robot["sha256"] == hashlib.sha256(profile_urdf("panda").encode()).hexdigest()
        assert (np.abs(np.array(version["parameters"]["friction"]["viscous"]["mean"]) - 0.4) < 0.2).all()
        bodies = version["parameters"]["inertia"]["bodies"]
        assert [entry["joint"] for entry in bodies] == dataset["joint_names"]
        assert all(entry["plausible"]["mass"] > 0 for entry in bodies)

    unseen = stream("panda", 20, seed=2, noise=0.0)
    query = {name: getattr(unseen, name).tolist() for name in ("q", "dq", "ddq")}
    answer = api.post("/v1/models/rigid-name/predict", json=query).json()
    error_left = np.array(answer["tau"]) - (unseen.tau + 0.4 * unseen.dq)
    assert (np.sqrt(np.mean(error_left**2, axis=0))[:4] < 0.01 * unseen.tau.std(axis=0)[:4]).all()


def test_uploaded_urdf_trains_like_its_profile(api, pendulum):
    robot = add_robot(api, profile_urdf("double-pendulum").encode(), name="my pendulum")
    assert [joint["name"] for joint in robot["joints"]] == list(load_robot("double-pendulum").joint_names)
    query, answers = {"q": [0.3, -0.2], "dq": [0.1, 0.4], "ddq": [1.0, -0.5]}, []
    for model, name in (("by-upload", robot["id"]), ("by-profile", "double-pendulum")):
        train(api, model, pendulum["id"], estimator="rigid-body+lip-chain", robot=name)
        answers.append(api.post(f"/v1/models/{model}/predict", json=query).json()["tau"])
    assert np.allclose(*answers)
    assert api.get("/v1/models/by-upload/versions/1").json()["robot"]["name"] == "my pendulum"
    assert api.delete(f"/v1/robots/{robot['id']}").status_code == 204
    service = service_of(api)
    kept = lipcore.load(service.files.version_folder(registry.find(service.database, "by-upload", 1).folder))
    assert kept.predict(**query).tau[0].tolist() == answers[0]


@pytest.mark.slow
def test_command_line_and_client_manage_robots(server, lipserve, tmp_path):  # noqa: F811 - the fixture
    recording, arm, text = tmp_path / "stream.npz", tmp_path / "arm.urdf", tmp_path / "text.urdf"
    lipserve("simulate", "double-pendulum", recording, "--samples", 60, "--fast")
    arm.write_text(profile_urdf("double-pendulum"))
    text.write_text("no XML")
    common = ("train", recording, "--url", server.url, "--model", "by-cli", "--estimator", "rigid-body")
    for options, expected, message in (
        (("--robot", arm), 0, ""),
        (("--robot", tmp_path / "missing.urdf"), 1, "missing.urdf"),
        (("--base", "panda-sim"), 1, "--base is panda-sim:1, expected a version with the joint_names of the data"),
    ):
        code, _, wrong = lipserve(*common, *options)
        assert (code, message in wrong) == (expected, True), wrong
    with Client(server.url) as client:
        assert client.version("by-cli", 1).robot["name"] == "2dof_planar"
        with pytest.raises(ApiError, match="not well-formed"):
            client.upload_robot(text)


@pytest.mark.parametrize("names", [("ns/joint1", "ns/joint2"), ("arm_joint1", "arm_joint2")])
def test_joints_are_matched_despite_a_prefix(api, names):
    robot = add_robot(api, urdf(joints=names))["id"]
    body = store.resolve(service_of(api).storage.database, robot, ("joint1", "joint2"), ("revolute", "revolute"))
    assert (body.joint_names, body.urdf_joints, body.matched) == (("joint1", "joint2"), names, "name")


@pytest.mark.parametrize("system", [each for each in SYSTEMS if "lb" not in each])
@pytest.mark.parametrize("arm", ["panda", "kinova", "ur10"])
def test_units_of_a_urdf_are_named_and_scaled(api, arm, system):
    factors = {name: UNITS[unit] for name, unit in zip(("length", "mass", "inertia"), system, strict=True)}
    exported = scaled(profile_urdf(arm), {name: 1 / factor for name, factor in factors.items()})
    reply = error(post_robot(api, exported.encode()), 422, "invalid_data")
    scale = reply["message"].partition("set scale=")[2]
    assert scale == ",".join(f"{name}={factor:g}" for name, factor in factors.items() if factor != 1)
    made = add_robot(api, exported.encode(), scale=scale)
    names, types = load_robot(arm).joint_names, load_robot(arm).joint_types
    found = store.resolve(service_of(api).storage.database, made["id"], names, types)
    expected = RigidBody.from_urdf(profile_urdf(arm), names, types)
    np.testing.assert_allclose(found.parameters(), expected.parameters(), rtol=1e-9, atol=1e-12)
    assert found.length() == pytest.approx(expected.length())


@pytest.mark.parametrize("scale", ["length", "length=x", "width=0.1", "mass=0", "mass=nan"])
def test_wrong_scale_is_rejected(api, scale):
    assert post_robot(api, urdf(), scale=scale).status_code == 422


def test_xacro_and_a_zip_of_its_folder_are_expanded(api):
    plain = urdf().decode()
    inside, end = (
        plain.split(">", 1)[1].rpartition("</robot>")[0],
        '<xacro:property name="p" value="${2 * pi}"/></robot>',
    )
    start = '<robot name="arm" xmlns:xacro="http://www.ros.org/wiki/xacro">'
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        archive.writestr("arm/arm.urdf.xacro", f'{start}<xacro:include filename="parts.xacro"/>{end}')
        archive.writestr("arm/parts.xacro", f"{start}{inside}</robot>")
    joints = add_robot(api, plain.encode())["joints"]
    assert add_robot(api, f"{start}{inside}{end}".encode())["joints"] == joints
    assert add_robot(api, out.getvalue(), media_type="application/zip")["joints"] == joints
    assert add_robot(api, SDF.encode())["joints"] == [{"name": "j", "type": "revolute"}]
    wrong = f"{start}{inside}<link name=\"${{open('/etc/passwd').read()}}\"/></robot>"
    message = error(post_robot(api, wrong.encode()), 422, "invalid_data")["message"]
    assert "xacro cannot expand robot.xacro" in message
    assert "xacro robot.urdf.xacro > robot.urdf" in message
