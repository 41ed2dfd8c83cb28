"""A job's pass over all rows of its data sets: which rows are read and what their statistics are."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

import lipcore
from lipcore.data import independence
from lipcore.data.samples import Samples
from lipcore.kernels.drive.play import with_deflections
from lipcore.training.conditioning import SHARD, condition
from service.foundation.settings import Settings
from service.runtime.executors import Inline, shard_executor, sum_shards
from service.storage.database import DatasetRow
from service.storage.files import Files, new_id
from service.storage.sample_file import Reader
from service.training.material import MAX_CANDIDATE_ROWS
from service.training.summing import Context, packed, read, shard_statistics
from service.training.table import STRETCHES, Table, TablePart, open_parts
from tests.service.data import QUICK, stream

ROWS = SHARD + 700


def recording(seed: int = 1) -> Samples:
    """Return two episodes at 100 Hz that together are longer than a shard."""
    samples = stream(samples=ROWS, seed=seed, rate=100.0)
    return replace(samples, episode=np.repeat([4, 9], [900, ROWS - 900]))


@pytest.fixture(scope="module")
def settings(tmp_path_factory):
    return Settings(home=tmp_path_factory.mktemp("rows"), statistics_workers=2, training_cpus=2, training_niceness=0)


@pytest.fixture(scope="module")
def parts(settings):
    """Two data sets; the second has no times."""
    files, rows = Files.of(settings), []
    for seed, rate in ((1, 100.0), (2, None)):
        samples, name = recording(seed), new_id("ds")
        sha256 = files.write_samples(name, ROWS, 2, partial(getattr, samples))
        joints = list(samples.joint_names)
        rows.append(DatasetRow(id=name, sha256=sha256, joint_names=joints, report={"rate_hz": rate}))
    return open_parts(files, rows)


@pytest.fixture(scope="module")
def model():
    return lipcore.train(stream(), ["revolute"] * 2, "lip-chain", lipcore.FitOptions(**QUICK, statistics="chosen"))


def masked(part: TablePart) -> TablePart:
    """Return the part with some stretches of rows chosen, none in the middle."""
    mask = np.arange(ROWS) % 50 < 30
    mask[1000:2000] = False
    return replace(part, chosen=mask)


def test_reader_reads_rows(parts):
    reader: Reader = parts[0].reader
    np.testing.assert_array_equal(reader.array("q", 17, 940), recording().q[17:940])
    index = np.array([0, 3, 4, 899, 900, ROWS - 1])
    for name, values in reader.take(index).items():
        np.testing.assert_array_equal(values, getattr(recording(), name)[index])
    assert reader.take(np.empty(0, np.int64))["tau"].shape == (0, 2)
    with pytest.raises(ValueError, match="tau ends before"):
        reader.array("tau", 0, ROWS + 1)


def test_table_concatenates_its_parts(parts):
    table = Table([masked(parts[0]), parts[1]])
    whole = Samples.concatenate([recording(1).rows(table.parts[0].chosen), recording(2)])
    assert len(table) == len(whole) == len(table.thinned(10**6))
    np.testing.assert_array_equal(table.thinned(10**6).tau, whole.tau)
    index = np.linspace(0, len(whole) - 1, 300).round().astype(np.int64)
    np.testing.assert_array_equal(table.thinned(300).q, whole.q[index])
    # a new episode begins after omitted rows
    assert len(Table([masked(parts[0])]).thinned(10**6).episodes()) == 35
    assert len(Table([parts[0]]).thinned(10**6).episodes()) == 2


def test_stretches_are_contiguous(parts):
    found = Table(parts).stretches()
    assert len(found) <= min(2 * ROWS, STRETCHES * 500) < MAX_CANDIDATE_ROWS + 1
    for each in found.episodes():
        np.testing.assert_allclose(np.diff(found.t[each]), 0.01, rtol=1e-6)


def test_weights_in_shards_equal_weights_of_the_whole(settings, parts):
    for part in (masked(parts[0]), parts[0]):
        shards = list(part.shards())
        assert {each.last - each.first for each in shards} == {SHARD, ROWS - SHARD}
        types = ("revolute",) * len(part.row.joint_names)
        read_back = [read(settings, tuple(part.row.joint_names), types, each) for each in shards]
        samples, mask = recording(), slice(None) if part.chosen is None else part.chosen
        weights = np.concatenate([weights for _, weights in read_back])
        np.testing.assert_array_equal(weights, independence.recording_weights(samples.t, samples.episode)[mask])
        np.testing.assert_array_equal(np.concatenate([each.tau for each, _ in read_back]), samples.tau[mask])
        whole = with_deflections(samples, types).rows(mask).deflections
        np.testing.assert_array_equal(np.concatenate([each.deflections for each, _ in read_back]), whole)
        assert part.independent_rows() == pytest.approx(weights.sum())


def test_rows_without_times_count_no_more_than_chosen_rows(parts):
    table = Table(parts).weighed(500)
    assert [part.factor for part in table.parts] == [1.0, 500 / ROWS]
    assert table.independent_rows() == pytest.approx(0.1 * ROWS + 500, rel=0.01)
    assert Table([parts[1]]).weighed(500).independent_rows() == pytest.approx(500)


def test_rows_of_a_sparse_table_count_for_omitted_rows(parts):
    table = Table([masked(parts[0]), parts[1]]).weighed(500)
    assert table.sparse(len(table)) is table
    sparse = table.sparse(len(table) // 3 + 1)
    assert len(sparse) == pytest.approx(len(table) / 3, abs=2)
    assert not (sparse.parts[0].chosen & ~table.parts[0].chosen).any()
    assert sparse.independent_rows() == pytest.approx(table.independent_rows(), rel=0.02)


def test_shards_without_rows_are_omitted(parts):
    mask = np.zeros(ROWS, dtype=bool)
    mask[SHARD + 5] = True
    (shard,) = replace(parts[0], chosen=mask).shards()
    assert (shard.first, shard.last) == (SHARD, ROWS)


@pytest.mark.slow
def test_sum_is_the_same_in_processes_and_inline(settings, parts, model):
    """Inline and in processes the bits are equal; the direct computation agrees to rounding."""
    table = Table([masked(parts[0]), parts[0]])
    context = Context(settings, packed(model), model.joint_names, None, "cpu")
    work, shards = partial(shard_statistics, context), table.shards()
    here = sum_shards(Inline(), work, shards, lambda: False)
    with shard_executor(settings) as executor:
        there = sum_shards(executor, work, shards, lambda: False)
    assert here.a.tobytes() == there.a.tobytes()
    assert here.b.tobytes() == there.b.tobytes()

    samples = recording()
    weights = independence.recording_weights(samples.t, samples.episode)
    mask = table.parts[0].chosen
    both = Samples.concatenate([samples.rows(mask), samples])
    plain = condition(model, both, np.concatenate([weights[mask], weights])).posterior.statistics
    assert here.weight == pytest.approx(plain.samples)
    a = plain.a[np.triu_indices(len(plain.a))]
    assert np.abs(here.a - a).max() <= 1e-8 * np.abs(a).max()
    assert np.abs(here.b - plain.b).max() <= 1e-8 * np.abs(plain.b).max()
