"""A real recording: a Franka Panda, learnt from torque alone, judged on motion that comes after."""

from pathlib import Path

import pytest

from benchmarks.studies.real_recordings import PANDA_RATE, read_bag
from lipcore import FitOptions, train
from lipcore.data.metrics import evaluate

DATA = Path(__file__).parents[3] / "shared/data"
PANDA, SCHUNK = DATA / "panda_exciting_trajectory.db3", DATA / "schunk_liu_althoff.npz"


@pytest.mark.slow
@pytest.mark.skipif(not PANDA.exists(), reason=f"no recording at {PANDA}")
def test_panda_predicts_the_rest_of_its_trajectory() -> None:
    training, held_out = read_bag(PANDA, PANDA_RATE)
    model = train(training, ("revolute",) * 7, "rigid-body", FitOptions(device="cpu"))
    answer = model.predict(held_out.q, held_out.dq, held_out.ddq)
    metrics = evaluate(held_out.tau, *answer.interval)
    # twice what README and docs/numbers say; joint 1 turns about the vertical and carries next to nothing
    assert (metrics.nmse < [0.5, 7e-4, 3e-3, 0.017, 0.09, 0.011, 0.05]).all()
    assert metrics.coverage.min() > 0.85
