"""Imports at startup: commands and processes load no module that they do not need."""

import json
import subprocess
import sys
from importlib.metadata import entry_points

import pytest

from lipcore.extras import EXTRAS
from service import __version__
from service.foundation.settings import shipped_models
from tests.packaging.test_pieces import BASE

NUMERICS = ("numpy", "scipy", "numba")
FITTING = ("scipy.optimize", "scipy.signal", "scipy.stats")
CLIENTS = ("httpx", "lipserve.sending", "lipserve.stream", "service.cli.demo", "benchmarks", "matplotlib", "pandas")
OF_EXTRAS = {module for each in EXTRAS.values() for module in each.modules if module not in BASE}
SERVING = ("fastapi", "uvicorn", "sqlalchemy", "pydantic", "service")


def imported_modules(statement):
    """Return the modules that a fresh interpreter has imported after a statement."""
    script = f"import json, sys\n{statement}\nprint(json.dumps(sorted(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return set(json.loads(done.stdout.splitlines()[-1]))


@pytest.mark.slow
def test_serve_imports_no_client_and_no_experiment():
    result = imported_modules("import service.cli.serve")
    assert {"service.app", "numba", "fastapi"} <= result
    assert result.isdisjoint((*FITTING, *CLIENTS, *OF_EXTRAS))


def test_listing_commands_imports_no_numerics():
    result = imported_modules("from service.cli.main import app; import typer; typer.main.get_command(app)")
    assert result.isdisjoint((*NUMERICS, *CLIENTS, "lipcore", "fastapi", "pydantic"))


def test_client_commands_import_neither_numerics_nor_httpx_for_help():
    names = ("answers", "data", "jobs", "models", "open", "stream")
    result = imported_modules("\n".join(f"import service.cli.{name}" for name in names))
    assert result.isdisjoint((*NUMERICS, *CLIENTS, "fastapi"))


@pytest.mark.slow
def test_loading_a_model_imports_neither_fitting_nor_service():
    folder, zeros = str(shipped_models() / "panda-sim"), [0.0] * 7
    result = imported_modules(f"import lipcore\nlipcore.load({folder!r}).predict({zeros}, {zeros}, {zeros})")
    assert "lipcore.model.torque_model" in result
    assert result.isdisjoint((*FITTING, *SERVING, "pinocchio", "matplotlib"))


@pytest.mark.parametrize("module", ["service.__main__", "service.runtime.process"])
def test_training_process_sets_its_priority_before_importing_numerics(module):
    """A spawned process imports its parent's main module, then its initializer's modules, then those of the job."""
    result = imported_modules(f"import {module}")
    assert module in result
    assert result.isdisjoint((*NUMERICS, "lipcore", "fastapi"))


@pytest.mark.slow
@pytest.mark.parametrize(
    "module",
    [
        "service.training.worker",
        "service.learning.learner.worker",
        "service.learning.weigher.worker",
        "service.datasets.caged",
        "service.cli.verify",
    ],
)
def test_processes_without_http_import_no_web_framework(module):
    result = imported_modules(f"import {module}")
    assert module in result
    assert result.isdisjoint(("fastapi", "starlette", "uvicorn", "service.api"))


def test_command_starts_in_the_light_main_module():
    """Every training process would import any other entry point again, with all its imports."""
    (result,) = entry_points(group="console_scripts", name="lipserve")
    assert result.value == "service.__main__:main"
    done = subprocess.run([sys.executable, "-m", "service", "--version"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, __version__)
