"""Tests that ahead-of-time compilation covers a first training, also with a read-only disk."""

import gc
import os
import shutil
import stat
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numba import config
from numba.core.dispatcher import Dispatcher

from lipcore import FitOptions, train
from lipcore.data.motion import Motion
from lipcore.data.samples import Samples
from lipcore.kernels.arm import ArmKernel
from lipcore.kernels.arm_prior import Alternative
from lipcore.kernels.drive.terms import drive_terms
from lipcore.kernels.fast import compile as compiling
from lipcore.kernels.fast.compile import source_stamp, use_cache
from lipcore.model.functionals import kinetic_energy
from lipcore.warm_up import COMPILED_ESTIMATORS, warm_up
from tests.choosing import few


def compiled_signatures() -> set[tuple[str, str]]:
    """Return every compiled function of ours with its signatures."""
    gc.unfreeze()  # a service in this process may have frozen its imports
    # `isinstance` would trigger lazy imports
    dispatchers = [each for each in gc.get_objects() if issubclass(type(each), Dispatcher)]
    ours = [each for each in dispatchers if each.py_func.__module__.startswith("lipcore.")]
    return {(each.py_func.__qualname__, str(one)) for each in ours for one in each.signatures}


@pytest.mark.slow
@pytest.mark.parametrize("name", few(COMPILED_ESTIMATORS, lambda name: "+" in name))
def test_first_training_compiles_nothing_more(name: str) -> None:
    """Use a robot with other joints and another number of them."""
    warm_up(name)
    compiled = compiled_signatures()
    assert compiled
    rng = np.random.default_rng(0)
    q, dq, ddq, noise = rng.uniform(-1, 1, (4, 90, 3))
    tau = 2 * np.sin(q) + ddq + 0.01 * noise
    samples = Samples(("a", "b", "c"), np.arange(90) / 10, np.zeros(90, np.int64), q, dq, ddq, tau)
    options = FitOptions(hyperparameter_samples=30, posterior_samples=60, max_iterations=4, search_seconds=0.1)
    model = train(samples, ("revolute", "prismatic", "revolute"), name, options)
    model.predict(q, dq, ddq, covariance=True)
    model.evaluator.one(np.ascontiguousarray(np.stack([q[0], dq[0], ddq[0]])))
    energies = [term for kind, term in model.estimator.terms.items() if kind not in ("friction", "local")]
    kinetic_energy(model.posterior, energies, Motion.from_arrays(q[:2], dq[:2], ddq[:2]))
    if model.arm is not None:
        friction = np.zeros((3, len(drive_terms(model.arm.drive))))
        other = Alternative(model.arm.geometry, model.arm.parameters, np.zeros(3), friction, 0.5)
        ArmKernel(replace(model.arm, alternatives=(other, other))).features(Motion.from_arrays(q, dq, ddq))
    assert compiled_signatures() <= compiled


def test_unknown_names_are_rejected() -> None:
    with pytest.raises(ValueError, match="Compiled are lip, lip-chain, rigid-body"):
        warm_up("lip", "gpu")


@pytest.fixture
def numba_cache(tmp_path, monkeypatch):
    """Return a cache that Numba uses, next to a folder for temporary files."""
    cache = tmp_path / "cache"
    (cache / "kernels").mkdir(parents=True)
    (cache / "kernels" / "chain.nbi").write_bytes(b"index")
    (cache / "kernels").chmod(0o555)
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    monkeypatch.setattr(config, "CACHE_DIR", str(cache))
    monkeypatch.setattr("atexit.register", lambda *_, **__: None)
    return cache


def deny_writing(path, mode):
    """Act like a read-only file system; permissions alone do not stop root."""
    return mode != os.W_OK


def test_read_only_cache_is_copied(numba_cache, monkeypatch):
    monkeypatch.setattr(os, "access", deny_writing)
    environment = {"NUMBA_CACHE_DIR": str(numba_cache)}
    folder = use_cache(environment)
    assert folder is not None
    assert environment["NUMBA_CACHE_DIR"] == config.CACHE_DIR == str(folder)
    assert (folder / "kernels" / "chain.nbi").read_bytes() == b"index"
    for made in (folder, folder / "kernels"):
        assert stat.S_IMODE(made.stat().st_mode) == 0o700, "nobody else may put machine code there"


def test_writable_cache_is_used(numba_cache):
    environment = {"NUMBA_CACHE_DIR": str(numba_cache)}
    assert use_cache(environment) is None
    assert environment["NUMBA_CACHE_DIR"] == config.CACHE_DIR == str(numba_cache)


@pytest.mark.parametrize("environment", [{}, {"NUMBA_CACHE_DIR": ""}, {"NUMBA_CACHE_DIR": str(Path("/nothing/here"))}])
def test_without_a_cache_nothing_is_done(environment):
    before = dict(environment)
    assert use_cache(environment) is None
    assert environment == before


def test_edited_file_recompiles_only_its_importers(tmp_path, monkeypatch):
    folder = tmp_path / "compiled"
    shutil.copytree(compiling.FOLDER, folder, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(compiling, "FOLDER", folder)
    before = {path: source_stamp(path) for path in folder.glob("*.py")}
    with (folder / "chain_sums.py").open("a") as file:
        file.write("# edited\n")
    source_stamp.cache_clear()
    changed = {path.stem for path, stamp in before.items() if source_stamp(path) != stamp}
    assert changed == {"chain_sums", "chain_kinetic", "chain"}
