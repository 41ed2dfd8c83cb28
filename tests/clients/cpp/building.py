"""Compiles the programs of clients/cpp with the installed compilers."""

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
    """Return the compilers that are installed."""
    return tuple(compiler for compiler in compilers if shutil.which(compiler))


@cache
def sanitizers(compiler: str, kinds: str = "address,undefined") -> tuple[str, ...]:
    """Return options that enable sanitizers, none if their runtime is missing."""
    options = (f"-fsanitize={kinds}", "-fno-sanitize-recover=all")
    return options if _runs(compiler, "int main() {}\n", *options) else ()


def fuzzes(compiler: str) -> bool:
    """Return whether the compiler has a fuzzer."""
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
    """Compile a file of clients/cpp with warnings as errors, and return the program."""
    program = folder / f"{Path(source).stem}-{compiler}"
    command = [compiler, *STRICT, *options, f"-I{CPP / 'include'}", CPP / source, "-o", program]
    made = subprocess.run(command, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr
    return program


def checked(program: Path, *arguments: str, **environment: str) -> str:
    """Run a program that must succeed, and return its output."""
    ran = subprocess.run(
        [program, *arguments], capture_output=True, text=True, check=False, env={**os.environ, **environment}
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    return ran.stdout
