"""Held poses, motion of one joint, and short recordings are named as what they are, and held poses are read as such."""

import numpy as np
import pytest

from service.datasets import store
from tests.service.data import csv, error, post, service_of

RNG = np.random.default_rng(4)
POSES = RNG.uniform(-2.0, 2.0, (60, 2))
TORQUES = np.column_stack([30 * np.cos(POSES[:, 0]) + 9 * np.cos(POSES.sum(1)), 9 * np.cos(POSES.sum(1))])
TORQUES += RNG.normal(0.0, 0.01, TORQUES.shape)


def table(q, tau, t=None):
    columns = {} if t is None else {"t": t}
    columns |= {f"q{j + 1}": q[:, j] for j in range(2)} | {f"tau{j + 1}": tau[:, j] for j in range(2)}
    return csv({name: [repr(float(each)) for each in values] for name, values in columns.items()})


def samples(api, dataset):
    service = service_of(api)
    return store.samples(service.files, store.find(service.database, dataset["id"]))


@pytest.mark.parametrize("every", [None, 4.0], ids=["without times", "every 4 s"])
def test_refusal_names_the_option_for_poses_and_it_helps(api, every):
    body = table(POSES, TORQUES, None if every is None else every * np.arange(60))
    message = error(post(api, body, "text/csv"), 422, "invalid_data")["message"]
    assert "poses=true if every row is a held pose" in message
    dataset = post(api, body, "text/csv", poses="true").json()
    found, report = samples(api, dataset), dataset["report"]
    np.testing.assert_allclose(found.q, POSES)
    np.testing.assert_allclose(found.tau, TORQUES)
    assert not found.dq.any()
    assert not found.ddq.any()
    assert report["episodes"] == 60
    assert any("held poses. They show gravity and stiction" in each for each in report["warnings"])
    assert {each[kind]["verdict"] for each in report["excitation"]["joints"] for kind in ("viscous", "coulomb")} == {
        "not determined"
    }
    assert not any("direction" in each or "regular" in each for each in report["advice"])


def test_rows_of_the_same_pose_are_averaged(api):
    noise = RNG.normal(0.0, 1e-4, (600, 2))
    q, tau = np.repeat(POSES, 10, axis=0) + noise, np.repeat(TORQUES, 10, axis=0) + 1000 * noise
    dataset = post(api, table(q, tau, np.arange(600) / 20), "text/csv", poses="true").json()
    assert "600 rows are 60 held poses: velocity and acceleration are zero" in dataset["report"]["reading"]
    np.testing.assert_allclose(samples(api, dataset).tau, tau.reshape(60, 10, 2).mean(1))


def moving(t, both=True):
    q = np.column_stack(
        [
            np.sin(t) + 0.3 * np.sin(7**0.5 * t),
            0.8 * np.sin(3**0.5 * t + 1) * both + 0.2 + 1e-4 * RNG.normal(size=len(t)),
        ]
    )
    return table(q, np.column_stack([30 * np.cos(q[:, 0]), 9 * np.cos(q.sum(1))]), t)


def test_motion_of_one_joint_short_and_repeated_motion_are_named(api):
    of = {
        "one": post(api, moving(np.arange(1500) / 50, both=False), "text/csv").json()["report"],
        "short": post(api, moving(np.arange(200) / 50), "text/csv").json()["report"],
        "long": post(api, moving(np.arange(4000) / 50), "text/csv").json()["report"],
    }
    t = np.arange(3000) / 50
    assert any("Only joint1 moves." in each for each in of["one"]["warnings"])
    assert any("The recording lasts 3.98 s." in each for each in of["short"]["warnings"])
    assert not of["long"]["warnings"]
    q = np.column_stack([np.sin(t), 0.8 * np.sin(2 * t + 1)])
    again = post(api, table(q, np.column_stack([30 * np.cos(q[:, 0]), 9 * np.cos(q.sum(1))]), t), "text/csv").json()
    assert again["report"]["excitation"]["period_s"] == pytest.approx(2 * np.pi, rel=0.02)
    assert any("The motion repeats every 6.28 s." in each for each in again["report"]["advice"])
    assert of["long"]["excitation"]["period_s"] is None
