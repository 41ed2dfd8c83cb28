"""`lipserve stream`: a motion played to a model in real time."""

from __future__ import annotations

import secrets
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from lipserve.address import DEFAULT_URL
from service.cli.connecting import connected
from service.cli.consoles import INTERRUPTED, CommandError, Explained, echo, note, out, print_error, print_json
from service.cli.options import (
    ROBOTS,
    Alias,
    Along,
    Coulomb,
    DirtShare,
    Fast,
    Json,
    Mass,
    MassAt,
    Model,
    Noise,
    Range,
    Seed,
    Sinusoids,
    Url,
    Version,
    Viscous,
    alone,
    simulation,
)
from service.foundation.text import counted, percent

if TYPE_CHECKING:
    from lipserve import Client, StreamClient
    from service.cli.playing import Motion, Tally

app = alone()


@app.command()
def stream(
    model: Model,
    file: Annotated[
        Path | None, typer.Argument(help="A recording with times, q, dq, ddq and tau, or from which these are derived.")
    ] = None,
    simulate: Annotated[
        str | None, typer.Option(help="Play a simulated robot instead, such as panda.", autocompletion=lambda: ROBOTS)
    ] = None,
    learn: Annotated[
        bool,
        typer.Option("--learn", help="Also send the measured torque, for the model to learn from after it answered."),
    ] = False,
    yes_learn: Annotated[
        bool,
        typer.Option(
            "--yes-learn", help="With --learn: learn from the stream even if its first second does not fit the model."
        ),
    ] = False,
    seconds: Annotated[
        float | None, typer.Option(min=0.1, help="How long: all of a recording, 60 of a simulation by default.")
    ] = None,
    deadline: Annotated[
        float | None,
        typer.Option(
            min=0,
            help="ms after which an answer is late by the service's clock, and received late by this one; one step of "
            "the motion by default.",
        ),
    ] = None,
    stream_id: Annotated[
        str | None, typer.Option(help="Name of the source of the torques; a new one by default.")
    ] = None,
    version: Version = None,
    alias: Alias = None,
    rate: Annotated[float, simulation("Hz.", min=1, max=2000)] = 100.0,
    seed: Seed = 0,
    sinusoids: Sinusoids = 50,
    motion: Range = "middle",
    course: Along = "sinusoids",
    fast: Fast = False,
    noise: Noise = 0.01,
    viscous: Viscous = 0.0,
    coulomb: Coulomb = 0.0,
    payload: Mass = 0.0,
    payload_at: MassAt = 0.0,
    dirt: DirtShare = 0.0,
    url: Url = DEFAULT_URL,
    as_json: Json = False,
) -> None:
    """Play a motion to a model over its WebSocket in real time, and compare its answers with the measured torque.

    One line a second, then figures of the whole. Each answer is given before its row is learnt. A stream whose first
    second lies outside the model's band is not learnt until that is confirmed. Ctrl-C ends it.
    """
    # takes long to import; help needs none of it
    from service.cli.playing import Stop, Tally, play, recorded, simulated  # noqa: PLC0415
    from service.cli.simulate import described  # noqa: PLC0415

    if (file is None) == (simulate is None):
        raise CommandError(
            "expected either a recording or --simulate ROBOT", f"`lipserve stream {model} --simulate panda`"
        )
    if file is not None:
        if not file.is_file():
            raise CommandError(f"file is {str(file)!r}, expected a recording")
        played = recorded(file, seconds)
    else:
        samples = max(2, round((seconds or 60.0) * rate))
        asked = described(
            samples, rate, sinusoids, motion, course, fast, noise, viscous, coulomb, payload, payload_at, dirt
        )
        played = simulated(simulate or "", asked, seed)
    source = (stream_id or f"lipserve-{secrets.token_hex(4)}") if learn else None
    with (
        Stop().listening() as stop,
        connected(url) as client,
        client.stream(model, version=version, alias=alias, stream_id=source, scale=True, timeout=10.0) as opened,
    ):
        played = _fitting(played, opened)
        step = played.step if deadline is None else deadline / 1e3
        _announce(played, opened, source)
        doubt = Doubt(client, model, source, yes_learn)

        def each_second(second: int, part: Tally) -> None:
            _print_second(second, part, opened, learn, as_json)
            doubt.look(second, part, opened)

        total = Tally(opened.hello.noise_std)
        try:
            play(opened, played, learn, step, stop, each_second, total)
            if learn:
                opened.flush()
                doubt.decide(opened)
        finally:  # also of a stream that the service has closed
            _print_all(total, opened, learn, as_json)
    if stop.asked:
        raise typer.Exit(INTERRUPTED)
    if doubt.held:
        raise typer.Exit(1)


class Doubt:
    """Says loudly that a stream does not fit its model, once, and confirms that it is to be learnt where that is asked.

    source: name of the stream that teaches, None where it does not; held: whether it is not learnt for that reason.
    """

    def __init__(self, client: Client, model: str, source: str | None, confirmed: bool) -> None:
        self._client, self._model, self._source, self._confirmed = client, model, source, confirmed
        self._told, self._looks, self.held = False, 0, False

    def look(self, second: int, part: Tally, stream: StreamClient) -> None:
        """Look at a second that has ended: at the answers of the first, and at what became of the torques."""
        if self._source is not None:
            self.decide(stream)
        elif second == 1 and part.opening(1.0).is_misfit:
            share = percent(part.opening(1.0).coverage.mean())
            print_error(Explained(f"only {share} of the first second lies within the 95 % band of the model", CHECK))

    def decide(self, stream: StreamClient) -> None:
        """Say that learning is held for how the stream began; confirm that it is meant where that was asked for."""
        if self._looks:
            self._looks -= not self._own()
        if self._told or not stream.learnt.rejected.get("change"):
            return
        held = self._client.learning(self._model).status.held
        if held is None:
            return
        self._told = True
        evidence = held.evidence
        if evidence.get("stream_id") != self._source or evidence.get("kind") != "opening":
            self.held, self._looks = True, 3  # seconds in which the stream's own alarm is looked for
            hint = f"`lipserve alarms {self._model}` tells why; `lipserve learning decide {self._model} …` ends it"
            print_error(Explained(f"learning of {self._model} is held: rows are kept, and not learnt", hint))
            return
        share = percent(evidence["coverage"])
        text = f"only {share} of the stream's first second lies within the 95 % band of {self._model}"
        if self._confirmed:
            decided = self._client.decide(self._model, "ignore", replay=True)
            note(
                f"careful: {text}; it is learnt all the same, as --yes-learn says: "
                f"{counted(decided.rows, 'row')} that waited"
            )
            return
        self.held = True
        hint = (
            f"{CHECK}. If it is meant: `lipserve learning decide {self._model} ignore --replay`, or --yes-learn next "
            f"time; `lipserve learning decide {self._model} adapt --replay` if the robot has changed"
        )
        print_error(Explained(f"{text}: nothing of it is learnt", hint))

    def _own(self) -> bool:
        """Whether the service says that this stream does not fit either, while learning is held; then say so."""
        alarms = islice(self._client.alarms(self._model), 20)
        own = (each.evidence for each in alarms if each.evidence.get("stream_id") == self._source)
        evidence = next((each for each in own if each.get("kind") == "opening"), None)
        if evidence is None:
            return False
        self._looks = 0
        share = percent(evidence["coverage"])
        text = f"only {share} of this stream's first second lies within the 95 % band of {self._model}, too"
        print_error(Explained(text, CHECK))
        return True


CHECK = "check that it is this robot, with the friction, the payload and the units that were learnt"


def _fitting(motion: Motion, stream: StreamClient) -> Motion:
    """The motion as the model takes it; what does not fit is refused or said."""
    hello = stream.hello
    if motion.torque_convention != hello.torque_convention:
        raise CommandError(
            f"the torque of the motion is {motion.torque_convention}, expected that of the model: "
            f"{hello.torque_convention}"
        )
    fitting, named = motion.ordered(hello.joint_names)
    if not named:
        note(
            f"careful: the motion's joints {', '.join(motion.joint_names)} are taken, in this order, for the model's "
            f"{', '.join(hello.joint_names)}"
        )
    return fitting


def _announce(motion: Motion, stream: StreamClient, source: str | None) -> None:
    hello, taught = stream.hello, "" if source is None else f", which it learns from as stream {source}"
    length = f"{counted(len(motion), 'row')} in {motion.t[-1] - motion.t[0]:.3g} s ({1 / motion.step:.4g} Hz)"
    note(f"{length} to {hello.model} version {hello.version}{taught}")


def _print_second(second: int, part: Tally, stream: StreamClient, learn: bool, as_json: bool) -> None:
    from service.cli.playing import learnt_figures  # noqa: PLC0415 - as above

    figures = {"second": second, **part.figures(), "version": stream.hello.version}
    if learn:
        figures["learnt"] = learnt_figures(stream.learnt)
    if as_json:
        print_json(figures, one_line=True)
    else:
        echo(f"{second:4d} s  {_line(figures)}")


def _print_all(total: Tally, stream: StreamClient, learn: bool, as_json: bool) -> None:
    from service.cli.playing import learnt_figures, refused_figures  # noqa: PLC0415 - as above

    figures = {**total.figures(), "joints": total.joints(stream.hello.joint_names)}
    if learn:
        figures["learnt"] = learnt_figures(stream.learnt)
        figures["not_logged"] = refused_figures(stream.refusals)
    if as_json:
        print_json({"summary": figures}, one_line=True)
        return
    if figures["joints"]:
        title = "answers against measured torque" + (", each given before its row was learnt" if learn else "")
        table = Table("joint", "nMSE", "RMSE N·m", "coverage of 95 %", title=title)
        for each in figures["joints"]:
            nmse = "-" if each["nmse"] is None else f"{each['nmse']:.2e}"
            table.add_row(each["joint"], nmse, f"{each['rmse']:.4f}", percent(each["coverage"], 1))
        out.print(table)
    echo(f"in all  {_line(figures)}")
    for each in figures.get("not_logged", ()):
        note(f"rows {each['first']} to {each['through']} were not logged: {each['message']} ({each['code']})")


def _line(figures: dict[str, Any]) -> str:
    """Figures of a second, or of all, on one line."""
    parts = [counted(figures["rows"], "row")]
    if figures["rows"]:
        trip = figures["round_trip_ms"]
        parts += [
            f"round trip p50 {trip['p50']:.2f} ms, p99 {trip['p99']:.2f} ms",
            f"{figures['late']} late, {figures['received_late']} received late",
            f"error {figures['rmse']:.4f} N·m, {percent(figures['coverage'], 1)} in the 95 % band",
        ]
    if figures["behind_s"] > 0.1:
        parts.append(f"{figures['behind_s']:.1f} s behind")
    if figures["refused"]:
        parts.append("refused " + _counts(figures["refused"]))
    if "learnt" in figures:
        learnt = figures["learnt"]
        parts.append(f"learnt {learnt['accepted']}")
        if learnt["kept_out"]:
            parts.append("kept out " + _counts(learnt["kept_out"]))
    return "; ".join(parts)


def _counts(counts: dict[str, int]) -> str:
    return ", ".join(f"{count} {code}" for code, count in counts.items())
