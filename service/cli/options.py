"""Options and arguments shared by commands, and names for help and completion."""

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
        help="When the version becomes the serving version: `ask` (if it passes the check on held-out data) or "
        "`always`. Default: the service's setting.",
        autocompletion=lambda: ["ask", "always"],
    ),
]


Url = Annotated[
    str, typer.Option("--url", envvar=URL_VARIABLE, help="Address of the service: http://… or unix:///path.")
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]
Limit = Annotated[int, typer.Option(min=1, help="Max number of items to list.")]
Yes = Annotated[bool, typer.Option("--yes", "-y", help="Skip confirmation.")]
Model = Annotated[str, typer.Argument(help="Name of the model.", autocompletion=connecting.models)]
DatasetId = Annotated[str, typer.Argument(help="Id or name of a data set.", autocompletion=connecting.datasets)]
JobId = Annotated[str, typer.Argument(help="Id of a job.", autocompletion=connecting.jobs)]
Data = Annotated[
    str,
    typer.Argument(help="Recording to upload, or id or name of a data set.", autocompletion=connecting.datasets),
]
ModelVersion = Annotated[
    str,
    typer.Argument(
        metavar="MODEL[@VERSION]",
        help="Name of the model, with @3 or @ALIAS for another version than the serving one.",
        autocompletion=connecting.models,
    ),
]


def simulation(help_: str, *names: str, **limits: Any) -> Any:
    """Return an option in the help panel `Simulation`."""
    return typer.Option(*names, help=help_, rich_help_panel="Simulation", **limits)


Seed = Annotated[int, simulation("Random seed. Equal seeds give equal streams.", min=0)]
Sinusoids = Annotated[int, simulation("Number of sinusoids; in the paper 50 for training, 100 for testing.", min=1)]
Range = Annotated[str, simulation("Range of motion: middle (±0.5 rad) or full.")]
Along = Annotated[str, simulation("Kind of motion: sinusoids, periodic, or rests (from point to point).")]
Fast = Annotated[bool, simulation("Use the faster variant of the motion.", "--fast")]
Noise = Annotated[float, simulation("Std of the torque noise, N·m.")]
Viscous = Annotated[float, simulation("Viscous friction, N·m·s/rad.")]
Coulomb = Annotated[float, simulation("Coulomb friction, N·m.")]
Mass = Annotated[float, simulation("Mass of the payload, kg.")]
MassAt = Annotated[float, simulation("Time when the payload is attached, s.")]
DirtShare = Annotated[
    float,
    simulation(
        "Scale of real-world effects (friction with memory, ripple, coloured noise, encoders); 1: industrial arm.",
        min=0.0,
    ),
]
DriveName = Annotated[
    str, simulation("Friction with --dirt: lugre, maxwell (elements that slip), or elastic (lugre behind a spring).")
]


def group(help_: str) -> typer.Typer:
    """Return a Typer application for several commands."""
    return typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False, help=help_)


def alone() -> typer.Typer:
    """Return a Typer application for one command."""
    return typer.Typer(add_completion=False, pretty_exceptions_enable=False)


def settings_of(**given: Any) -> Settings:
    """Return the settings of the environment, overridden by those given; raise CommandError if they are invalid."""
    try:
        check_environment(os.environ)
        return Settings(**{name: value for name, value in given.items() if value is not None})
    except ValidationError as error:
        faults = (f"{'.'.join(map(str, each['loc'])) or 'settings'}: {each['msg']}" for each in error.errors())
        raise CommandError("; ".join(faults)) from None
    except ValueError as error:
        raise CommandError(str(error)) from None


def start_logs(settings: Settings) -> None:
    """Configure logging from the settings, and warn about removed environment variables."""
    logs.configure(logs.LogOptions(settings.log_level, settings.log_format))
    for warning in check_environment(os.environ):
        logger.warning(warning)


def numbers(option: str, text: str) -> list[float]:
    """Parse numbers separated by commas; raise CommandError if that fails."""
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise CommandError(f"{option} must be numbers separated by commas, got {text!r}") from None


def names(text: str | None) -> list[str] | None:
    """Split names separated by commas; return None for None."""
    return None if text is None else [part.strip() for part in text.split(",")]


def pairs(option: str, given: Sequence[str] | None) -> dict[str, str]:
    """Parse a repeatable option of the form name=value; raise ValueError if that fails."""
    values = {}
    for text in given or ():
        name, equals, value = text.partition("=")
        if not equals or not value:
            raise ValueError(f"{option} must have the form NAME=VALUE, got {text!r}")
        values[name.strip()] = value.strip()
    return values


def value(text: str) -> Any:
    """Parse a number, true, false or null; return other text as it is."""
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return {"true": True, "false": False, "null": None}.get(text.lower(), text)


def confirm(question: str, yes: bool) -> None:
    """Ask for confirmation unless `yes`; end the command if the user declines."""
    if not yes:
        typer.confirm(question, abort=True, err=True)
