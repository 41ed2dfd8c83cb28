"""Build hook: adds the guide and the dashboard's JavaScript libraries to wheels and checkouts.

The guide is the documentation as a site, built by MkDocs with mkdocs.yml. A warning fails the build.

The dashboard uses Preact, htm and parts of Plotly from npm. If npm cannot be reached, the files of the newest wheel in
dist/ are used. Without one, PyPI's larger package `plotly` becomes a dependency, and the pages say what is missing.
"""

from __future__ import annotations

import hashlib
import io
import os
import subprocess
import sys
import tarfile
import urllib.request
import zipfile
from base64 import b64encode
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class Library(NamedTuple):  # not a dataclass: Hatch runs this file outside `sys.modules`, where dataclasses look
    """A package of npm, with the files that the dashboard needs.

    Attributes:
        package: name of the package.
        version: its version.
        sha512: checksum of its archive, from `npm view PACKAGE dist.integrity`.
        files: names of its files in the dashboard, by their paths in the package.
    """

    package: str
    version: str
    sha512: str
    files: Mapping[str, str]


LIBRARIES = (
    Library(
        "plotly.js-cartesian-dist-min",
        "4.1.1",
        "o8GrFeusncwBIxbBynRJpY4pkgVB6caM+JLpwrLYbbsO7dZ8FJ+SVN2Fr+L7kiG/Z6w4P5O0Jus/Qr5EefHVeg==",
        {"plotly-cartesian.min.js": "plotly-cartesian-4.1.1.min.js", "LICENSE": "LICENSE-plotly"},
    ),
    Library(
        "plotly.js-gl3d-dist-min",
        "4.1.1",
        "HNdhOi/mVr29u6BbzJvz1kAjEzCxwfaZNLipjNCxg33JE3RmRHhPDUd0LCuQMDcRR5LLFFfaSMMdtOWl0bERZA==",
        {"plotly-gl3d.min.js": "plotly-gl3d-4.1.1.min.js"},
    ),
    Library(
        "preact",
        "11.2.0",
        "/HfHI/7N84e6GrWBJ3J280z3mLaRJiDcSvj/A+y/4AbLnND/1UlGHe1sR6oYuTGwId0nP7dqDU9OnLxMPZ7xBg==",
        {
            "dist/preact.mjs": "preact-11.2.0.js",
            "hooks/dist/hooks.mjs": "preact-hooks-11.2.0.js",
            "LICENSE": "LICENSE-preact",
        },
    ),
    Library(
        "htm",
        "3.1.1",
        "983Vyg8NwUE7JkZ6NmOqpCZ+sh1bKv2iYTlUkzlWmA5JD2acKoxd4KVxbMmxX/85mtfdnDmTFoNKcg5DGAvxNQ==",
        {"dist/htm.module.js": "htm-3.1.1.js", "LICENSE": "LICENSE-htm"},
    ),
)
REGISTRY = os.environ.get("NPM_CONFIG_REGISTRY", "https://registry.npmjs.org").rstrip("/")
TIMEOUT_S = 30
FALLBACK = "plotly>=6.1,<8"
FOLDER = Path("service/api/dashboard/bundles")
SITE = Path("service/api/guide/site")
"""`site_dir` of mkdocs.yml."""


class Files(BuildHookInterface[Any]):
    """The hook; it also runs for editable installations, which use the files in the checkout."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Build the guide, download missing bundles, and add both to the wheel."""
        environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
        subprocess.run([sys.executable, "-m", "mkdocs", "build"], cwd=self.root, env=environment, check=True)
        build_data["artifacts"].append(f"/{SITE}/**")
        folder = Path(self.root) / FOLDER
        try:
            for library in LIBRARIES:
                fetch(library, folder)
        except OSError as error:
            if copy_release(Path(self.root) / "dist", folder):
                self.app.display_warning(f"npm cannot be reached ({error}). Using the files of the last release.")
            else:
                self.app.display_warning(f"npm cannot be reached ({error}), and dist/ has no wheel of a release.")
                build_data["dependencies"].append(FALLBACK)
        if folder.is_dir():
            build_data["artifacts"].append(f"/{FOLDER}/*")


def fetch(library: Library, folder: Path) -> None:
    """Download the files of a library; raise OSError if the download fails or has a wrong checksum."""
    if all((folder / name).exists() for name in library.files.values()):
        return
    base = library.package.rpartition("/")[2]
    address = f"{REGISTRY}/{library.package}/-/{base}-{library.version}.tgz"
    with urllib.request.urlopen(address, timeout=TIMEOUT_S) as answer:  # noqa: S310 - https
        archive = answer.read()
    if b64encode(hashlib.sha512(archive).digest()).decode() != library.sha512:
        raise OSError(f"{library.package} {library.version} has a wrong checksum")
    with tarfile.open(fileobj=io.BytesIO(archive)) as packed:
        for member, name in library.files.items():
            found = packed.extractfile(f"package/{member}")
            assert found is not None
            # a browser resolves only relative addresses
            write(folder / name, found.read().replace(b'from"preact"', b'from"./preact-11.2.0.js"'))


def copy_release(wheels: Path, folder: Path) -> bool:
    """Copy the libraries from the newest wheel of a folder; return whether there is one."""
    newest = max(wheels.glob("lipserve-*.whl"), key=lambda path: path.stat().st_mtime, default=None)
    if newest is None:
        return False
    with zipfile.ZipFile(newest) as packed:
        for member in packed.namelist():
            if member.startswith(f"{FOLDER}/"):
                write(folder / Path(member).name, packed.read(member))
    return True


def write(path: Path, content: bytes) -> None:
    """Write a file as a whole or not at all."""
    path.parent.mkdir(exist_ok=True)
    part = path.with_suffix(".part")
    part.write_bytes(content)
    part.rename(path)
