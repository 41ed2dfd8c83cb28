"""Build hook: adds the guide and Plotly's bundles to wheels and checkouts.

The guide is the documentation as a site, built by MkDocs with mkdocs.yml. A warning fails the build.

The dashboard draws with parts of Plotly's JavaScript from npm. If npm cannot be reached, PyPI's larger package `plotly`
becomes a dependency, and the service sends its file.
"""

from __future__ import annotations

import hashlib
import io
import os
import subprocess
import sys
import tarfile
import urllib.request
from base64 import b64encode
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

VERSION = "4.1.1"
SHA512 = {
    "cartesian": "o8GrFeusncwBIxbBynRJpY4pkgVB6caM+JLpwrLYbbsO7dZ8FJ+SVN2Fr+L7kiG/Z6w4P5O0Jus/Qr5EefHVeg==",
    "gl3d": "HNdhOi/mVr29u6BbzJvz1kAjEzCxwfaZNLipjNCxg33JE3RmRHhPDUd0LCuQMDcRR5LLFFfaSMMdtOWl0bERZA==",
}
"""Checksum of npm's archive of each bundle, from `npm view plotly.js-NAME-dist-min dist.integrity`."""
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
            for name in SHA512:
                _fetch(name, folder)
        except OSError as error:
            self.app.display_warning(f"Plotly could not be downloaded from npm ({error}). Using PyPI's larger package.")
            build_data["dependencies"].append(FALLBACK)
            return
        build_data["artifacts"].append(f"/{FOLDER}/*")


def _fetch(name: str, folder: Path) -> None:
    """Download a bundle and its licence; raise OSError if the download fails or has a wrong checksum."""
    file = folder / f"plotly-{name}-{VERSION}.min.js"
    if file.exists():
        return
    package = f"plotly.js-{name}-dist-min"
    with urllib.request.urlopen(f"{REGISTRY}/{package}/-/{package}-{VERSION}.tgz", timeout=TIMEOUT_S) as answer:  # noqa: S310 - https
        archive = answer.read()
    if b64encode(hashlib.sha512(archive).digest()).decode() != SHA512[name]:
        raise OSError(f"{package} {VERSION} has a wrong checksum")
    folder.mkdir(exist_ok=True)
    with tarfile.open(fileobj=io.BytesIO(archive)) as packed:
        for member, path in ((f"plotly-{name}.min.js", file), ("LICENSE", folder / "LICENSE")):
            found = packed.extractfile(f"package/{member}")
            assert found is not None
            path.with_suffix(".part").write_bytes(found.read())
            path.with_suffix(".part").rename(path)  # atomic
