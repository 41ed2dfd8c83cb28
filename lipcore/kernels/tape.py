"""A program of single operations, laid out to run for many queries at once."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from lipcore.data.motion import Indices
from lipcore.data.samples import Array
from lipcore.kernels.fast import tape
from lipcore.kernels.graph import Operation, Program

CODES = {"+": tape.ADD, "-": tape.SUBTRACT, "*": tape.MULTIPLY, "negative": tape.NEGATE}


@dataclass(frozen=True)
class Tape:
    """A program of sums, differences and products, laid out for `fast.tape.run`. It is immutable."""

    codes: Indices
    """(K, 5), see `fast.tape.run`."""
    factors: Array
    """Constants."""
    results: Indices
    """Rows of the results, (R,)."""
    inputs: int
    """Number of inputs."""
    rows: int
    """Number of rows of the memory."""

    @classmethod
    def of(cls, program: Program) -> Tape:
        """Lay out a program.

        A product that is used once, in a sum, becomes part of the sum. A row of memory is used again when its number
        is no longer needed.
        """
        first = program.inputs + len(program.constants)
        steps = _fused(program, first)
        last = {place: len(steps) for place in program.results}
        for k, (_, _, places) in reversed(list(enumerate(steps))):
            for place in places:
                last.setdefault(place, k)
        rows, free, count = {place: place for place in range(program.inputs)}, list[int](), program.inputs
        codes = []
        for k, (code, target, places) in enumerate(steps):
            at = [place - program.inputs if place in range(program.inputs, first) else rows[place] for place in places]
            free += [rows.pop(place) for place in set(places) if last[place] == k and place in rows]
            if not free:
                free, count = [count], count + 1
            rows[target] = free.pop()
            codes.append([code, rows[target], *at, *[0] * (3 - len(at))])
        results = np.array([rows[place] for place in program.results], np.int64)
        factors = np.array([*program.constants, 0.0])
        return cls(np.array(codes, np.int64).reshape(-1, 5), factors, results, program.inputs, count)

    def __call__(self, inputs: Array) -> Array:
        """Return the results for N queries, (R, N). inputs: (I, N)."""
        count = inputs.shape[1]
        padded = np.pad(inputs, ((0, 0), (0, -count % tape.BLOCK)))
        out = np.empty((len(self.results), padded.shape[1]))
        memory = np.empty(self.rows * tape.BLOCK)
        tape.run(self.codes, self.factors, padded, self.results, memory, out)
        return out[:, :count]


def _fused(program: Program, first: int) -> list[tuple[int, int, tuple[int, ...]]]:
    """Return code, place of the result and places of x, y and z of each step. first: place of the first operation."""
    uses = Counter(place for each in program.operations for place in each.arguments)
    uses.update(program.results)
    constants = range(program.inputs, first)
    made: dict[int, Operation] = {first + k: each for k, each in enumerate(program.operations)}
    steps, gone = list[tuple[int, int, tuple[int, ...]]](), set[int]()
    for target, each in made.items():
        for side, place in enumerate(each.arguments):
            left = each.arguments[1 - side] if len(each.arguments) == 2 else place
            product = made.get(place)
            if each.name in "+-" and product and product.name == "*" and uses[place] == 1 and left not in constants:
                code = tape.MULTIPLY_ADD if each.name == "+" else (tape.MULTIPLY_SUBTRACT, tape.SUBTRACT_PRODUCT)[side]
                steps.append(_step(code, target, (*product.arguments, left), constants))
                gone.add(place)
                break
        else:
            steps.append(_step(CODES[each.name], target, each.arguments, constants))
    return [each for each in steps if each[1] not in gone]


def _step(code: int, target: int, places: tuple[int, ...], constants: range) -> tuple[int, int, tuple[int, ...]]:
    """Return a step. If one of x and y is a constant, it becomes y."""
    if len(places) > 1 and places[0] in constants:
        code = tape.SUBTRACT_FROM if code == tape.SUBTRACT else code
        places = (places[1], places[0], *places[2:])
    if len(places) > 1 and places[1] in constants and code < tape.FIXED:
        code += tape.FIXED
    return code, target, places
