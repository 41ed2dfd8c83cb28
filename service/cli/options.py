"""Options and arguments that several commands have, and names that help and completion list."""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from typing import Annotated, Any

import typer
from pydantic import ValidationError

from lipserve.address import URL_VARIABLE
from service.cli import connecting
from service.cli.consoles import CommandError
from service.foundation.environment import check_environment
from service.foundation.settings import Settings
from service.telemetry import logs

logger = logging.getLogger(__name__)

ROBOTS = [
    *("panda", "ur3", "ur5", "ur10", "xarm7", "kinova", "z1", "so100", "so101", "baxter-left", "baxter-right"),
    *("pr2-left", "pr2-right", "talos-left", "tiago", "tiago-pro-left", "tiago-pro-right", "double-pendulum"),
    *("asr-twodof", "finger-edu"),
]
HELD_OUT_BY = ["auto", "last", "episodes", "blocks"]
Promotion = Annotated[
    str | None,
    typer.Option(
        help="Whether the version answers: `ask`, if it does well on what was held out, or `always`; by default as the "
        "service is set.",
        autocompletion=lambda: ["ask", "always"],
    ),
]


Url = Annotated[
    str, typer.Option("--url", envvar=URL_VARIABLE, help="Address of the service: http://… or unix:///path.")
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]
Limit = Annotated[int, typer.Option(min=1, help="Most that are listed.")]
Yes = Annotated[bool, typer.Option("--yes", "-y", help="Do not ask whether that is meant.")]
Model = Annotated[str, typer.Argument(help="Name of the model.", autocompletion=connecting.models)]
DatasetId = Annotated[str, typer.Argument(help="Id or name of a data set.", autocompletion=connecting.datasets)]
JobId = Annotated[str, typer.Argument(help="Id of a job.", autocompletion=connecting.jobs)]
Data = Annotated[
    str,
    typer.Argument(
        help="A recording, which is uploaded, or the id or name of a data set.", autocompletion=connecting.datasets
    ),
]
Version = Annotated[
    int | None, typer.Option(help="A version; the one that serves by default.", autocompletion=connecting.versions)
]
Alias = Annotated[str | None, typer.Option(help="A version by its alias.", autocompletion=connecting.aliases)]


def simulation(help_: str, *names: str, **limits: Any) -> Any:
    """An option that describes a simulated stream."""
    return typer.Option(*names, help=help_, rich_help_panel="Simulation", **limits)


Seed = Annotated[int, simulation("Equal seeds give equal streams.", min=0)]
Sinusoids = Annotated[int, simulation("50 for training, 100 for testing in the paper.", min=1)]
Range = Annotated[str, simulation("middle (±0.5 rad) or full.")]
Along = Annotated[str, simulation("sinusoids, periodic, or rests: from point to point.")]
Fast = Annotated[bool, simulation("The faster-moving variant.", "--fast")]
Noise = Annotated[float, simulation("Std of the torque noise, N·m.")]
Viscous = Annotated[float, simulation("Viscous friction, N·m·s/rad.")]
Coulomb = Annotated[float, simulation("Coulomb friction, N·m.")]
Mass = Annotated[float, simulation("Payload, kg.")]
MassAt = Annotated[float, simulation("When the payload is attached, s.")]
DirtShare = Annotated[
    float,
    simulation("Friction with memory, ripple, coloured noise, encoders: 1 is an industrial arm's.", min=0.0),
]


def group(help_: str) -> typer.Typer:
    """An application of several commands."""
    return typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False, help=help_)


def alone() -> typer.Typer:
    """An application of one command."""
    return typer.Typer(add_completion=False, pretty_exceptions_enable=False)


def settings_of(**given: Any) -> Settings:
    """Settings, those that are given and else those of the environment; raise CommandError."""
    try:
        check_environment(os.environ)
        return Settings(**{name: value for name, value in given.items() if value is not None})
    except ValidationError as error:
        faults = (f"{'.'.join(map(str, each['loc'])) or 'settings'}: {each['msg']}" for each in error.errors())
        raise CommandError("; ".join(faults)) from None
    except ValueError as error:
        raise CommandError(str(error)) from None


def start_logs(settings: Settings) -> None:
    """Log as the settings say from now on, and warn of variables that were removed."""
    logs.configure(logs.LogOptions(settings.log_level, settings.log_format))
    for warning in check_environment(os.environ):
        logger.warning(warning)


def numbers(option: str, text: str) -> list[float]:
    """Numbers separated by commas; raise CommandError."""
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise CommandError(f"{option} is {text!r}, expected numbers separated by commas") from None


def names(text: str | None) -> list[str] | None:
    """Names separated by commas; None where none are given."""
    return None if text is None else [part.strip() for part in text.split(",")]


def pairs(option: str, given: Sequence[str] | None) -> dict[str, str]:
    """Values by name of an option that is given as name=value, repeatedly; raise ValueError."""
    values = {}
    for text in given or ():
        name, equals, value = text.partition("=")
        if not equals or not value:
            raise ValueError(f"{option} is {text!r}, expected a quantity, = and what it is, as q=deg")
        values[name.strip()] = value.strip()
    return values


def value(text: str) -> Any:
    """A number, a truth value or None where it is one."""
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return {"true": True, "false": False, "null": None}.get(text.lower(), text)


def confirm(question: str, yes: bool) -> None:
    """Ask whether something is meant, unless that is said; end the command where it is not."""
    if not yes:
        typer.confirm(question, abort=True, err=True)
