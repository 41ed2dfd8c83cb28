"""Compiled C++ client."""

from pathlib import Path

import pytest

from tests.clients.cpp.building import COMPILERS, built, here, sanitizers


@pytest.fixture(scope="session", params=COMPILERS)
def compiler(request: pytest.FixtureRequest) -> str:
    """Each installed C++ compiler."""
    if not here(request.param):
        pytest.skip(f"{request.param} is not installed")
    return str(request.param)


@pytest.fixture(scope="session")
def any_compiler() -> str:
    """One installed C++ compiler."""
    found = here(*COMPILERS)
    if not found:
        pytest.skip(f"none of {', '.join(COMPILERS)} is installed")
    return found[0]


@pytest.fixture(scope="session")
def driver(any_compiler: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Program of `Driver`, with sanitizers if they are installed."""
    return built(
        any_compiler, "tests/drive.cpp", tmp_path_factory.mktemp("driver"), "-O1", "-g", *sanitizers(any_compiler)
    )
