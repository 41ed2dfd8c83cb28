"""A store shared by services: each reads what another has written, from a local copy that is verified."""

import os
import signal
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

import lipcore
from lipcore.files import persistence
from service.foundation.errors import DamagedDataError
from service.foundation.settings import Settings
from service.storage import sample_file
from service.storage.files import DamagedFileError, Files, FilesUnreachableError, new_id, shared
from tests.service.learning import pendulums
from tests.service.storage.files.conftest import put
from tests.system.faults.damage import flip

ANY_STORE = pytest.mark.parametrize("url", ["folder"], indirect=True)
"""For behaviour that is the same with every store: test it with the faster one."""


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """The folder of a small model."""
    folder = tmp_path_factory.mktemp("trained") / "arm"
    lipcore.save(pendulums.trained_model(), folder)
    return folder


@pytest.fixture
def publish(trained):
    """Return a function that stores the model as a version and returns its manifest."""

    def store(files, name="mv_one"):
        with files.new_version(name) as folder:
            return lipcore.copy_model(trained, folder)

    return store


def stored_keys(files):
    """Return the keys of all objects."""
    objects = files._place.objects
    return sorted(each.key for kind in ("datasets/", "versions/", "learning/") for each in objects.list(kind))


def spoil_object(files, key, folder):
    """Flip one bit of an object."""
    path = folder / "spoilt"
    files._place.objects.get(key, path)
    flip(path)
    files._place.objects.put(path, key)


@pytest.fixture
def one(host):
    return host("one")


@pytest.fixture
def other(host):
    return host("other")


def test_store_has_the_layout_of_a_home(one, host, tmp_path, publish):
    local = Files(tmp_path / "local")
    for files in (one, local):
        put(files)
        files.write_snapshot("snap_one", b"state")
        publish(files)
    names = {path.relative_to(tmp_path / "local").as_posix() for path in (tmp_path / "local").rglob("*.*")}
    assert set(stored_keys(one)) == names


def test_second_read_uses_the_local_copy(one, other, publish):
    digest = put(one)
    publish(one)
    first = other.samples_file("ds_one", digest), other.version_folder("mv_one")
    one.delete_dataset("ds_one")
    one.delete_version("mv_one")
    assert stored_keys(one) == []
    assert (other.samples_file("ds_one", digest), other.version_folder("mv_one")) == first
    assert all(path.exists() for path in first)
    with pytest.raises(DamagedDataError, match="missing"):
        one.samples_file("ds_one", digest)


def test_snapshots_equal_the_stored_ones(one, other):
    digest = one.write_snapshot("snap_one", b"state")
    assert other.read_snapshot("snap_one", digest) == other.read_snapshot("snap_one") == b"state"
    with pytest.raises(DamagedFileError, match="sha256"):
        other.read_snapshot("snap_one", "0" * 64)
    other.delete_snapshot("snap_one")
    other.delete_snapshot("snap_one")
    with pytest.raises(DamagedFileError, match="missing"):
        other.read_snapshot("snap_one", digest)


def test_version_predicts_the_same_from_its_copy(one, other, publish, trained):
    manifest = publish(one)
    model = other.load_version("mv_one", persistence.checksums(manifest))
    q = np.full((1, 2), 0.3)
    assert np.array_equal(model.predict(q, q, q).tau, lipcore.load(trained).predict(q, q, q).tau)


@ANY_STORE
def test_version_without_its_manifest_does_not_exist(one, other, publish):
    publish(one)
    one._place.objects.delete("versions/mv_one/manifest.json")
    assert not other.version_folder("mv_one").exists()


@ANY_STORE
@pytest.mark.parametrize("name", ["manifest.json", "model.safetensors"])
def test_damaged_copy_of_a_version_is_fetched_again(one, other, name, publish):
    manifest = publish(one)
    flip(other.version_folder("mv_one") / name)
    assert other.load_version("mv_one", persistence.checksums(manifest)).n_joints == 2
    (other.version_folder("mv_one") / name).unlink()
    assert other.load_version("mv_one", persistence.checksums(manifest)).n_joints == 2


def test_damaged_object_is_never_read(one, other, tmp_path, publish):
    digest, manifest = put(one), publish(one)
    spoil_object(one, "datasets/ds_one.safetensors", tmp_path)
    spoil_object(one, "versions/mv_one/model.safetensors", tmp_path)
    with pytest.raises(DamagedDataError, match="Upload it again"):
        other.samples_file("ds_one", digest)
    with pytest.raises(lipcore.ModelFormatError, match="sha256"):
        other.load_version("mv_one", persistence.checksums(manifest))


@ANY_STORE
def test_unfinished_version_is_not_stored(one, trained, monkeypatch, publish):
    with suppress(RuntimeError), one.new_version("mv_one") as folder:
        lipcore.copy_model(trained, folder)
        raise RuntimeError("cancelled")
    assert stored_keys(one) == list(one.versions.iterdir()) == []
    put_object = one._place.objects.put

    def fail(path, key):
        if key.endswith("manifest.json"):
            raise FilesUnreachableError(5, "gone")
        put_object(path, key)

    monkeypatch.setattr(one._place.objects, "put", fail)
    with pytest.raises(FilesUnreachableError):
        publish(one)
    assert stored_keys(one) == list(one.versions.iterdir()) == []


def test_versions_of_a_job_are_found_by_their_mark_and_deleted(one, other, publish):
    for name in ("mv_job1_a", "mv_job2_a"):
        publish(one, name)
    (one._place._drafts / "mv_job1_b-x1y2").mkdir()  # left by a killed process
    assert other.versions_marked("job1", ended=False) == []
    assert other.versions_marked("job1") == ["mv_job1_a"]
    assert one.versions_marked("job1") == ["mv_job1_a", "mv_job1_b"]
    for name in one.versions_marked("job1"):
        one.delete_version(name)
    assert one.versions_marked("job1") == []
    assert {key.split("/")[1] for key in stored_keys(one)} == {"mv_job2_a"}


def fill(files, publish):
    for name in ("a", "b"):
        put(files, f"ds_{name}")
        files.write_snapshot(f"snap_{name}", b"state")
        publish(files, f"mv_{name}")


@pytest.mark.slow
def test_files_without_a_row_are_deleted_once_old(one, other, monkeypatch, publish):
    fill(one, publish)
    known = {"ds_a"}, {"mv_a"}, {"snap_a"}
    before = stored_keys(one)
    assert other.sweep(*known) == 0
    assert stored_keys(one) == before
    monkeypatch.setattr(shared, "DAY_S", -60.0)
    assert other.sweep(*known) > 0
    assert stored_keys(one) == [key for key in before if "_a" in key]
    assert other.sweep(*known) == 0


@ANY_STORE
def test_host_with_a_fast_clock_sweeps_no_new_files(one, monkeypatch, publish):
    """Rows are read before the store is listed, so the rows of newer files are unknown."""
    fill(one, publish)
    before, real = stored_keys(one), time.time
    monkeypatch.setattr(time, "time", lambda: real() + 3 * 86400.0)
    assert one.sweep(set(), set(), set()) == 0
    assert stored_keys(one) == before


@ANY_STORE
def test_least_recently_used_copies_are_evicted(host, monkeypatch):
    one, size = host("one"), sample_file.count_bytes(10, 2)
    digests = {name: put(one, name) for name in ("ds_1", "ds_2", "ds_3", "ds_4")}
    other = host("other", cache_bytes=3 * size)
    open_files = []
    for name, digest in digests.items():
        path = other.samples_file(name, digest)
        open_files.append(path.open("rb"))
        used = 1000.0 + int(name[-1]) if name != "ds_1" else 2000.0  # the first copy is used repeatedly
        os.utime(path, (used, used))
    monkeypatch.setattr(shared, "GRACE_S", 0.0)
    other._place._trim()
    kept = {path.stem for path in other.datasets.iterdir()}
    assert ("ds_1" in kept, "ds_2" in kept) == (True, False)
    assert sum(path.stat().st_size for path in other.datasets.iterdir()) <= 3 * size
    for file in open_files:  # an open copy stays readable
        assert len(file.read()) > size
        file.close()
    assert other.samples_file("ds_2", digests["ds_2"]).exists()


def test_concurrent_fetches_read_whole_files(one, other, publish):
    digest, sums = put(one, samples=200), persistence.checksums(publish(one))
    with ThreadPoolExecutor(8) as pool:
        found = [pool.submit(other.samples_file, "ds_one", digest) for _ in range(8)]
        loaded = [pool.submit(other.read_version, "mv_one", persistence.read_files) for _ in range(8)]
    assert len({each.result() for each in found}) == 1
    for each in loaded:
        persistence.check_checksums(each.result(), sums)
    assert not list(other._place._drafts.iterdir())


def test_upload_of_a_killed_process_is_swept_and_never_read(tmp_path, monkeypatch):
    store = tmp_path / "store"
    store.mkdir()
    one = Files(tmp_path / "one", store.as_uri())
    child = os.fork()
    if not child:
        with suppress(BaseException):
            put(one, "ds_lost")
        os.kill(os.getpid(), signal.SIGKILL)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
    assert stored_keys(one) == ["datasets/ds_lost.safetensors"]
    assert one.sweep(set(), set(), set()) == 0  # its row may still follow
    monkeypatch.setattr(shared, "DAY_S", -60.0)
    assert one.sweep(set(), set(), set()) == 1
    assert stored_keys(one) == []


@ANY_STORE
def test_verify_ignores_copies_and_reads_one_file_at_a_time(one, url, tmp_path, publish):
    digests = [put(one, f"ds_{number}", seed=number) for number in range(2)]
    publish(one)
    flip(one.samples_file("ds_0", digests[0]))  # exists on this host only
    with Files.fresh(Settings(home=tmp_path / "one", files_url=url, database_url="postgresql://nowhere")) as files:
        first = files.samples_file("ds_0", digests[0])
        assert first.exists()
        files.load_version("mv_one", None)
        assert not first.exists()
        files.samples_file("ds_1", digests[1])
        assert not files.version_folder("mv_none").exists()
    assert not list(one._place._drafts.iterdir())


def test_store_check_leaves_nothing_behind(one):
    one.check()
    one.try_out()
    assert list(one._place.objects.list("probes/")) == []
    assert list(one._place._drafts.iterdir()) == []


@ANY_STORE
def test_old_drafts_are_deleted_at_the_next_start(one):
    old, new = (Path(one._place._drafts, new_id("mv")) for _ in range(2))
    for path in (old, new):
        path.mkdir()
    os.utime(old, (1000.0, 1000.0))
    upload = one.upload()
    assert one.clear() == 2
    assert [path.exists() for path in (upload, old, new)] == [False, False, True]
