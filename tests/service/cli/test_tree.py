"""Tree of commands: reference, lists, completion, exit codes, error messages."""

import json
import runpy
import sys
from pathlib import Path

import pytest

from lipcore.estimators.catalogue import ESTIMATORS
from lipcore.robots.library import ROBOTS
from lipcore.vocabulary import AUTO, ESTIMATOR_CHOICES
from lipserve import ApiError
from service import __version__
from service.cli import consoles, options
from service.cli.consoles import plain
from service.cli.main import Commands
from tests import ROOT
from tests.service.cli.conftest import lacking
from tests.service.server import free_port

DOCS = ROOT / "docs"
PAGE = runpy.run_path(str(DOCS / "cli.py"))
PRINTS_NO_RESULT = {"serve", "worker", "demo"}


def test_reference_is_up_to_date():
    assert (DOCS / "reference/cli.md").read_text() == PAGE["page"](), "run: python docs/cli.py"


def test_names_in_help_exist():
    assert list(ROBOTS) == options.ROBOTS
    assert [AUTO, *ESTIMATORS] == list(ESTIMATOR_CHOICES)


def test_version_and_help(lipserve):
    assert lipserve("--version") == (0, f"{__version__}\n", "")
    code, out, _ = lipserve("--help")
    assert (code, lacking(out, *(f"{command} " for command in Commands.entries))) == (0, [])


def test_every_command_has_help_and_json_output():
    for path, command, _ in PAGE["commands"]():
        assert command.help, path
        for parameter in command.params:
            assert parameter.help, (path, parameter.name)
        if not hasattr(command, "list_commands") and path[1] not in PRINTS_NO_RESULT:
            assert "--json" in [name for each in command.params for name in each.opts], path


def test_settings_are_listed_with_units_and_without_passwords(lipserve, monkeypatch):
    monkeypatch.setenv("LIPSERVE_DATABASE_URL", "postgresql://me:secret@host/name")
    monkeypatch.setenv("LIPSERVE_FILES_URL", "s3://bucket/prefix")
    code, out, _ = lipserve("settings")
    assert (code, "secret" in out, "LIPSERVE_PUBLISH_EVERY_S" in out) == (0, False, True)
    shown = {each["variable"]: each for each in json.loads(lipserve("settings", "--json")[1])}
    assert shown["LIPSERVE_DATABASE_URL"]["value"] == "postgresql://me:***@host/name"
    publish = {"value": "0.5", "default": "0.5", "unit": "s"}
    assert shown["LIPSERVE_PUBLISH_EVERY_S"].items() >= publish.items()


@pytest.mark.parametrize(
    ("words", "found"),
    [
        (["home_bytes"], ["LIPSERVE_MAX_HOME_BYTES"]),  # part of the name
        (["Quota", "of the home"], ["LIPSERVE_MAX_HOME_BYTES"]),  # words of the meaning
        (["lipserve_max_home_bytes"], ["LIPSERVE_MAX_HOME_BYTES"]),
        (["max_refreshed"], []),  # removed
    ],
)
def test_settings_are_found_by_name_or_meaning(lipserve, words, found):
    code, out, _ = lipserve("settings", *words, "--json")
    assert (code, [each["variable"] for each in json.loads(out)]) == (0, found)


def test_search_for_setting_explains_removed_and_unknown_ones(lipserve):
    notice = " ".join(lipserve("settings", "max_refreshed")[2].split())
    assert notice.startswith("LIPSERVE_MAX_REFRESHED_VERSIONS was removed: 10 refreshed versions")
    code, out, err = lipserve("settings", "home", "no-such-word")
    assert (code, out) == (1, "")
    assert "`home no-such-word`" in err


@pytest.fixture
def completed(lipserve, monkeypatch):
    """Return the completions of the last word of a command line."""

    def run(line):
        shell = {"_LIPSERVE_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": str(line.count(" "))}
        with monkeypatch.context() as patch:
            for name, value in shell.items():
                patch.setenv(name, value)
            code, out, err = lipserve()
        assert (code, err) == (0, "")
        return out.split()

    return run


def test_commands_and_options_are_completed(completed):
    rigid = ["rigid-body", "rigid-body+local", "rigid-body+lip-chain"]
    for line, completions in (
        ("mo", ["models"]),
        ("models pro", ["promote"]),
        ("predict --comp", ["--components"]),
        ("train x.csv --estimator rigid", rigid),
    ):
        assert completed(f"lipserve {line}") == completions
    assert "--queries" in completed("lipserve bench latency arm --qu")
    assert "latency" in completed("lipserve bench la")


def test_names_from_a_running_service_are_completed(completed, server, arm, monkeypatch):
    name, dataset = arm
    monkeypatch.setenv("LIPSERVE_URL", server.url)
    assert completed("lipserve predict cli-ar") == [name]
    assert completed(f"lipserve models promote {name} ") == ["1", "2"]
    assert dataset in completed(f"lipserve evaluate {name} ds_")
    monkeypatch.setenv("LIPSERVE_URL", f"http://127.0.0.1:{free_port()}")
    assert completed("lipserve predict cli-ar") == []


def test_exit_codes(lipserve):
    for line in ("data nonsense", "predict m --nonsense", "models promote m"):
        assert lipserve(*line.split())[0] == 2, line
    assert "Did you mean 'train'" in lipserve("trian")[2]
    for line in ("models list", "open", "status", "stream m --simulate panda --seconds 0.1"):
        code, out, err = lipserve(*line.split(), "--url", f"http://127.0.0.1:{free_port()}")
        start = "one" if line == "status" else ""
        assert (code, out, f"{start} with `lipserve serve`" in err) == (1, "", True), line


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("simulate r2d2 x.csv", f"robot is 'r2d2', expected one of {', '.join(ROBOTS)}"),
        ("simulate ur5 x.parquet", "must end with .csv or .npz, got 'x.parquet'"),
        ("simulate ur5 x.csv --motion wild", "motion is 'wild'"),
        ("simulate ur5 x.csv --noise -1", "noise is -1.0"),
        ("simulate ur5 nowhere/x.csv --samples 40", "nowhere/x.csv"),
        ("predict m --q 1,two,3", "--q must be numbers separated by commas, got '1,two,3'"),
        ("predict m --q=", "--q must be numbers separated by commas, got ''"),
        ("predict m --q 1 --dq x", "--dq must be numbers separated by commas, got 'x'"),
        ("predict m --q 1 --payload 2", "--payload must have the form mass,x,y,z, got '2'"),
        ("predict m --q 1 --payload 2,0,0,0 --payload-inertia 1,1,1", "must have the form xx,xy,xz,yy,yz,zz"),
        ("predict m --q 1 --payload-inertia 1,0,0,1,0,1", "--payload-inertia requires --payload"),
        ("serve --port 70000", "port: Input should be less than or equal to 65535"),
        ("serve", "max_samples: "),
    ],
)
def test_invalid_arguments_are_explained_in_one_line(lipserve, tmp_path, monkeypatch, command, message):
    monkeypatch.chdir(tmp_path)
    if command == "serve":
        monkeypatch.setenv("LIPSERVE_MAX_SAMPLES", "-5")
    code, out, err = lipserve(*command.split())
    assert (code, out, err.count("\n"), err[:7], list(tmp_path.iterdir())) == (1, "", 1, "error: ", [])
    assert message in err


def test_status_shows_parts_and_missing_extras(run_command, server):
    text, document = run_command("status"), run_command("status", "--json")
    assert f"{server.url} is ready: LIPServe {__version__}" in text
    parts = ["database", "home", "models", "learner", "training", *(["planes"] if sys.platform == "linux" else [])]
    assert [each["name"] for each in document["checks"]] == parts
    assert all(f"{each['name']} " in text and each["message"] in text for each in document["checks"])
    assert document["can"] == server.client.get("/health").json()["can"]
    assert text.count("not installed: pip install") == len(document["missing"])


def test_used_port_is_reported_before_the_home_is_created(lipserve, server, tmp_path, monkeypatch):
    monkeypatch.setenv("LIPSERVE_HOME", str(tmp_path / "home"))
    code, out, err = lipserve("serve", "--port", server.port)
    message = f"error: Cannot listen on port {server.port} of 127.0.0.1: Address already in use"
    assert (code, out, message in err) == (1, "", True)
    assert not (tmp_path / "home").exists()


def test_address_of_the_dashboard(run_command, server):
    assert run_command("open") == f"{server.url}/#/\n"
    assert run_command("open", "my-arm", "--live", "--json") == {"url": f"{server.url}/#/live/my-arm"}


@pytest.mark.parametrize(
    ("status", "code", "hint"),
    [
        (401, "unauthorized", "set LIPSERVE_API_KEY"),
        (403, "forbidden", "lipserve keys create"),
        (429, "busy", "try again in a moment"),
        (422, "invalid_request", None),
    ],
)
def test_hints(status, code, hint):
    explained = consoles.explain(ApiError(status, code, "no", []), (ApiError,))
    assert explained.message == f"no ({code}, {status})"
    assert (explained.hint is None) if hint is None else (hint in explained.hint)


def test_faults_of_the_program_keep_their_traceback():
    assert consoles.explain(KeyError("x")) is None
    assert consoles.explain(BrokenPipeError()) is None
    assert consoles.explain(ValueError("x is 1, expected 2")) == ("x is 1, expected 2", None)


def test_non_finite_numbers_become_null():
    values = {"a": float("nan"), "b": (1.0, float("inf")), "c": Path("x")}
    assert plain(values) == {"a": None, "b": [1.0, None], "c": "x"}
