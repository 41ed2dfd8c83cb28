"""The command line: `lipserve`. Modules of commands are imported when one of them is run, and not to list them.

Exit codes: 0 done; 1 refused or failed, standard error says why; 2 the command line cannot be read; 130 ended by
Ctrl-C.
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
    """Where a command is: a Typer application of a module, and what lists say of it."""

    module: str
    help: str
    panel: str
    app: str = "app"


class LazyGroup(TyperGroup):
    """Commands by name in `entries`; lists and help show them as they are described there.

    What a command's module names in `ERRORS` is told to the user without a traceback, beside ValueError, OSError and
    MissingExtraError.
    """

    entries: ClassVar[Mapping[str, Entry]] = {}

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        self.commands = {
            name: TyperCommand(name, help=entry.help, rich_help_panel=entry.panel)
            for name, entry in self.entries.items()
        }

    def load(self, name: str) -> Any:
        """Import a command and return it; raise KeyError for an unknown one."""
        entry = self.entries[name]
        if entry.module not in sys.modules:
            import_without_gc(entry.module)
        command = typer.main.get_command(getattr(sys.modules[entry.module], entry.app))
        command.name = name
        return command

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        """Find the command that is to be run, or whose options are to be completed; unknown ones are refused."""
        name, described, rest = super().resolve_command(ctx, args)
        return name, described if name is None else self.load(name), rest

    def invoke(self, ctx: Any) -> Any:
        """Run a command; what a user can act on is told in words, and ends it with 1."""
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


RUN, DATA, MODELS, ANSWERS, ROBOT, CHECK = (
    "The service",
    "Recordings",
    "Training and models",
    "Answers",
    "Robots",
    "Measuring",
)


class Commands(LazyGroup):
    """The commands, in the order that help lists them."""

    entries = {  # noqa: RUF012 - declared by the group
        "serve": Entry("service.cli.serve", "Serve models and run training jobs.", RUN),
        "worker": Entry("service.cli.worker", "Run jobs of services on a Dask cluster.", RUN),
        "settings": Entry("service.cli.settings", "List all settings: values, defaults, units.", RUN),
        "status": Entry("service.cli.status", "Whether a service is ready, and what is not installed there.", RUN),
        "open": Entry("service.cli.open", "Print the address of the dashboard.", RUN),
        "demo": Entry(
            "service.cli.demo", "Serve, simulate a Panda, upload, train, evaluate and ask: two minutes.", RUN
        ),
        "keys": Entry("service.cli.keys", "API keys of the home LIPSERVE_HOME: create, list, revoke.", RUN),
        "verify": Entry("service.cli.verify", "Read all that the home stores and report what is damaged.", RUN),
        "backup": Entry("service.cli.backup", "Copy the home into one file, also while it is used.", RUN, "backup_app"),
        "restore": Entry("service.cli.backup", "Make a home of a backup.", RUN, "restore_app"),
        "audit": Entry("service.cli.audit", "List who changed what of which model.", RUN),
        "data": Entry("service.cli.data", "Recordings and their reports: add, list, show, delete.", DATA),
        "train": Entry("service.cli.jobs", "Train a model on recordings. Ctrl-C cancels the job.", MODELS, "train_app"),
        "jobs": Entry("service.cli.jobs", "Training jobs: list, show, follow, cancel, retry.", MODELS),
        "models": Entry(
            "service.cli.models",
            "Models: list, show, promote, rollback, alias, compare, export, import, delete.",
            MODELS,
        ),
        "predict": Entry("service.cli.answers", "Ask a model for the torque at one motion.", ANSWERS, "predict_app"),
        "evaluate": Entry(
            "service.cli.answers", "Compare a model with a recording, joint by joint.", ANSWERS, "evaluate_app"
        ),
        "stream": Entry("service.cli.stream", "Play a motion to a model in real time, and teach it.", ANSWERS),
        "learning": Entry("service.cli.learning", "Whether a model learns; decide about what it waits for.", ROBOT),
        "alarms": Entry("service.cli.learning", "What the owner of a model should know.", ROBOT, "alarms_app"),
        "robots": Entry("service.cli.robots", "Robots by name and URDFs: list, show, add, delete.", ROBOT),
        "payload": Entry("service.cli.payload", "Show what the arm carries, declare it, or that it is gone.", ROBOT),
        "simulate": Entry("service.cli.simulate", "Simulate a robot's stream and write it as a recording.", ROBOT),
        "excite": Entry("service.cli.excite", "Plan the motion that tells most of what is not known.", ROBOT),
        "bench": Entry("service.cli.answers", "Time the answers of a service on this machine.", CHECK, "bench_app"),
    }


app = typer.Typer(
    cls=Commands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Learn a manipulator's inverse dynamics and serve torques with uncertainty.",
    epilog="Exit codes: 0 done; 1 refused or failed, standard error says why; 2 the command line cannot be read; "
    "130 ended by Ctrl-C. Commands that ask a service find it by --url or LIPSERVE_URL, their key in LIPSERVE_API_KEY.",
)


def main() -> None:
    """Run the command line; see `LazyGroup.invoke` for errors."""
    app(prog_name="lipserve")  # however it was started: completion goes by the name


@app.callback(invoke_without_command=True)
def _root(version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False) -> None:
    if version:
        echo(__version__)
        raise typer.Exit
