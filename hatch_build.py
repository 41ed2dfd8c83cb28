"""Adds to wheels and checkouts what the service shows and the repository does not hold.

The guide is the documentation as a site, built by MkDocs as mkdocs.yml says. A build that warns fails.

The parts of Plotly's JavaScript that the dashboard draws with come from npm: PyPI has it as a whole only, in a large
package. If npm cannot be reached, that package, `plotly`, becomes a dependency instead, and the service sends its file.
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
"""Of npm's archive of each bundle, as `npm view plotly.js-NAME-dist-min dist.integrity` prints it."""
REGISTRY = os.environ.get("NPM_CONFIG_REGISTRY", "https://registry.npmjs.org").rstrip("/")
SECONDS = 30
INSTEAD = "plotly>=6.1,<8"
FOLDER = Path("service/api/dashboard/bundles")
SITE = Path("service/api/guide/site")
"""`site_dir` of mkdocs.yml."""


class Files(BuildHookInterface[Any]):
    """Runs before a wheel is made, of editable installations too, which find the files in the checkout."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Build the guide, fetch the bundles that are not there yet, and let the wheel hold both."""
        environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
        subprocess.run([sys.executable, "-m", "mkdocs", "build"], cwd=self.root, env=environment, check=True)
        build_data["artifacts"].append(f"/{SITE}/**")
        folder = Path(self.root) / FOLDER
        try:
            for name in SHA512:
                _fetch(name, folder)
        except OSError as error:
            self.app.display_warning(f"npm's Plotly cannot be had ({error}): PyPI's, which is larger, is taken instead")
            build_data["dependencies"].append(INSTEAD)
            return
        build_data["artifacts"].append(f"/{FOLDER}/*")


def _fetch(name: str, folder: Path) -> None:
    """Write a bundle, and its licence; raise OSError where it cannot be had or is not the one that is expected."""
    file = folder / f"plotly-{name}-{VERSION}.min.js"
    if file.exists():
        return
    package = f"plotly.js-{name}-dist-min"
    with urllib.request.urlopen(f"{REGISTRY}/{package}/-/{package}-{VERSION}.tgz", timeout=SECONDS) as answer:  # noqa: S310 - https
        archive = answer.read()
    if b64encode(hashlib.sha512(archive).digest()).decode() != SHA512[name]:
        raise OSError(f"{package} {VERSION} has another checksum than expected")
    folder.mkdir(exist_ok=True)
    with tarfile.open(fileobj=io.BytesIO(archive)) as packed:
        for member, path in ((f"plotly-{name}.min.js", file), ("LICENSE", folder / "LICENSE")):
            found = packed.extractfile(f"package/{member}")
            assert found is not None
            path.with_suffix(".part").write_bytes(found.read())
            path.with_suffix(".part").rename(path)  # never half of it
