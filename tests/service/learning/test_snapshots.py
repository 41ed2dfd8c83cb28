"""Snapshots: storage, even thinning, and rejection after a rollback."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st
from sqlalchemy import select

from service.journal import snapshots
from service.journal.snapshots import choose_kept
from service.storage.database import SnapshotRow, VersionRow, now
from service.storage.files import Files
from tests.service.learning.batches import MODEL, OTHER, append_batches, make_batch, roll_back


@pytest.fixture
def database(database):
    """Database with a second version and forty batches."""
    with database.transaction() as session:
        session.add(VersionRow(model=MODEL, version=2, folder="mv_2", created_at=now(), job=None, manifest={}))
    append_batches(database, *(make_batch(k) for k in range(40)))
    return database


@pytest.fixture
def files(home):
    return Files(home)


def save_snapshot(database, files, number, version=1, most=20, model=MODEL):
    payload = f"{model} {version} {number}".encode()
    return snapshots.save(database, files, model, version, number, number, payload, most=most)


def find_latest(database, version=1, at_most=None):
    with database.session() as session:
        return snapshots.find_latest(session, MODEL, version, at_most)


def list_numbers(database):
    with database.session() as session:
        return sorted(session.scalars(select(SnapshotRow.number)))


def list_ids(database, files):
    """Return the snapshots in the database, which are those in the files."""
    with database.session() as session:
        ids = set(session.scalars(select(SnapshotRow.id)))
    assert {path.name.removesuffix(".safetensors") for path in files.learning.iterdir()} == ids
    return ids


def test_latest_snapshot_of_a_version_is_found(database, files):
    for number in (10, 30, 20):
        save_snapshot(database, files, number)
    save_snapshot(database, files, 40, version=2)
    save_snapshot(database, files, 35, model=OTHER)
    found = {at_most: find_latest(database, at_most=at_most) for at_most in (None, 30, 29, 10)}
    assert {at_most: row.number for at_most, row in found.items()} == {None: 30, 30: 30, 29: 20, 10: 10}
    assert find_latest(database, at_most=9) is None
    assert find_latest(database, version=3) is None
    assert snapshots.read(files, found[29]) == b"arm 1 20"
    assert snapshots.read(files, find_latest(database, version=2)) == b"arm 2 40"


def test_files_match_rows(database, files):
    names = [save_snapshot(database, files, number) for number in (5, 6, 7, 7)]
    assert list_ids(database, files) == {*names[:2], names[3]}  # the second 7 replaces the first


def test_rolled_back_state_is_not_stored(database, files):
    roll_back(database, 20)  # event 41
    assert save_snapshot(database, files, 30) is None
    assert save_snapshot(database, files, 40) is None
    assert list_ids(database, files) == set()
    assert save_snapshot(database, files, 20)  # the rollback target
    assert save_snapshot(database, files, 41)
    assert list_numbers(database) == [20, 41]


def test_snapshots_per_version_are_limited(database, files):
    save_snapshot(database, files, 3, version=2)
    for number in range(1, 31):
        save_snapshot(database, files, number, most=6)
    left = sorted(set(list_numbers(database)) - {3})
    assert len(left) == 6
    assert left[0] == 1
    assert left[-3:] == [28, 29, 30]
    assert find_latest(database, version=2).number == 3
    assert len(list_ids(database, files)) == 7


@given(st.lists(st.integers(0, 1000), unique=True, max_size=40), st.integers(2, 12))
def test_thinning_keeps_the_newest_half_and_the_oldest(numbers, most):
    falling = sorted(numbers, reverse=True)
    kept = [falling[place] for place in choose_kept(falling, most)]
    assert len(kept) == min(len(falling), most)
    assert kept == sorted(kept, reverse=True)
    assert kept[: most // 2] == falling[: most // 2]
    assert kept[-1:] == falling[-1:]


def test_old_snapshots_stay_evenly_spaced():
    most, kept = 10, []
    for number in range(1, 1001):
        before = [number, *kept]
        kept = [before[place] for place in choose_kept(before, most)]
    old = kept[(most + 1) // 2 - 1 :]
    steps = [newer - older for newer, older in pairwise(old)]
    even = (old[0] - old[-1]) / len(steps)
    assert max(steps) <= 2.5 * even


def test_files_of_interrupted_saves_are_deleted(database, files):
    kept = save_snapshot(database, files, 10)
    (files.learning / "snap_half.draft").write_bytes(b"half")
    (files.learning / "snap_unnamed.safetensors").write_bytes(b"whole")
    assert snapshots.sweep(database, files) == 2
    assert list_ids(database, files) == {kept}
    assert snapshots.sweep(database, files) == 0


def test_new_files_in_shared_store_are_not_deleted(database, home):
    """Another service may be about to insert their rows."""
    (home / "mounted").mkdir(parents=True)
    files = Files(home, (home / "mounted").as_uri())
    files.write_snapshot("snap_unnamed", b"whole")
    assert snapshots.sweep(database, files) == 0
    assert files.read_snapshot("snap_unnamed") == b"whole"
