"""The command `lipserve doctor`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.table import Table

from lipserve.address import url_of
from service.cli import connecting
from service.cli.connecting import connected
from service.cli.consoles import note, out, plain, print_json
from service.cli.doctor import clocks, processor, resources
from service.cli.doctor.findings import Finding, System
from service.cli.options import Json, alone, settings_of
from service.foundation.text import percent
from service.runtime.realtime import RealTime, probe_real_time

if TYPE_CHECKING:
    from service.cli.doctor.loops import Loop, Policy

app = alone()
COLOURS = {"ok": "green", "warning": "yellow", "unknown": "dim"}


@app.command()
def doctor(
    url: Annotated[
        str | None,
        typer.Option("--url", help="Also measure a running service at this address: its echo. Default: no service."),
    ] = None,
    model: Annotated[
        str | None,
        typer.Option(help="Also measure the torque stream of this model.", autocompletion=connecting.models),
    ] = None,
    seconds: Annotated[
        float,
        typer.Option(
            min=0.05,
            max=600,
            help="Duration of each of the 4 to 16 measured loops, s. With less than 1000 ticks, one late tick fails a "
            "rate: for 100 Hz, measure 10 s.",
        ),
    ] = 3.0,
    as_json: Json = False,
) -> None:
    """Show what this machine permits, and measure the loop rate that it holds.

    Measures how late a thread wakes up at 100, 250, 500 and 1000 Hz, at plain priority and, if permitted, with
    SCHED_FIFO. With --url or --model, it also measures how late answers of a service arrive in the Python client. All
    delays count from the time when a tick was due. The machine holds a rate if 99.9 % of the wake-ups come within
    half a period, or 99.9 % of the answers within one period.

    Each line has a verdict; warnings say what to do. Run it as the user, and in the container, of the service.
    """
    system, settings = System(), settings_of()
    granted = probe_real_time()
    service = None if url is None and model is None else url_of(url)
    if service is not None:
        with connected(service) as client:  # fail before anything is measured
            client.health() if model is None else client.model(model)
    findings = [
        *processor.processor(system),
        *processor.priorities(system, granted),
        *clocks.clocks(system),
        *resources.memory(system, granted.pages_locked),
        resources.open_files(settings.max_connections),
        *resources.disk(system, settings),
    ]
    if not as_json:
        _print_findings(findings)
    times, offset = processor.cpu_times(system), clocks.date_offset()
    loops = list(_loops(granted, service, model, seconds))
    meanwhile = [
        *processor.load(times, processor.cpu_times(system)),
        clocks.step(clocks.date_offset() - offset),
        *_rates(loops),
    ]
    if as_json:
        print_json(
            {
                "findings": [each._asdict() for each in [*findings, *meanwhile]],
                "real_time": plain(granted),
                "loops": [{**plain(each), "verdict": _verdict(each)} for each in loops],
            }
        )
        return
    _print_loops(loops)
    _print_findings(meanwhile)


def _loops(granted: RealTime, service: str | None, model: str | None, seconds: float) -> Iterator[Loop]:
    """Measure all loops. service: address, None for no service."""
    import numpy as np  # noqa: PLC0415 - slow imports, not needed for help

    from service.cli.answers import random_motions  # noqa: PLC0415
    from service.cli.doctor.loops import RATES_HZ, EchoClient, answers, wake_ups  # noqa: PLC0415

    policies: list[Policy] = ["plain", "SCHED_FIFO"] if granted.policy == "fifo" else ["plain"]
    rates = f"{', '.join(map(str, RATES_HZ))} Hz, {seconds:g} s each"
    note(f"measuring wake-ups at {rates}")
    for policy in policies:
        yield from wake_ups(policy, seconds)
    if service is None:
        return
    note(f"measuring answers of {service}")
    best = policies[-1]
    with connected(service) as client:
        motions = np.zeros((1, 3, JOINTS)) if model is None else random_motions(client, model, MOTIONS)[1]
        yield from answers("echo", best, seconds, lambda: EchoClient("echo", service, timeout=TIMEOUT_S), motions)
        if model is not None:
            yield from answers("torque", best, seconds, lambda: client.stream(model, timeout=TIMEOUT_S), motions)


JOINTS, MOTIONS = 7, 1000
"""Joints of an echoed query if no model is given, and number of different motions."""
TIMEOUT_S = 10.0
"""Time after which a missing answer is an error, s."""


def _rates(loops: Sequence[Loop]) -> Iterator[Finding]:
    """Yield the highest rate that each kind of loop held."""
    from service.cli.doctor.loops import RATES_HZ, highest_rate  # noqa: PLC0415 - as above

    for (what, policy), kind in groupby(loops, lambda each: (each.what, each.policy)):
        name, rate = f"{what}, {policy}", highest_rate(list(kind))
        if rate == max(RATES_HZ):
            yield Finding(RATE, name, f"{rate} Hz, the highest that was measured")
        else:
            value = f"none of {', '.join(map(str, RATES_HZ))} Hz" if rate is None else f"{rate} Hz"
            yield Finding(RATE, name, value, "warning", ADVICE[what, policy])


RATE = "Highest loop rate"
IN_PROCESS = "Or load the model in the controller's process, or export C (docs/control-loop.md)."
SLOW_SERVICE = "The service or the network is late, not the model. Stop other work on the service's machine. "
ADVICE: dict[tuple[str, Policy], str] = {
    ("wake-up", "plain"): "Permit SCHED_FIFO, and run the controller with it (`chrt -f 20 …`).",
    ("wake-up", "SCHED_FIFO"): "No controller on this machine is faster. Follow the warnings, or use a slower loop.",
    **{("echo", policy): SLOW_SERVICE + IN_PROCESS for policy in ("plain", "SCHED_FIFO")},
    **{
        ("torque", policy): f"If the echo is faster, use a smaller model. {IN_PROCESS}"
        for policy in ("plain", "SCHED_FIFO")
    },
}


def _verdict(loop: Loop) -> str:
    return "ok" if loop.is_held else "warning"


def _print_findings(findings: Sequence[Finding]) -> None:
    wide = max(len(each.name) for each in findings)
    for part, lines in groupby(findings, lambda each: each.part):
        out.print(f"[bold]{escape(part)}[/bold]", highlight=False)
        for each in lines:
            verdict = f"[{COLOURS[each.verdict]}]{each.verdict:7}[/{COLOURS[each.verdict]}]"
            out.print(f"  {verdict}  {escape(f'{each.name:{wide}}  {each.value}')}", highlight=False)
            if each.advice:
                out.print(f"{'':11}{escape(each.advice)}", highlight=False)


def _print_loops(loops: Sequence[Loop]) -> None:
    table = Table("verdict", "loop", "policy", "Hz", "ticks", "p50 µs", "p99", "p99.9", "max", "in time")
    for each in loops:
        verdict, values = _verdict(each), (each.p50_us, each.p99_us, each.p999_us, each.max_us)
        table.add_row(
            f"[{COLOURS[verdict]}]{verdict}[/{COLOURS[verdict]}]",
            *(each.what, each.policy, str(each.rate_hz), str(each.ticks)),
            *(f"{value:.0f}" for value in values),
            percent(each.in_time, 2),
        )
    out.print(table)
