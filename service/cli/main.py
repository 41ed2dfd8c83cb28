"""The command line: `lipserve`.

Exit codes: 0 done; 1 refused or failed, standard error says why; 2 the command line cannot be read; 130 ended by
Ctrl-C.
"""

from __future__ import annotations

from typing import Annotated

import typer

from service import __version__
from service.cli.consoles import say
from service.cli.lazy import Entry, LazyGroup

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
        "open": Entry("service.cli.open", "Print the address of the dashboard.", RUN),
        "demo": Entry(
            "service.cli.demo", "Serve, simulate a Panda, upload, train, evaluate and ask: two minutes.", RUN
        ),
        "keys": Entry("service.cli.keys", "API keys of the home LIPSERVE_HOME: create, list, revoke.", RUN),
        "verify": Entry("service.cli.verify", "Read all that the home stores and report what is damaged.", RUN),
        "data": Entry("service.cli.data", "Recordings and their reports: add, list, show, delete.", DATA),
        "train": Entry("service.cli.train", "Train a model on recordings. Ctrl-C cancels the job.", MODELS),
        "jobs": Entry("service.cli.jobs", "Training jobs: list, show, follow, cancel, retry.", MODELS),
        "models": Entry(
            "service.cli.models",
            "Models: list, show, promote, rollback, alias, compare, export, import, delete.",
            MODELS,
        ),
        "predict": Entry("service.cli.predict", "Ask a model for the torque at one motion.", ANSWERS),
        "evaluate": Entry("service.cli.evaluate", "Compare a model with a recording, joint by joint.", ANSWERS),
        "stream": Entry("service.cli.stream", "Play a motion to a model in real time, and teach it.", ANSWERS),
        "simulate": Entry("service.cli.simulate", "Simulate a robot's stream and write it as a recording.", ROBOT),
        "excite": Entry("service.cli.excite.command", "Plan the motion that tells most of what is not known.", ROBOT),
        "bench": Entry("service.cli.bench", "Time the answers of a service on this machine.", CHECK),
    }


app = typer.Typer(
    cls=Commands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Learn a manipulator's inverse dynamics and serve torques with uncertainty.",
    epilog="Exit codes: 0 done; 1 refused or failed, standard error says why; 2 the command line cannot be read; "
    "130 ended by Ctrl-C. Commands that ask a service find it by --url or LIPSERVE_URL, their key in LIPSERVE_KEY.",
)


def main() -> None:
    """Run the command line; see `LazyGroup.invoke` for errors."""
    app(prog_name="lipserve")  # however it was started: completion goes by the name


@app.callback(invoke_without_command=True)
def _root(version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False) -> None:
    if version:
        say(__version__)
        raise typer.Exit
