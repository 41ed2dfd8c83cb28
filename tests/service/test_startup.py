"""Imports at startup: commands and processes load no module that they do not need."""

import json
import subprocess
import sys
from importlib.metadata import entry_points

import pytest

from lipcore.extras import EXTRAS
from service import __version__
from service.foundation.settings import shipped_models
from tests.choosing import few
from tests.packaging.test_pieces import BASE

NUMERICS = ("numpy", "scipy", "numba")
FITTING = ("scipy.optimize", "scipy.signal", "scipy.stats")
CLIENTS = ("httpx", "lipserve.sending", "lipserve.stream", "service.cli.demo", "benchmarks", "matplotlib", "pandas")
OF_EXTRAS = {module for each in EXTRAS.values() for module in each.modules if module not in {*BASE, "yaml"}}
"""Of YAML, uvicorn imports what is there."""
SERVING = ("fastapi", "uvicorn", "sqlalchemy", "pydantic", "service")
WEB = ("fastapi", "starlette", "uvicorn", "service.api")


CLIENT_COMMANDS = ("answers", "data", "jobs", "models", "open", "stream")
LIGHT = ("__main__", "runtime.process")
"""Modules that a spawned process imports before it sets its priority: its parent's main module, its initializer's."""
WORKERS = ("training.worker", "learning.learner.worker", "learning.weigher.worker", "datasets.caged", "cli.verify")
ARM = str(shipped_models() / "panda-sim")
CASES = {
    # a statement, modules that it needs, modules that it does not
    "serve": ("import service.cli.serve", {"service.app", "numba", "fastapi"}, (*FITTING, *CLIENTS, *OF_EXTRAS)),
    "list of commands": (
        "from service.cli.main import app; import typer; typer.main.get_command(app)",
        set(),
        (*NUMERICS, *CLIENTS, "lipcore", "fastapi", "pydantic"),
    ),
    "help of client commands": (
        "\n".join(f"import service.cli.{name}" for name in CLIENT_COMMANDS),
        set(),
        (*NUMERICS, *CLIENTS, "fastapi"),
    ),
    "load a model": (
        f"import lipcore\nlipcore.load({ARM!r}).predict(*[[0.0] * 7] * 3)",
        {"lipcore.model.torque_model"},
        (*FITTING, *SERVING, "pinocchio", "matplotlib"),
    ),
    **{name: (f"import service.{name}", {f"service.{name}"}, (*NUMERICS, "lipcore", "fastapi")) for name in LIGHT},
    **{name: (f"import service.{name}", {f"service.{name}"}, WEB) for name in WORKERS},
}
QUICK = ("list of commands", "help of client commands", *LIGHT)


@pytest.mark.parametrize("name", few(CASES, kept=QUICK.__contains__))
def test_processes_import_only_needed_modules(name):
    statement, needed, unneeded = CASES[name]
    script = f"import json, sys\n{statement}\nprint(json.dumps(sorted(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    modules = set(json.loads(done.stdout.splitlines()[-1]))
    assert needed <= modules
    assert modules.isdisjoint(unneeded)


def test_command_starts_in_the_light_main_module():
    """Every training process would import any other entry point again, with all its imports."""
    (result,) = entry_points(group="console_scripts", name="lipserve")
    assert result.value == "service.__main__:main"
    done = subprocess.run([sys.executable, "-m", "service", "--version"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, __version__)
