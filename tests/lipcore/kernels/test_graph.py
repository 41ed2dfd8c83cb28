"""Tests of programs of single operations."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from lipcore.kernels.graph import Graph, Operation, Program, jacobian

FUNCTIONS: dict[str, Callable[..., float]] = {
    "+": lambda a, b: a + b,
    "-": lambda a, b: a - b,
    "*": lambda a, b: a * b,
    "/": lambda a, b: a / b,
    "negative": lambda a: -a,
    **{name: getattr(math, name) for name in ("sin", "cos", "tanh", "exp", "sqrt", "fabs")},
}


def evaluate(program: Program, inputs: list[float]) -> list[float]:
    values = [*inputs, *program.constants]
    for each in program.operations:
        values.append(FUNCTIONS[each.name](*(values[place] for place in each.arguments)))
    return [values[place] for place in program.results]


@pytest.mark.parametrize(
    "formula",
    [
        lambda x: np.sin(x[0] * x[1] - 2.0) / (3.0 + abs(x[2])),
        lambda x: -(-x[0] - x[1]) * -x[2] + (1.0 - x[0]) * (-2.0),
        lambda x: np.tanh(x[0]) * np.exp(-(x[1] * x[1])) - np.sqrt(x[2]),
        lambda x: (0.0 - x[0]) + (-x[1] + x[2]) - (-x[0]) + 0.0 * np.cos(x[0]),
        lambda x: (x[0] - (-x[1])) / 4.0 + 1.0 / x[2] + (-x[0]) / x[1],
        lambda x: np.cos(np.array([x[0], x[1]]) * -1.5) @ np.array([x[2], 0.25]),
    ],
)
def test_program_computes_the_formula(formula: Callable[[Any], Any]) -> None:
    program = Program.of([formula(np.array(Graph().inputs(3), dtype=object))])
    for values in np.random.default_rng(0).uniform(0.2, 2.0, (5, 3)).tolist():
        assert evaluate(program, values)[0] == pytest.approx(formula(np.array(values)), rel=1e-14)


def test_constants_are_computed_and_equal_operations_are_one() -> None:
    x, y = Graph().inputs(2)
    same = [x * y + (2.0 * 3.0 + 0.0 * y), 6.0 + y * (x * 1.0)]
    program = Program.of(same)
    assert program.results[0] == program.results[1]
    assert program.constants == (6.0,)
    assert program.operations == (Operation("*", (0, 1)), Operation("+", (3, 2)))


def test_signs_share_operations() -> None:
    x, y = Graph().inputs(2)
    program = Program.of([x * 2.5 - y, y + x * -2.5])
    assert [each.name for each in program.operations] == ["*", "-", "-"]


def test_operations_that_no_result_needs_are_left_out() -> None:
    x, y = Graph().inputs(2)
    left_out = (x * y) * 0.0
    assert Program.of([left_out + x]).operations == ()


@pytest.mark.parametrize(
    "formula",
    [
        lambda x: [x[0] * x[1] - x[2] * (x[0] + 2.0), -(x[1] * x[1]) * x[2]],
        lambda x: [x[0] + (x[1] - x[0]), 3.0 - x[2], x[1] * (x[1] * x[1])],
    ],
)
def test_jacobian_is_that_of_central_differences(formula: Callable[[Any], Any]) -> None:
    inputs = Graph().inputs(3)
    rows = jacobian(formula(inputs), inputs)
    program = Program.of([each for row in rows for each in row])
    for values in np.random.default_rng(0).uniform(0.2, 2.0, (5, 3)):
        found = np.reshape(evaluate(program, values.tolist()), (-1, 3))
        for k, step in enumerate(1e-6 * np.eye(3)):
            expected = (np.array(formula(values + step)) - formula(values - step)) / 2e-6
            np.testing.assert_allclose(found[:, k], expected, atol=1e-8)


def test_jacobian_of_other_operations_is_rejected() -> None:
    x, y = Graph().inputs(2)
    with pytest.raises(ValueError, match=r"the operation is 'sin', expected \+, -, \* or negative"):
        jacobian([x * np.sin(np.array([y], dtype=object))[0]], [x, y])
