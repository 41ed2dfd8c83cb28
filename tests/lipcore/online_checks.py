"""Samples as rows that a model learns online, and whether two models answer alike."""

import numpy as np

from lipcore.data.samples import Samples
from lipcore.model.torque_model import TorqueModel
from lipcore.online.batch import Rows

EXACT = 1e-8
"""Relative to the largest number compared."""


def as_rows(samples: Samples, began: float = 1000.0) -> Rows:
    """All samples as rows to learn."""
    code = np.zeros(len(samples), np.uint8)
    return Rows(began + samples.t, samples.q, samples.dq, samples.ddq, samples.tau, code)


def same_answers(one: TorqueModel, other: TorqueModel, rows: Rows, tolerance: float = EXACT) -> None:
    """Assert equal means and standard deviations."""
    a, b = (model.predict(rows.q, rows.dq, rows.ddq) for model in (one, other))
    np.testing.assert_allclose(a.tau, b.tau, rtol=0, atol=tolerance * np.abs(b.tau).max())
    # variances, whose differences of large numbers are what rounding reaches
    np.testing.assert_allclose(a.tau_std**2, b.tau_std**2, rtol=1e-6, atol=tolerance * (b.tau_std**2).max())
