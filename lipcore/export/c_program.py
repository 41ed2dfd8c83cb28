"""A program of single operations as C: the statements of a function."""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Iterable, Sequence

import numpy as np

from lipcore.data.samples import Array
from lipcore.kernels.geometry import Geometry
from lipcore.kernels.graph import Graph, Number, Program
from lipcore.kernels.joint_frames import links_of, torque

QUERY = ("q", "dq", "ddq", "sine", "cosine")
"""Fields of `query_t` that torque depends on."""
LONGEST = 300
"""Characters of an expression from which it is a statement of its own."""
PAYLOAD = 10


def bodies_statements(geometry: Geometry, step: Array, bodies: Array, change: Array) -> str:
    """Return the statements of `write_out`: see `joint_frames.links_of`."""
    n, graph = geometry.n_joints, Graph()
    q, dq, ddq, *turn = (graph.inputs(n) for _ in QUERY)
    torques = torque(*links_of(geometry, step, bodies, change), q, dq, ddq, turn, graph.inputs(PAYLOAD))
    texts = [*_query_texts(n), *(f"more[{k}]" for k in range(PAYLOAD))]
    results = {f"load[{j}]": each.value for j, each in enumerate(torques)}
    results |= {f"tau[{j}]": each.value + each.change for j, each in enumerate(torques)}
    return _statements(results, texts)


def others_statements(arms: Iterable[tuple[Geometry, Array]]) -> str:
    """Return the statements of `write_others`, given the geometry and the bodies, (n, 10), of each arm."""
    results: dict[str, Number] = {}
    graph, texts = Graph(), list[str]()
    for k, (geometry, bodies) in enumerate(arms):
        if not texts:
            texts = _query_texts(geometry.n_joints)
            q, dq, ddq, *turn = (graph.inputs(geometry.n_joints) for _ in QUERY)
        links = links_of(geometry, np.zeros(0), bodies, np.zeros_like(bodies))
        for j, each in enumerate(torque(*links, q, dq, ddq, turn)):
            results[f"tau[{k}][{j}]"] = each.value
    return _statements(results, texts)


def _query_texts(n: int) -> list[str]:
    return [f"x->{name}[{j}]" for name in QUERY for j in range(n)]


def _statements(results: dict[str, Number], inputs: Sequence[str]) -> str:
    """Return statements that assign the results by name. Operations that are used once are parts of expressions."""
    program = Program.of(list(results.values()))
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
