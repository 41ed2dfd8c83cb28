"""Audit by Deque's axe-core, which `.ci/install-axe` installs from npm's registry."""

from __future__ import annotations

import subprocess
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests import ROOT

if TYPE_CHECKING:
    from playwright.sync_api import Page

INSTALL = ROOT / ".ci/install-axe"
MAX_INSTALL_S = 300
RULES = ("wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa")
"""All rules of WCAG 2.2 AA that can be checked automatically."""
RUN = """async (rules) => {
  const { violations } = await axe.run(document, {runOnly: {type: "tag", values: rules}, resultTypes: ["violations"]});
  return violations.flatMap(({id, help, nodes}) => nodes.map(({target, failureSummary}) =>
    `${id} (${help}) at ${target.join(" ")}: ${failureSummary.replace(/\\s+/g, " ")}`));
}"""


@cache
def source() -> str:
    """Return the JavaScript of axe-core; skip the test if it cannot be installed."""
    try:
        made = subprocess.run([INSTALL], capture_output=True, text=True, timeout=MAX_INSTALL_S, check=False)
    except OSError as error:  # no bash
        pytest.skip(f"no axe-core: {error}")
    if not made.stdout.strip():
        pytest.skip(made.stderr.strip())
    return Path(made.stdout.strip()).read_text()


def violations(page: Page) -> list[str]:
    """Return the violations of WCAG 2.2 AA on the page, one sentence each."""
    if not page.evaluate("'axe' in window"):
        page.evaluate(source())  # not as a script element, which the content security policy blocks
    found: list[str] = page.evaluate(RUN, list(RULES))
    return found
