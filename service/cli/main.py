"""Command line `lipserve`: the list of commands.

The module of a command is imported when the command runs, not when commands are listed.
Exit codes: 0 success; 1 failure, explained on standard error; 2 invalid command line; 130 interrupted by Ctrl-C.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, NamedTuple

import typer
from typer.core import TyperCommand, TyperGroup

from service import __version__
from service.cli.consoles import echo, explain, print_error
from service.runtime.remote import import_without_gc


class Entry(NamedTuple):
    """Module and Typer application of a command, and its help in lists."""

    module: str
    help: str
    panel: str
    app: str = "app"


class LazyGroup(TyperGroup):
    """Group of commands that are imported when they run; lists and help show the texts in `entries`.

    Errors in a module's `ERRORS` are printed without a traceback, as are ValueError, OSError and MissingExtraError.
    """

    entries: ClassVar[Mapping[str, Entry]] = {}

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        self.commands = {
            name: TyperCommand(name, help=entry.help, rich_help_panel=entry.panel)
            for name, entry in self.entries.items()
        }

    def load(self, name: str) -> Any:
        """Import a command and return it; raise KeyError if it is unknown."""
        entry = self.entries[name]
        if entry.module not in sys.modules:
            import_without_gc(entry.module)
        command = typer.main.get_command(getattr(sys.modules[entry.module], entry.app))
        command.name = name
        return command

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        """Return the command to run or to complete; reject unknown names."""
        name, described, rest = super().resolve_command(ctx, args)
        return name, described if name is None else self.load(name), rest

    def invoke(self, ctx: Any) -> Any:
        """Run a command; print errors that the user can act on and exit with code 1."""
        try:
            return super().invoke(ctx)
        except Exception as error:
            entry = self.entries.get(ctx.invoked_subcommand)
            module = None if entry is None else sys.modules.get(entry.module)
            explained = explain(error, getattr(module, "ERRORS", ()))
            if explained is None:
                raise
            print_error(explained)
            raise typer.Exit(1) from error


RUN, DATA, MODELS, PREDICTION, ROBOT, BENCHMARK = (
    "Service",
    "Recordings",
    "Training and models",
    "Prediction",
    "Robots and online learning",
    "Benchmarks",
)


class Commands(LazyGroup):
    """All commands, in the order of the help."""

    entries = {  # noqa: RUF012 - declared by the group
        "serve": Entry("service.cli.serve", "Serve models and run training jobs.", RUN),
        "worker": Entry("service.cli.worker", "Run training jobs for services that share a Dask cluster.", RUN),
        "settings": Entry("service.cli.settings", "List all settings with values, defaults and units.", RUN),
        "status": Entry("service.cli.status", "Show whether a service is ready, and its missing extras.", RUN),
        "doctor": Entry(
            "service.cli.doctor.command", "Show what this machine permits, and measure its loop rate.", RUN
        ),
        "open": Entry("service.cli.open", "Print the address of the dashboard.", RUN),
        "demo": Entry("service.cli.demo", "Run a two-minute demo: simulate a Panda, train, evaluate, predict.", RUN),
        "keys": Entry("service.cli.keys", "Create, list and revoke API keys of the home LIPSERVE_HOME.", RUN),
        "verify": Entry("service.cli.verify", "Check all data in the home and report damage.", RUN),
        "backup": Entry(
            "service.cli.backup", "Copy the home into one file, even while it is in use.", RUN, "backup_app"
        ),
        "restore": Entry("service.cli.backup", "Restore a home from a backup.", RUN, "restore_app"),
        "audit": Entry("service.cli.audit", "List changes to models, and who made them.", RUN),
        "data": Entry("service.cli.data", "Add, list, show and delete data sets (recordings).", DATA),
        "train": Entry("service.cli.jobs", "Train a model on recordings. Ctrl-C cancels the job.", MODELS, "train_app"),
        "jobs": Entry("service.cli.jobs", "List, show, follow, cancel and retry training jobs.", MODELS),
        "models": Entry(
            "service.cli.models",
            "List, show, promote, roll back, alias, compare, export, import and delete models.",
            MODELS,
        ),
        "predict": Entry("service.cli.answers", "Predict the torque at one motion.", PREDICTION, "predict_app"),
        "evaluate": Entry(
            "service.cli.answers", "Evaluate a model on a recording, joint by joint.", PREDICTION, "evaluate_app"
        ),
        "stream": Entry(
            "service.cli.stream", "Play a motion to a model in real time; it can learn from it.", PREDICTION
        ),
        "learning": Entry("service.cli.learning", "Show and control online learning of a model.", ROBOT),
        "alarms": Entry("service.cli.learning", "List the alarms of a model.", ROBOT, "alarms_app"),
        "robots": Entry("service.cli.robots", "List, show, add and delete robots and URDFs.", ROBOT),
        "payload": Entry("service.cli.payload", "Show, declare or remove the payload of an arm.", ROBOT),
        "simulate": Entry("service.cli.simulate", "Simulate a robot and write a recording.", ROBOT),
        "excite": Entry("service.cli.excite", "Plan the motion that reduces a model's uncertainty most.", ROBOT),
        "bench": Entry(
            "service.cli.answers", "Measure the latency of a service from this machine.", BENCHMARK, "bench_app"
        ),
    }


app = typer.Typer(
    cls=Commands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Learn a manipulator's inverse dynamics and serve torques with uncertainty.",
    epilog="Exit codes: 0 success; 1 failure, explained on standard error; 2 invalid command line; 130 interrupted by "
    "Ctrl-C. Set the address of the service with --url or LIPSERVE_URL, and the API key with LIPSERVE_API_KEY.",
)


def main() -> None:
    """Run the command line; see `LazyGroup.invoke` for errors."""
    app(prog_name="lipserve")  # shell completion needs this name


@app.callback(invoke_without_command=True)
def _root(version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False) -> None:
    if version:
        echo(__version__)
        raise typer.Exit
