"""C statements of a function, from a program of single operations."""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from lipcore.data.samples import Array
from lipcore.kernels.geometry import Geometry
from lipcore.kernels.graph import Graph, Number, Program
from lipcore.kernels.joint_frame_features import features
from lipcore.kernels.joint_frames import links_of, torque

QUERY = ("q", "dq", "ddq", "sine", "cosine")
"""Fields of `query_t` that torque depends on."""
LONGEST = 300
"""Length above which an expression becomes a statement of its own, characters."""
PAYLOAD = 10


@dataclass(frozen=True)
class BodiesProgram:
    """The torque of bodies, and its derivatives, as statements."""

    torque: str
    """Statements of `write_torque`."""
    features: str
    """Statements of `write_features`."""
    weights: Array
    """T, (10 n + g, b): the numbers that the features belong to are Tᵀ times changes of bodies and geometry."""
    first: list[int]
    """The first feature of each joint that is not zero, (n,)."""

    @classmethod
    def of(cls, geometry: Geometry, step: Array, bodies: Array, change: Array) -> BodiesProgram:
        """Return the program of an arm; for the arguments see `joint_frames.links_of`. A fixed geometry has no step."""
        n, graph = geometry.n_joints, Graph()
        q, dq, ddq, *turn = (graph.inputs(n) for _ in QUERY)
        more = graph.inputs(PAYLOAD)
        found = torque(links_of(geometry, step, bodies, change), q, dq, ddq, turn, more)
        results = {f"load[{j}]": each.value for j, each in enumerate(found)}
        results |= {f"tau[{j}]": each.value + each.change for j, each in enumerate(found)}
        rows, weights, first = features(geometry, bodies, len(step) > 0, q, dq, ddq, turn, more)
        texts = [*_query_texts(n), *(f"more[{k}]" for k in range(PAYLOAD))]
        rest = {f"rest[{j}][{c}]": row[c] for j, row in enumerate(rows) for c in range(first[j], len(row))}
        return cls(_statements(results, texts), _statements(results | rest, texts), weights, first)


def others_statements(arms: Iterable[tuple[Geometry, Array]]) -> str:
    """Return the statements of `write_others`, given the geometry and the bodies, (n, 10), of each arm."""
    results: dict[str, Number] = {}
    graph, texts = Graph(), list[str]()
    for k, (geometry, bodies) in enumerate(arms):
        if not texts:
            texts = _query_texts(geometry.n_joints)
            q, dq, ddq, *turn = (graph.inputs(geometry.n_joints) for _ in QUERY)
        links = links_of(geometry, np.zeros(0), bodies, np.zeros_like(bodies))
        for j, each in enumerate(torque(links, q, dq, ddq, turn)):
            results[f"tau[{k}][{j}]"] = each.value
    return _statements(results, texts)


def _query_texts(n: int) -> list[str]:
    return [f"x->{name}[{j}]" for name in QUERY for j in range(n)]


def _statements(results: dict[str, Number], inputs: Sequence[str]) -> str:
    """Return statements that assign the results by name. Operations used once become parts of expressions."""
    program = Program.of(list(results.values()))
    inputs = [*inputs, *[""] * (program.inputs - len(inputs))]  # those that no result needs
    uses = Counter(place for each in program.operations for place in each.arguments)
    uses.update(program.results)
    texts, lines, first = [*inputs, *map(repr, program.constants)], list[str](), len(inputs) + len(program.constants)
    for k, operation in enumerate(program.operations):
        one, *other = (texts[place] for place in operation.arguments)
        text = f"{one} {operation.name} {other[0]}" if other else f"-{one}"
        if uses[first + k] > 1 or len(text) > LONGEST:
            lines.append(f"const double x{k} = {text};")
            texts.append(f"x{k}")
        else:
            texts.append(f"({text})")
    lines += [f"{name} = {texts[place]};" for name, place in zip(results, program.results, strict=True)]
    return "".join(
        textwrap.fill(line, 118, initial_indent="    ", subsequent_indent="        ", break_on_hyphens=False) + "\n"
        for line in lines
    )
