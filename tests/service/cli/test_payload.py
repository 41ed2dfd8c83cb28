"""`lipserve payload`: show, declare and remove payloads."""

import pytest

from tests.service.cli.conftest import lacking
from tests.service.learning.payloads import payload_batches
from tests.service.models.versions import publish_arm_at


@pytest.fixture(scope="module")
def carrier(server):
    """Name of a model of an arm in the shared service."""
    publish_arm_at(server.home, "cli-carrier")
    return "cli-carrier"


def test_payload_is_declared_shown_and_removed(server, run_command, carrier):
    payload = ("payload", carrier)
    assert f"no payload estimates of {carrier} yet" in run_command(*payload)
    for stream_id in ("cell-1", "cell-2"):
        (first, *_) = payload_batches(stream_id, 0.0)
        assert server.client.post(f"/v1/models/{carrier}/observations", json=first).status_code == 200
    text = run_command(*payload, "--mass", 1.5, "--com", "0,0.02,0.12", "--stream", "cell-1")
    parts = (
        "stream cell-1: payload 1.50 ± 0.03 kg, declared",
        "0.000 ± 0.005, 0.020 ± 0.005, 0.120 ± 0.005 m",
        "in the frame of the link after joint panda_joint7, as estimated",
        "kilograms are only as accurate as lengths",
    )
    assert lacking(text, *parts) == []
    run_command(*payload, "--mass", 12, "--com", "0,0,0.1", "--stream", "cell-2")
    rows = [line for line in run_command(*payload).splitlines() if "cell-" in line]
    assert [("1.50 ± 0.03 kg" in row, "12.00 ± 0.24 kg" in row) for row in rows] == [(True, False), (False, True)]
    shown = run_command(*payload, "--stream", "cell-2", "--json")
    assert [each["stream_id"] for each in shown["streams"]] == ["cell-2"]
    assert "stream cell-2: payload none" in run_command(*payload, "--remove", "--stream", "cell-2")
    assert run_command(*payload, "--json")["streams"][0]["payload"]["mass"]["mean"] == pytest.approx(1.5)
    text = run_command(*payload, "--mass", 2, "--com", "0,0,0.1", "--inertia", "0.01,0,0,0.01,0,0.01")
    assert f"declared for all streams of {carrier}: 2.00 ± 0.04 kg" in text
    assert "payload 2.00" in run_command(*payload, "--stream", "cell-2")
    run_command(*payload, "--remove")
    gone = run_command(*payload, "--json")
    assert (gone["default"], [each["payload"] for each in gone["streams"]]) == (None, [None, None])


AT_ORIGIN = ("--mass", 1, "--com", "0,0,0")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--mass", 1), "--mass and --com must be given together"),
        (("--remove", "--mass", 1), "give either --remove or --mass, not both"),
        ((*AT_ORIGIN, "--inertia", "1,2"), "--inertia must be six numbers, ixx,ixy,ixz,iyy,iyz,izz; got 2"),
        ((*AT_ORIGIN, "--inertia", "9,0,0,1,0,1"), "No body has this mass and inertia"),
        (("--mass", -1, "--com", "0,0,0"), "mass"),
    ],
)
def test_invalid_payloads_are_rejected(run_rejected_command, carrier, options, message):
    assert message in run_rejected_command("payload", carrier, *options)


def test_model_without_arm_explains_missing_payload_estimate(run_command, run_rejected_command, arm):
    name, _ = arm
    assert f"payloads of {name} are not estimated: estimator se has no arm" in run_command("payload", name)
    assert "train with rigid-body" in run_rejected_command("payload", name, "--mass", 1, "--com", "0,0,0")
