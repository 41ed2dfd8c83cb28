"""The error that was seen: what the stated uncertainty must not fall below."""

from __future__ import annotations

import numpy as np

from lipcore.online.record import Record
from lipcore.samples import Array

FEWEST_ROWS = 50
"""Fewer rows say too little: noise alone moves the mean of 49 squares by a fifth."""
DEVIATIONS = 3.0
"""Standard errors beyond which an excess is not chance."""


def error_floor(record: Record) -> Array:
    """Function variance (N·m)², (n,), that the errors of `record` prove: mean e² − noise variance, or 0.

    Where the function is right, e is noise: e²/noise has mean 1 and variance 2 (Gaussian), so its mean over N rows has
    the standard error √(2/N). The excess is reported beyond three of them, mean e² > noise (1 + 3 √(2/N)), and taken
    whole then. White noise alone raises a floor in 0.3 % (N = 50) to 0.15 % (N = 2000) of the records of one joint, and
    a small one: about noise · 3 √(2/N). Fewer than 50 rows: 0.
    """
    if record.rows < FEWEST_ROWS:
        return np.zeros(record.n_joints)
    chance = record.noise * (1 + DEVIATIONS * np.sqrt(2 / record.rows))
    return np.where(record.squared > chance, record.squared - record.noise, 0.0)
