"""What one service stores, the others read; each from a copy of its own, which is never taken for the thing itself."""

import os
import shutil
import signal
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import lipcore
from lipcore.files import persistence
from service.foundation.errors import DamagedDataError
from service.foundation.settings import Settings
from service.storage import sample_file
from service.storage.files import DamagedFileError, Files, FilesUnreachableError, new_id, shared
from tests.service.data import stream
from tests.service.faults.damage import flip
from tests.service.learning import pendulums

ANY_STORE = pytest.mark.parametrize("url", ["folder"], indirect=True)
"""For what is the same with every store, on the quicker one."""


def put(files, samples, dataset="ds_one"):
    return files.write_samples(dataset, len(samples), samples.n_joints, partial(getattr, samples))


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Folder of a small model."""
    folder = tmp_path_factory.mktemp("trained") / "arm"
    lipcore.save(pendulums.trained(), folder)
    return folder


@pytest.fixture
def publish(trained):
    """Stores the model as a version; returns its manifest."""

    def store(files, name="mv_one"):
        with files.new_version(name) as folder:
            return lipcore.copy_model(trained, folder)

    return store


def stored(files):
    """Keys of all objects."""
    objects = files._place.objects
    return sorted(each.key for kind in ("datasets/", "versions/", "learning/") for each in objects.list(kind))


def spoil_object(files, key, folder):
    """Replace an object by one that differs in a bit."""
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


def test_a_store_has_the_layout_of_a_home(one, host, tmp_path, publish):
    local = Files(tmp_path / "local")
    for files in (one, local):
        put(files, stream(samples=10))
        files.write_snapshot("snap_one", b"state")
        publish(files)
    names = {path.relative_to(tmp_path / "local").as_posix() for path in (tmp_path / "local").rglob("*.*")}
    assert set(stored(one)) == names


def test_a_second_read_asks_nobody(one, other, publish):
    digest = put(one, stream(samples=10))
    publish(one)
    first = other.samples_file("ds_one", digest), other.version_folder("mv_one")
    one.delete_samples("ds_one")
    one.delete_version("mv_one")
    assert stored(one) == []
    assert (other.samples_file("ds_one", digest), other.version_folder("mv_one")) == first
    assert all(path.exists() for path in first)
    with pytest.raises(DamagedDataError, match="missing"):
        one.samples_file("ds_one", digest)


def test_snapshots_are_those_that_were_stored(one, other):
    digest = one.write_snapshot("snap_one", b"state")
    assert other.read_snapshot("snap_one", digest) == other.read_snapshot("snap_one") == b"state"
    with pytest.raises(DamagedFileError, match="sha256"):
        other.read_snapshot("snap_one", "0" * 64)
    other.delete_snapshot("snap_one")
    other.delete_snapshot("snap_one")
    with pytest.raises(DamagedFileError, match="missing"):
        other.read_snapshot("snap_one", digest)


def test_a_version_answers_from_a_copy_as_from_its_files(one, other, publish, trained):
    manifest = publish(one)
    model = other.load_version("mv_one", persistence.checksums(manifest))
    q = np.full((1, 2), 0.3)
    assert np.array_equal(model.predict(q, q, q).tau, lipcore.load(trained).predict(q, q, q).tau)


@ANY_STORE
def test_a_version_without_its_manifest_is_none(one, other, publish):
    publish(one)
    one._place.objects.delete("versions/mv_one/manifest.json")
    assert not other.version_folder("mv_one").exists()


@ANY_STORE
@pytest.mark.parametrize("name", ["manifest.json", "model.safetensors"])
def test_a_damaged_copy_of_a_version_is_fetched_again(one, other, name, publish):
    manifest = publish(one)
    flip(other.version_folder("mv_one") / name)
    assert other.load_version("mv_one", persistence.checksums(manifest)).n_joints == 2
    (other.version_folder("mv_one") / name).unlink()
    assert other.load_version("mv_one", persistence.checksums(manifest)).n_joints == 2


def test_a_damaged_object_is_never_read(one, other, tmp_path, publish):
    digest = put(one, stream(samples=10))
    manifest = publish(one)
    spoil_object(one, "datasets/ds_one.safetensors", tmp_path)
    spoil_object(one, "versions/mv_one/model.safetensors", tmp_path)
    with pytest.raises(DamagedDataError, match="Upload it again"):
        other.samples_file("ds_one", digest)
    with pytest.raises(lipcore.ModelFormatError, match="sha256"):
        other.load_version("mv_one", persistence.checksums(manifest))


@ANY_STORE
def test_a_version_that_is_not_finished_is_not_stored(one, trained):
    with suppress(RuntimeError), one.new_version("mv_one") as folder:
        lipcore.copy_model(trained, folder)
        raise RuntimeError("cancelled")
    assert stored(one) == []
    assert not list(one.versions.iterdir())


@ANY_STORE
def test_a_version_of_which_a_file_cannot_be_stored_is_withdrawn(one, monkeypatch, publish):
    put_object = one._place.objects.put

    def fail(path, key):
        if key.endswith("manifest.json"):
            raise FilesUnreachableError(5, "gone")
        put_object(path, key)

    monkeypatch.setattr(one._place.objects, "put", fail)
    with pytest.raises(FilesUnreachableError):
        publish(one)
    assert stored(one) == []
    assert not list(one.versions.iterdir())


def test_versions_of_a_job_are_found_by_their_mark_and_deleted(one, other, publish):
    for name in ("mv_job1_a", "mv_job2_a"):
        publish(one, name)
    (one._place._drafts / "mv_job1_b-x1y2").mkdir()  # of a process that was killed
    assert other.versions_marked("job1", ended=False) == []
    assert other.versions_marked("job1") == ["mv_job1_a"]
    assert one.versions_marked("job1") == ["mv_job1_a", "mv_job1_b"]
    for name in one.versions_marked("job1"):
        one.delete_version(name)
    assert one.versions_marked("job1") == []
    assert {key.split("/")[1] for key in stored(one)} == {"mv_job2_a"}


def fill(files, publish):
    for name in ("a", "b"):
        put(files, stream(samples=10), f"ds_{name}")
        files.write_snapshot(f"snap_{name}", b"state")
        publish(files, f"mv_{name}")


def test_what_no_row_names_is_deleted_once_it_is_old(one, other, monkeypatch, publish):
    fill(one, publish)
    known = {"ds_a"}, {"mv_a"}, {"snap_a"}
    before = stored(one)
    assert other.sweep(*known) == 0
    assert stored(one) == before
    monkeypatch.setattr(shared, "DAY_S", -60.0)
    assert other.sweep(*known) > 0
    assert stored(one) == [key for key in before if "_a" in key]
    assert other.sweep(*known) == 0


@ANY_STORE
def test_a_host_whose_clock_is_ahead_sweeps_nothing_that_is_young(one, monkeypatch, publish):
    """Rows are read before the store is listed: those of what comes meanwhile are not known yet."""
    fill(one, publish)
    before, real = stored(one), time.time
    monkeypatch.setattr(time, "time", lambda: real() + 3 * 86400.0)
    assert one.sweep(set(), set(), set()) == 0
    assert stored(one) == before


@ANY_STORE
def test_copies_that_were_not_used_for_long_make_room(host, monkeypatch):
    one, size = host("one"), sample_file.count_bytes(10, 2)
    samples = stream(samples=10)
    digests = {name: put(one, samples, name) for name in ("ds_1", "ds_2", "ds_3", "ds_4")}
    other = host("other", cache_bytes=3 * size)
    open_files = []
    for name, digest in digests.items():
        path = other.samples_file(name, digest)
        open_files.append(path.open("rb"))
        used = 1000.0 + int(name[-1]) if name != "ds_1" else 2000.0  # the first is read again and again
        os.utime(path, (used, used))
    monkeypatch.setattr(shared, "GRACE_S", 0.0)
    other._place._trim()
    kept = sorted(path.stem for path in other.datasets.iterdir())
    assert "ds_1" in kept
    assert "ds_2" not in kept
    assert sum(path.stat().st_size for path in other.datasets.iterdir()) <= 3 * size
    for file in open_files:  # who reads a copy goes on reading
        assert len(file.read()) > size
        file.close()
    assert other.samples_file("ds_2", digests["ds_2"]).exists()


def test_threads_that_fetch_at_once_all_read_it_whole(one, other, publish):
    digest, manifest = put(one, stream(samples=200)), publish(one)
    sums = persistence.checksums(manifest)
    with ThreadPoolExecutor(8) as pool:
        found = [pool.submit(other.samples_file, "ds_one", digest) for _ in range(8)]
        loaded = [pool.submit(other.read_version, "mv_one", persistence.read_files) for _ in range(8)]
    assert len({each.result() for each in found}) == 1
    for each in loaded:
        persistence.check_checksums(each.result(), sums)
    assert not list(other._place._drafts.iterdir())


def test_a_process_killed_after_its_upload_leaves_what_is_swept_and_read_by_nobody(tmp_path, monkeypatch):
    store = tmp_path / "store"
    store.mkdir()
    one = Files(tmp_path / "one", store.as_uri())
    child = os.fork()
    if not child:
        with suppress(BaseException):
            put(one, stream(samples=10), "ds_lost")
        os.kill(os.getpid(), signal.SIGKILL)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
    assert stored(one) == ["datasets/ds_lost.safetensors"]
    assert one.sweep(set(), set(), set()) == 0  # its row may still be to come
    monkeypatch.setattr(shared, "DAY_S", -60.0)
    assert one.sweep(set(), set(), set()) == 1
    assert stored(one) == []


@ANY_STORE
def test_who_verifies_reads_no_copies_and_one_file_at_a_time(one, url, tmp_path, publish):
    digests = [put(one, stream(samples=10, seed=number), f"ds_{number}") for number in range(2)]
    publish(one)
    flip(one.samples_file("ds_0", digests[0]))  # of this host only
    with Files.fresh(Settings(home=tmp_path / "one", files_url=url, database_url="postgresql://nowhere")) as files:
        first = files.samples_file("ds_0", digests[0])
        assert first.exists()
        files.load_version("mv_one", None)
        assert not first.exists()
        files.samples_file("ds_1", digests[1])
        assert not files.version_folder("mv_none").exists()
    assert not list(one._place._drafts.iterdir())


def test_a_store_can_be_tried_out_and_nothing_is_left(one):
    one.check()
    one.try_out()
    assert list(one._place.objects.list("probes/")) == []
    assert list(one._place._drafts.iterdir()) == []


@ANY_STORE
def test_drafts_of_an_earlier_run_go_at_the_next_start(one, tmp_path):
    old, new = (Path(one._place._drafts, new_id("mv")) for _ in range(2))
    for path in (old, new):
        path.mkdir()
    os.utime(old, (1000.0, 1000.0))
    upload = one.upload()
    assert one.clear() == 2
    assert not upload.exists()
    assert not old.exists()
    assert new.exists()
    shutil.rmtree(new)
