"""`python -m benchmarks exported`: a short run on the shipped model."""

import json

import pytest
from rich.console import Console

from benchmarks.exported.running import SHIPPED, Options, grids, run, targets
from benchmarks.workload import BenchError
from tests.lipcore.export.compiled import needs_compiler

pytestmark = pytest.mark.slow


@needs_compiler
def test_a_short_run(tmp_path):
    results = run(Options(SHIPPED, calls=500), Console(quiet=True))  # fewer calls than queries
    assert [each.count for each in results.timings.values()] == [500, 500, 500, 50]
    assert results.timings["nothing"].p50 < results.timings["mean"].p50 < results.timings["std"].p50
    assert max(results.deviations.values()) < 1e-9
    met = {each.name: each.met for each in targets(results)}
    assert met["torque: largest relative deviation"]
    assert met["standard deviation: the same"]
    assert all(len(row) == len(grid.columns) for grid in grids(results) for row in grid.rows)
    results.write(tmp_path / "results.json", [])
    assert json.loads((tmp_path / "results.json").read_text())["sizes"]["model.o"] > 10_000


@needs_compiler
def test_compiler_error_is_reported():
    with pytest.raises(BenchError, match="-fno-such-flag"):
        run(Options(SHIPPED, calls=20, queries=20, flags=("-fno-such-flag",)), Console(quiet=True))


def test_missing_compiler_is_reported(monkeypatch):
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(BenchError, match="cc is not installed"):
        run(Options(SHIPPED, calls=20, queries=20), Console(quiet=True))
