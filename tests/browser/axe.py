"""The audit of Deque's axe-core, which is no part of this repository: `.ci/install-axe` gets it from npm's registry."""

from __future__ import annotations

import subprocess
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Page

INSTALL = Path(__file__).parents[2] / ".ci/install-axe"
LONGEST_S = 300
RULES = ("wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa")
"""All of WCAG 2.2 AA that a program can tell."""
RUN = """async (rules) => {
  const { violations } = await axe.run(document, {runOnly: {type: "tag", values: rules}, resultTypes: ["violations"]});
  return violations.flatMap(({id, help, nodes}) => nodes.map(({target, failureSummary}) =>
    `${id} (${help}) at ${target.join(" ")}: ${failureSummary.replace(/\\s+/g, " ")}`));
}"""


@cache
def source() -> str:
    """axe-core's JavaScript; the test is skipped, with the reason, where it cannot be had."""
    try:
        made = subprocess.run([INSTALL], capture_output=True, text=True, timeout=LONGEST_S, check=False)
    except OSError as error:  # no bash
        pytest.skip(f"no axe-core: {error}")
    if not made.stdout.strip():
        pytest.skip(made.stderr.strip())
    return Path(made.stdout.strip()).read_text()


def violations(page: Page) -> list[str]:
    """What of WCAG 2.2 AA the page as it stands violates, a sentence each."""
    if not page.evaluate("'axe' in window"):
        page.evaluate(source())  # not as a script of the page, which its policy would refuse
    found: list[str] = page.evaluate(RUN, list(RULES))
    return found
