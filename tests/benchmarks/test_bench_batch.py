"""`python -m benchmarks batch`: a short run on the shipped model."""

from rich.console import Console

from benchmarks.batch import grids, run
from benchmarks.exported.running import SHIPPED


def test_times_of_all_subjects_and_sizes() -> None:
    results = run(SHIPPED, [1, 30], 1, Console(quiet=True))
    assert list(results.times) == ["torque", "torque and std", "Pinocchio's rnea, Python loop"]
    assert all(set(sizes) == {1, 30} and min(map(min, sizes.values())) > 0 for sizes in results.times.values())
    assert results.deviation < 1e-12
    assert len(grids(results)[1].rows) == 6
