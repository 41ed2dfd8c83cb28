"""Tables of the benchmark of learning."""

from __future__ import annotations

from benchmarks.latency.table import NOTHING, Grid, targets_grid
from benchmarks.online.flow import Flow
from benchmarks.online.results import Results
from benchmarks.online.targets import targets
from benchmarks.timing import Timing


def grids(results: Results) -> list[Grid]:
    """Return all tables with rows, in order."""
    found = [
        Grid("machine", ("", ""), list(results.facts.items()), texts=True),
        Grid("model", ("", ""), list(results.model.items()), texts=True),
        latencies(results),
        flows(results),
        costs(results),
        quality(results),
        *joints(results),
        targets_grid(targets(results), ""),
    ]
    return [grid for grid in found if grid.rows]


def latencies(results: Results) -> Grid:
    """Return percentiles of answers, idle and while the model learns."""
    rows = []
    states = {"idle": results.idle, "learning": results.learning, "pushed": results.pushed}
    for state, asked in states.items():
        if asked is not None:
            rows += [
                _timing(f"answer, {state}", asked.answers),
                _timing(f"from the tick, {state}", asked.ticks),
                _timing(f"echo, {state}", asked.echo),
            ]
    for state, asked in states.items():
        if asked is not None and results.idle is not None and asked is not results.idle:
            rows += [
                _ratios(f"answer, {state} / idle", asked.answers, results.idle.answers),
                _ratios(f"echo, {state} / idle", asked.echo, results.idle.echo),
            ]
    columns = ("500 Hz WebSocket loop, µs", "answers", "p50", "p90", "p99", "p99.9", "largest")
    return Grid("prediction while the model learns 1000 rows a second, and pushed rows", columns, rows)


def flows(results: Results) -> Grid:
    """Return throughput of acknowledgements and learning."""
    columns = ("rows", "sent", "accepted", "acked/s", "learnt/s", "ack p50 ms", "p99", "lag p50 s", "p99", "largest")
    named = (("in real time", results.live), ("as fast as possible", results.burst))
    rows = [_flow(name, flow) for name, flow in named if flow is not None]
    return Grid("learning; lag: from an acknowledgement to the first answer that contains it", columns, rows)


def costs(results: Results) -> Grid:
    """Return the cost of a sample after few and after many."""
    if not results.costs:
        return Grid("", (), [])
    first = results.costs[0]
    rows = []
    for each in results.costs:
        ratio, rate = each.learn / first.learn, 1e6 / each.learn
        figures = (f"{each.learn:,.0f}", f"{ratio:.2f}", f"{rate:,.0f}", f"{each.solve:,.0f}")
        rows.append((f"{each.samples:,}", *figures))
    columns = ("samples seen", "µs a sample", "ratio", "samples/s", "new revision ms")
    return Grid("cost of an update, in this process on one core", columns, rows)


def quality(results: Results) -> Grid:
    """Return mean nMSE and coverage of every method at every moment."""
    rows = []
    for method in results.methods.values():
        found = [method.found[name] for name in results.moments]
        seconds = ", ".join(f"{each:.0f}" for each in method.seconds) or NOTHING
        cells = [f"{each.mean_nmse:.2e} ({100 * each.mean_coverage:.0f} %)" for each in found]
        rows.append((method.label, *cells, seconds))
    columns = ("", *results.moments, "training s")
    return Grid("mean nMSE on a test trajectory (coverage of 95 %)", columns, rows)


def joints(results: Results) -> list[Grid]:
    """Return nMSE of every joint, a table for each moment, and coverage at the last moment."""
    columns = ("", *(str(number) for number in range(1, len(results.joints) + 1)))
    tables = []
    for name in results.moments:
        rows = [(each.label, *(f"{value:.1e}" for value in each.found[name].nmse)) for each in results.methods.values()]
        tables.append(Grid(f"nMSE of joints 1 to {len(results.joints)}, {name}", columns, rows))
    for name in results.moments[-1:]:
        rows = [
            (each.label, *(f"{100 * value:.0f}" for value in each.found[name].coverage))
            for each in results.methods.values()
        ]
        tables.append(Grid(f"coverage of 95 % in %, {name}", columns, rows))
    return tables


def _timing(name: str, timing: Timing) -> tuple[str, ...]:
    figures = (timing.p50, timing.p90, timing.p99, timing.p999, timing.largest)
    return (name, f"{timing.count:,}", *(f"{value:,.0f}" for value in figures))


def _ratios(name: str, above: Timing, below: Timing) -> tuple[str, ...]:
    names = ("p50", "p90", "p99", "p999", "largest")
    return (name, "", *(f"{getattr(above, each) / getattr(below, each):.2f}" for each in names))


def _flow(name: str, flow: Flow) -> tuple[str, ...]:
    lag = (NOTHING,) * 3 if flow.lag is None else tuple(f"{value:.2f}" for value in flow.lag)
    rates = tuple(f"{value:,.0f}" for value in (flow.acknowledged, flow.learnt))
    return (name, f"{flow.rows:,}", f"{flow.accepted:,}", *rates, *(f"{value:.1f}" for value in flow.ack[:2]), *lag)
