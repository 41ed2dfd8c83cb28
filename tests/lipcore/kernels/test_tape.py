"""Tests of programs that run for many queries at once."""

from typing import Any

import numpy as np
import pytest

from lipcore.kernels.fast.tape import BLOCK
from lipcore.kernels.graph import Graph, Program
from lipcore.kernels.tape import Tape


def combine(x: list[Any], seed: int) -> list[Any]:
    """Return sums, differences and products of numbers and constants, drawn at random, as results."""
    rng, values = np.random.default_rng(seed), list(x)
    for _ in range(200):
        one, other = (values[place] for place in rng.integers(max(0, len(values) - 20), len(values), 2))
        constant = rng.uniform(-1.0, 1.0)
        made = [
            one + other,
            one - other,
            0.5 * one * other,
            one + constant,
            constant - one,
            one - constant,
            constant * one,
            constant * one + other,
            other - one * constant,
            one * constant - other,
            other - one * values[0],
            one * values[0] - other,
            -one,
        ]
        values.append(made[rng.integers(len(made))])
    return values[-5:]


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("count", [1, BLOCK, 2 * BLOCK + 3])
def test_results_are_those_of_the_formula(seed: int, count: int) -> None:
    tape = Tape.of(Program.of(combine(Graph().inputs(4), seed)))
    inputs = np.random.default_rng(seed).uniform(-1.0, 1.0, (4, count))
    found, expected = tape(inputs), np.stack(combine(list(inputs), seed))
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)
    assert tape.rows < 60  # rows are used again


def test_inputs_and_repetitions_are_results() -> None:
    x, y = Graph().inputs(2)
    tape, inputs = Tape.of(Program.of([y, x - y, y, x - y])), np.arange(6.0).reshape(2, 3)
    np.testing.assert_array_equal(tape(inputs), [inputs[1], inputs[0] - inputs[1]] * 2)
