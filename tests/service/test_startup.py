"""What a start imports: a restart is quick, and nothing is loaded that serving does without."""

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


def imported(statement):
    """Modules that a fresh interpreter has imported after a statement."""
    script = f"import json, sys\n{statement}\nprint(json.dumps(sorted(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return set(json.loads(done.stdout.splitlines()[-1]))


@pytest.mark.slow
def test_the_command_that_serves_imports_no_client_and_no_experiment():
    result = imported("import service.cli.serve")
    assert {"service.app", "numba", "fastapi"} <= result
    assert result.isdisjoint((*FITTING, *CLIENTS, *OF_EXTRAS))


def test_listing_commands_imports_none_of_them():
    result = imported("from service.cli.main import app; import typer; typer.main.get_command(app)")
    assert result.isdisjoint((*NUMERICS, *CLIENTS, "lipcore", "fastapi", "pydantic"))


def test_help_and_completion_of_what_asks_a_service_import_neither_numerics_nor_a_client():
    names = ("answers", "data", "jobs", "models", "open", "stream")
    result = imported("\n".join(f"import service.cli.{name}" for name in names))
    assert result.isdisjoint((*NUMERICS, *CLIENTS, "fastapi"))


@pytest.mark.slow
def test_a_controller_that_loads_a_model_imports_neither_fitting_nor_service():
    folder, zeros = str(shipped_models() / "panda-sim"), [0.0] * 7
    result = imported(f"import lipcore\nlipcore.load({folder!r}).predict({zeros}, {zeros}, {zeros})")
    assert "lipcore.model.torque_model" in result
    assert result.isdisjoint((*FITTING, *SERVING, "pinocchio", "matplotlib"))


@pytest.mark.parametrize("module", ["service.__main__", "service.runtime.process"])
def test_a_training_process_takes_its_place_before_numerics_start_their_threads(module):
    """A spawned process imports its parent's main module, then what its initializer needs, then the job."""
    result = imported(f"import {module}")
    assert module in result
    assert result.isdisjoint((*NUMERICS, "lipcore", "fastapi"))


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
def test_what_speaks_no_http_imports_no_web_framework(module):
    result = imported(f"import {module}")
    assert module in result
    assert result.isdisjoint(("fastapi", "starlette", "uvicorn", "service.api"))


def test_the_command_starts_in_the_light_main_module():
    """Any other entry point would be imported again by every training process, with all that it imports."""
    (result,) = entry_points(group="console_scripts", name="lipserve")
    assert result.value == "service.__main__:main"
    done = subprocess.run([sys.executable, "-m", "service", "--version"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, __version__)
