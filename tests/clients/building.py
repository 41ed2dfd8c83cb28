"""Compiles the programs of clients/cpp with the compilers that this machine has."""

import os
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path

from tests.docs.blocks import ROOT

CPP = ROOT / "clients/cpp"
VECTORS = ROOT / "clients/stream-vectors.txt"
COMPILERS = ("g++", "clang++")
STRICT = ("-std=c++17", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wshadow", "-Werror")


def here(*compilers: str) -> tuple[str, ...]:
    """Those of the compilers that are installed."""
    return tuple(compiler for compiler in compilers if shutil.which(compiler))


@cache
def sanitizers(compiler: str, kinds: str = "address,undefined") -> tuple[str, ...]:
    """Options that switch sanitizers on, none where the compiler comes without their runtime."""
    options = (f"-fsanitize={kinds}", "-fno-sanitize-recover=all")
    return options if _runs(compiler, "int main() {}\n", *options) else ()


def fuzzes(compiler: str) -> bool:
    """Whether the compiler comes with a fuzzer."""
    program = 'extern "C" int LLVMFuzzerTestOneInput(const unsigned char*, unsigned long) { return 0; }\n'
    return _runs(compiler, program, "-fsanitize=fuzzer", arguments=("-runs=1",))


def _runs(compiler: str, text: str, *options: str, arguments: tuple[str, ...] = ()) -> bool:
    with tempfile.TemporaryDirectory() as folder:
        source, program = Path(folder, "empty.cpp"), Path(folder, "empty")
        source.write_text(text)
        made = subprocess.run([compiler, *options, source, "-o", program], capture_output=True, check=False)
        if made.returncode != 0:
            return False
        return subprocess.run([program, *arguments], capture_output=True, check=False).returncode == 0


def built(compiler: str, source: str, folder: Path, *options: str) -> Path:
    """Compile a file of clients/cpp, a warning being an error, and return the program."""
    program = folder / f"{Path(source).stem}-{compiler}"
    command = [compiler, *STRICT, *options, f"-I{CPP / 'include'}", CPP / source, "-o", program]
    made = subprocess.run(command, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr
    return program


def checked(program: Path, *arguments: str, **environment: str) -> str:
    """Run a program that has to end well, and return what it prints."""
    ran = subprocess.run(
        [program, *arguments], capture_output=True, text=True, check=False, env={**os.environ, **environment}
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    return ran.stdout
