"""Machine code on disk, where the disk cannot be written."""

from __future__ import annotations

import os
import shutil
import stat
from pathlib import Path

import pytest
from numba import config

from lipcore.kernels.compiled import compile as compiling
from lipcore.kernels.compiled.compile import source_stamp, use_cache


@pytest.fixture
def given(tmp_path, monkeypatch):
    """A cache, which Numba is told of, and a folder for temporary files."""
    cache = tmp_path / "cache"
    (cache / "kernels").mkdir(parents=True)
    (cache / "kernels" / "chain.nbi").write_bytes(b"index")
    (cache / "kernels").chmod(0o555)
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    monkeypatch.setattr(config, "CACHE_DIR", str(cache))
    monkeypatch.setattr("atexit.register", lambda *_, **__: None)
    return cache


def read_only(path, mode):
    """What the system says of a file system that is read-only; permissions alone do not stop root."""
    return mode != os.W_OK


def test_a_cache_that_cannot_be_written_is_copied_for_this_process_and_its_children(given, monkeypatch):
    monkeypatch.setattr(os, "access", read_only)
    environment = {"NUMBA_CACHE_DIR": str(given)}
    folder = use_cache(environment)
    assert folder is not None
    assert environment["NUMBA_CACHE_DIR"] == config.CACHE_DIR == str(folder)
    assert (folder / "kernels" / "chain.nbi").read_bytes() == b"index"
    for made in (folder, folder / "kernels"):
        assert stat.S_IMODE(made.stat().st_mode) == 0o700, "nobody else may put machine code there"


def test_one_that_can_be_written_is_used_as_it_is(given):
    environment = {"NUMBA_CACHE_DIR": str(given)}
    assert use_cache(environment) is None
    assert environment["NUMBA_CACHE_DIR"] == config.CACHE_DIR == str(given)


def test_without_a_folder_for_temporary_files_nothing_is_copied(given, monkeypatch):
    monkeypatch.setattr(os, "access", read_only)
    monkeypatch.setattr("tempfile.tempdir", str(given / "nothing here"))
    assert use_cache({"NUMBA_CACHE_DIR": str(given)}) is None
    assert str(given) == config.CACHE_DIR


@pytest.mark.parametrize("environment", [{}, {"NUMBA_CACHE_DIR": ""}, {"NUMBA_CACHE_DIR": str(Path("/nothing/here"))}])
def test_without_a_cache_there_is_nothing_to_do(environment):
    before = dict(environment)
    assert use_cache(environment) is None
    assert environment == before


def test_an_edited_file_is_compiled_anew_with_those_that_import_it_and_no_others(tmp_path, monkeypatch):
    folder = tmp_path / "compiled"
    shutil.copytree(compiling.FOLDER, folder, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(compiling, "FOLDER", folder)
    before = {path: source_stamp(path) for path in folder.glob("*.py")}
    with (folder / "chain_sums.py").open("a") as file:
        file.write("# edited\n")
    changed = {path.stem for path, stamp in before.items() if source_stamp(path) != stamp}
    assert changed == {"chain_sums", "chain_kinetic", "chain"}
