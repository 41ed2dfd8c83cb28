"""Every trained version can be verified, exported and imported: any scale of torque, number of joints, or unit."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import lipcore
from lipcore import Samples
from lipcore.data.outliers import CorruptRowsError
from lipcore.files import persistence
from lipcore.files.probing import probe
from lipcore.vocabulary import JOINT_TYPES, ROBOT_ESTIMATORS
from service.cli.verify import verify_home
from service.foundation.settings import Settings
from service.models import archive_import
from tests.service.data import service_of, train, upload
from tests.service.models.archives.packing import exported, imported

QUICK = lipcore.FitOptions(
    hyperparameter_samples=20, posterior_samples=40, max_iterations=4, starts=1, search_seconds=1.0
)
ROWS = 60
LARGE = 0.9e6
"""Torque in N·m near the maximum of undamaged data: its square is far above any torque."""


def recording(seed, joint_types, position, torque, uneven, slow=1.0, aside=0.0):
    """Return sines of every joint.

    position: amplitude, rad or m; torque: maximum, N·m; uneven: ratio of the last joint's torque to the first's; slow:
    factor of the period; aside: centre of the motion in amplitudes.
    """
    rng, n = np.random.default_rng(seed), len(joint_types)
    t = np.arange(ROWS) * 0.05
    rate, phase = rng.uniform(0.3, 2.0, n) / slow, rng.uniform(0.0, 6.0, n)
    wave = t[:, None] * rate + phase
    q = position * (np.sin(wave) + aside)
    dq, ddq = position * rate * np.cos(wave), -position * rate**2 * np.sin(wave)
    tau = np.cos(q) - np.sin(wave) * (1.0 + 0.3 * np.arange(n)) + 0.2 * np.sign(dq)
    tau += 0.01 * rng.standard_normal(tau.shape)
    tau *= torque / np.abs(tau).max() * np.geomspace(1.0, uneven, n)
    names = tuple(f"joint{number}" for number in range(n))
    return Samples(t=t, q=q, dq=dq, ddq=ddq, tau=tau, episode=np.zeros(ROWS, np.int64), joint_names=names)


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(50, 51),
    joint_types=st.lists(st.sampled_from(JOINT_TYPES), min_size=1, max_size=6),
    estimator=st.sampled_from(["lip-chain", "lip", *ROBOT_ESTIMATORS, "se", "gip", "lse"]),
    torque=st.floats(-9.0, 12.0).map(lambda power: 10.0**power) | st.just(LARGE),
    position=st.floats(-6.0, 4.0).map(lambda power: 10.0**power) | st.just(1.0),
    uneven=st.sampled_from([1.0, 1.0, 1e-3, 1e-6]),
    slow=st.sampled_from([1.0, 1.0, 0.1, 100.0]),
    aside=st.sampled_from([0.0, 0.0, 10.0]),
)
@example(51, ["prismatic"] * 2 + ["revolute"], "rigid-body+lip-chain", LARGE, 1.0, 1e-3, 100.0, 0.0)
@example(50, ["revolute", "prismatic", "prismatic"], "lip", LARGE, 1.0, 1e-6, 0.1, 0.0)
@example(50, ["prismatic"], "gip", LARGE, 1e4, 1.0, 1.0, 0.0)
@example(50, ["revolute"] * 2, "lse", LARGE, 100.0, 1e-3, 100.0, 0.0)
def test_every_trained_version_is_exported_and_imported(
    seed, joint_types, estimator, torque, position, uneven, slow, aside
):
    samples = recording(seed, joint_types, position, torque, uneven, slow, aside)
    try:
        model = lipcore.train(samples, joint_types, estimator, QUICK)
    except CorruptRowsError:  # no robot has such torques
        assert max(torque, position * 2.0 / slow) > 1e4
        return
    manifest, files = persistence.encode(model, {})
    probe(persistence.decode(files))
    taken = archive_import._checked(files, Settings())
    assert {name: taken[name] for name in ("fit", "compact", "noise_std")} == {
        name: manifest[name] for name in ("fit", "compact", "noise_std")
    }


def test_version_of_large_torques_is_healthy_in_the_service(api):
    samples = recording(51, ["prismatic", "prismatic", "revolute"], 1.0, LARGE, 1e-3, slow=100.0)
    train(api, "giant", upload(api, samples)["id"], joint_types=["prismatic", "prismatic", "revolute"])
    imported(api, exported(api, "giant"), name="giant-again")
    found = verify_home(service_of(api).storage.settings)
    assert [each for each in found.damages if each.kind == "version" and "giant" in each.name] == []
