"""The documentation as a site: the pages of the guide, in its order, each link leading somewhere."""

import subprocess
import sys
from html import escape

import pytest
import yaml

from service.api.guide import routes
from tests.docs.blocks import ROOT

CONFIGURATION = ROOT / "mkdocs.yml"


def test_the_site_has_the_pages_of_the_guide_in_its_order():
    listed = []
    for entry in yaml.safe_load(CONFIGURATION.read_text("utf-8"))["nav"]:
        ((_, pages),) = entry.items()
        listed += pages if isinstance(pages, list) else [pages]
    assert listed == [routes.INDEX, *routes.ORDER]


def test_it_is_built_without_a_warning(tmp_path):
    pytest.importorskip("material", reason="MkDocs Material is missing: pip install mkdocs-material")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--config-file", str(CONFIGURATION)]
    done = subprocess.run([*command, "--site-dir", str(tmp_path)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for page in routes.pages().values():
        built = tmp_path / page.file.removesuffix(".md") if page.slug else tmp_path
        assert escape(page.title, quote=False) in (built / "index.html").read_text("utf-8")
    assert not list(tmp_path.rglob("*.py"))
