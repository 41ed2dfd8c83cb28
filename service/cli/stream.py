"""`lipserve stream`: play a motion to a model in real time."""

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
    Along,
    Coulomb,
    DirtShare,
    DriveName,
    Fast,
    Json,
    Mass,
    MassAt,
    ModelVersion,
    Noise,
    Range,
    Seed,
    Sinusoids,
    Url,
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
    model: ModelVersion,
    file: Annotated[
        Path | None,
        typer.Argument(help="Recording with times, q and tau; dq and ddq are derived if they are missing."),
    ] = None,
    simulate: Annotated[
        str | None, typer.Option(help="Play a simulated robot instead, e.g. panda.", autocompletion=lambda: ROBOTS)
    ] = None,
    learn: Annotated[
        bool,
        typer.Option("--learn", help="Also send the measured torque; the model learns from it after its answer."),
    ] = False,
    yes_learn: Annotated[
        bool,
        typer.Option(
            "--yes-learn", help="With --learn: learn even if the first second of the stream does not fit the model."
        ),
    ] = False,
    seconds: Annotated[
        float | None,
        typer.Option(min=0.1, help="Duration, s. Default: the whole recording, or 60 s of simulation."),
    ] = None,
    deadline: Annotated[
        float | None,
        typer.Option(
            min=0,
            help="Deadline of an answer, ms. An answer is `late` if it misses the deadline by the service's clock, and "
            "`received late` if it misses it by this machine's clock. "
            "Default: one step of the motion.",
        ),
    ] = None,
    stream_id: Annotated[
        str | None, typer.Option(help="Name of the stream that the torques belong to. Default: a new name.")
    ] = None,
    rate: Annotated[float, simulation("Sample rate, Hz.", min=1, max=2000)] = 100.0,
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
    drive: DriveName = "lugre",
    url: Url = DEFAULT_URL,
    as_json: Json = False,
) -> None:
    """Play a motion to a model over a WebSocket in real time and compare its answers with the measured torque.

    Prints one line per second, then a summary. Each answer is computed before the model learns from its row. If the
    first second does not fit the model, learning is paused until you confirm it. Ctrl-C stops the stream.
    """
    # slow imports, not needed for help
    from service.cli.playing import Stop, Tally, play, recorded, simulated  # noqa: PLC0415
    from service.cli.simulate import described  # noqa: PLC0415

    if (file is None) == (simulate is None):
        raise CommandError("give either a recording or --simulate ROBOT", f"`lipserve stream {model} --simulate panda`")
    if file is not None:
        if not file.is_file():
            raise CommandError(f"the recording {str(file)!r} does not exist")
        played = recorded(file, seconds)
    else:
        samples = max(2, round((seconds or 60.0) * rate))
        asked = described(
            samples, rate, sinusoids, motion, course, fast, noise, viscous, coulomb, payload, payload_at, dirt, drive
        )
        played = simulated(simulate or "", asked, seed)
    source = (stream_id or f"lipserve-{secrets.token_hex(4)}") if learn else None
    with (
        Stop().listening() as stop,
        connected(url) as client,
        client.stream(model, stream_id=source, scale=True, timeout=10.0) as opened,
    ):
        played = _fitting(played, opened)
        step = played.step if deadline is None else deadline / 1e3
        _announce(played, opened, source)
        misfit = MisfitMonitor(client, opened.hello.model, source, yes_learn)

        def each_second(second: int, part: Tally) -> None:
            _print_second(second, part, opened, learn, as_json)
            misfit.check_second(second, part, opened)

        total = Tally(opened.hello.noise_std)
        try:
            play(opened, played, learn, step, stop, each_second, total)
            if learn:
                opened.flush()
                misfit.report_pause(opened)
        finally:  # also if the service has closed the stream
            _print_all(total, opened, learn, as_json)
    if stop.asked:
        raise typer.Exit(INTERRUPTED)
    if misfit.paused:
        raise typer.Exit(1)


class MisfitMonitor:
    """Reports once that a stream does not fit its model; confirms learning if the user asked for that.

    source: stream_id if the model learns from the stream, else None; paused: learning stopped because of a misfit.
    """

    def __init__(self, client: Client, model: str, source: str | None, confirmed: bool) -> None:
        self._client, self._model, self._source, self._confirmed = client, model, source, confirmed
        self._reported, self._checks_left, self.paused = False, 0, False

    def check_second(self, second: int, part: Tally, stream: StreamClient) -> None:
        """Check a second that has ended: the answers of the first one, or whether learning was paused."""
        if self._source is not None:
            self.report_pause(stream)
        elif second == 1 and part.opening(1.0).is_misfit:
            share = percent(part.opening(1.0).coverage.mean())
            print_error(Explained(f"only {share} of the first second is inside the model's 95 % interval", CHECK))

    def report_pause(self, stream: StreamClient) -> None:
        """Report that learning is paused because of the stream's first second, or confirm it with --yes-learn."""
        if self._checks_left and not self._report_own_misfit():
            self._checks_left -= 1
        if self._reported or not stream.learnt.rejected.get("change"):
            return
        held = self._client.learning(self._model).status.held
        if held is None:
            return
        self._reported = True
        evidence = held.evidence
        if evidence.get("stream_id") != self._source or evidence.get("kind") != "opening":
            self.paused, self._checks_left = True, 3  # seconds in which the stream's own alarm may still come
            hint = f"`lipserve alarms {self._model}` shows why; `lipserve learning decide {self._model} …` resumes it"
            print_error(Explained(f"learning of {self._model} is paused: rows are stored but not learnt", hint))
            return
        share = percent(evidence["coverage"])
        text = f"only {share} of the stream's first second is inside the 95 % interval of {self._model}"
        if self._confirmed:
            decided = self._client.decide(self._model, "ignore", replay=True)
            note(f"warning: {text}; learning anyway (--yes-learn), from {counted(decided.rows, 'stored row')}")
            return
        self.paused = True
        hint = (
            f"{CHECK}. To learn anyway: `lipserve learning decide {self._model} ignore --replay`, or --yes-learn next "
            f"time. If the robot has changed: `lipserve learning decide {self._model} adapt --replay`"
        )
        print_error(Explained(f"{text}: learning is paused", hint))

    def _report_own_misfit(self) -> bool:
        """Print an error if learning is paused and this stream does not fit; return whether it was printed."""
        alarms = islice(self._client.alarms(self._model), 20)
        own = (each.evidence for each in alarms if each.evidence.get("stream_id") == self._source)
        evidence = next((each for each in own if each.get("kind") == "opening"), None)
        if evidence is None:
            return False
        self._checks_left = 0
        share = percent(evidence["coverage"])
        text = f"only {share} of this stream's first second is inside the 95 % interval of {self._model}, too"
        print_error(Explained(text, CHECK))
        return True


CHECK = "check that robot, friction, payload and units match the training data"


def _fitting(motion: Motion, stream: StreamClient) -> Motion:
    """Return the motion in the model's joint order; raise CommandError if it does not fit, warn about other names."""
    hello = stream.hello
    if motion.torque_convention != hello.torque_convention:
        raise CommandError(
            f"the torque of the motion is {motion.torque_convention}; the model expects {hello.torque_convention}"
        )
    fitting, named = motion.ordered(hello.joint_names)
    if not named:
        note(
            f"warning: joint names differ. Using the motion's {', '.join(motion.joint_names)}, in this order, as the "
            f"model's {', '.join(hello.joint_names)}"
        )
    return fitting


def _announce(motion: Motion, stream: StreamClient, source: str | None) -> None:
    hello, taught = stream.hello, "" if source is None else f", learning from stream {source}"
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
        title = "predicted against measured torque" + (", before learning from each row" if learn else "")
        table = Table("joint", "nMSE", "RMSE N·m", "coverage (95 %)", title=title)
        for each in figures["joints"]:
            nmse = "-" if each["nmse"] is None else f"{each['nmse']:.2e}"
            table.add_row(each["joint"], nmse, f"{each['rmse']:.4f}", percent(each["coverage"], 1))
        out.print(table)
    echo(f"total   {_line(figures)}")
    for each in figures.get("not_logged", ()):
        note(f"rows {each['first']} to {each['through']} were not logged: {each['message']} ({each['code']})")


def _line(figures: dict[str, Any]) -> str:
    """Format the figures of a second, or of the whole stream, as one line."""
    parts = [counted(figures["rows"], "row")]
    if figures["rows"]:
        trip = figures["round_trip_ms"]
        parts += [
            f"round trip p50 {trip['p50']:.2f} ms, p99 {trip['p99']:.2f} ms",
            f"{figures['late']} late, {figures['received_late']} received late",
            f"RMSE {figures['rmse']:.4f} N·m, coverage {percent(figures['coverage'], 1)} (95 % interval)",
        ]
    if figures["behind_s"] > 0.1:
        parts.append(f"{figures['behind_s']:.1f} s behind")
    if figures["refused"]:
        parts.append("refused " + _counts(figures["refused"]))
    if "learnt" in figures:
        learnt = figures["learnt"]
        parts.append(f"learnt {learnt['accepted']}")
        if learnt["kept_out"]:
            parts.append("rejected " + _counts(learnt["kept_out"]))
    return "; ".join(parts)


def _counts(counts: dict[str, int]) -> str:
    return ", ".join(f"{count} {code}" for code, count in counts.items())
