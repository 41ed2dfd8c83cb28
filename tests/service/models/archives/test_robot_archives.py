"""Archives of models with rigid bodies, whose URDF may be hostile."""

import hashlib
import json

import numpy as np
import pytest

import lipcore
from lipcore.files import persistence
from lipcore.robots.urdf import RigidBody
from tests.service.data import QUICK, arrays, stream
from tests.service.models.archives.packing import (
    MANIFEST,
    assert_rejected,
    exported,
    imported,
    pack,
    unpack,
    with_checksums,
    with_json,
)
from tests.service.models.versions import predict_json

ROBOT = "robot.urdf"
TYPES = ["revolute", "revolute"]


@pytest.fixture(scope="module")
def model():
    samples = stream()
    robot = RigidBody.from_profile("double-pendulum", samples.joint_names, TYPES)
    return lipcore.train(samples, TYPES, "rigid-body", lipcore.FitOptions(**QUICK), robot=robot)


@pytest.fixture(scope="module")
def files(archive, model):
    about = unpack(archive)["export.json"]
    return with_checksums({"export.json": about, **persistence.encode(model, {"made": "by a test"})[1]})


def with_urdf(files, urdf):
    """Return the members with another URDF, and checksums and manifest that match."""
    entry = {"bytes": len(urdf), "sha256": hashlib.sha256(urdf).hexdigest()}
    return with_json({**files, ROBOT: urdf}, MANIFEST, lambda manifest: manifest["robot"].update(entry))


def test_model_with_its_robot_is_exported_and_imported(api, files, model):
    imported(api, pack(files), name="with-robot")
    out = unpack(exported(api, "with-robot", version=1))
    assert out[ROBOT] == files[ROBOT]
    motion = arrays(stream(seed=12, samples=10), "q", "dq", "ddq")
    answer = predict_json(api, "with-robot", **motion, version=1)
    assert np.array_equal(answer["tau"], model.predict(**motion).tau)


def test_parameters_are_recomputed(api, files):
    def first_body(manifest):
        return manifest["parameters"]["inertia"]["bodies"][0]["mean"]

    forged = with_json(files, MANIFEST, lambda manifest: first_body(manifest).update(mass=1000.0))
    version = imported(api, pack(forged), name="lied")
    assert first_body(version)["mass"] == pytest.approx(first_body(json.loads(files[MANIFEST]))["mass"], rel=1e-6)


BOMB = b'<?xml version="1.0"?><!DOCTYPE r [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><robot name="r">&b;</robot>'
URDFS = {
    "entities": (BOMB, "document type"),
    "external entity": (b'<!DOCTYPE r SYSTEM "file:///etc/passwd"><robot name="r"/>', "document type"),
    "not XML": (b"{}", "not well-formed"),
    "not UTF-8": (b"\xff\xfe<robot/>", ""),
    "another robot": (b'<robot name="r"><link name="a"/></robot>', "movable joints none"),
    "deep": (b"<robot>" + b"<a>" * 1000 + b"</a>" * 1000 + b"</robot>", "deep"),
}


@pytest.mark.parametrize(("urdf", "reply"), URDFS.values(), ids=URDFS)
def test_wrong_urdf(api, files, urdf, reply):
    assert_rejected(api, pack(with_urdf(files, urdf)), ROBOT, reply)


@pytest.mark.parametrize(
    ("change", "reply"),
    [
        ({"file": "/etc/passwd"}, "robot.file"),
        ({"joints": ["no", "such"]}, "robot"),
        ({"joints": [1, 2]}, "robot.joints[0]"),
        ({"matched": "magic"}, "robot.matched"),
        ({"prior": "none"}, "robot.prior"),
        ({"mesh": "file:///etc/passwd"}, "mesh"),
    ],
    ids=str,
)
def test_wrong_entry_of_the_robot(api, files, change, reply):
    packed = pack(with_json(files, MANIFEST, lambda manifest: manifest["robot"].update(change)))
    assert_rejected(api, packed, ROBOT if "such" in str(change) else MANIFEST, reply)


def test_missing_robot(api, files):
    rest = {name: content for name, content in files.items() if name != ROBOT}
    assert_rejected(api, pack(with_checksums(rest)), ROBOT, "missing")
