"""The verdict on twelve models of known quality, as their pages show it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import pytest

from tests.service.server import Server
from tests.service.training.verdict_cases import CASES, train_cases
from tests.system.browser.accessibility import expect
from tests.system.browser.conftest import Visit

if TYPE_CHECKING:
    from playwright.sync_api import Browser


@pytest.fixture(scope="module")
def asking(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Server, dict[str, Any]]]:
    """A service that promotes only usable versions, with a model for each case."""
    with Server(tmp_path_factory.mktemp("verdicts"), warm=True, LIPSERVE_PROMOTION="ask") as server:
        yield server, train_cases(server.client)


def test_pages_show_the_verdict_and_serve_only_what_is_usable(
    windows: Visit, asking: tuple[Server, dict[str, Any]]
) -> None:
    server, jobs = asking
    visitor = windows(server.url)
    for name, case in CASES.items():
        job = jobs[name]
        model, number, verdict = job["model"], job["version"], job["verdict"]
        page = visitor.open(f"#/models/{model}?version={number}")
        reason = verdict["reason"].partition("`")[0].strip()  # code is shown in the words of the dashboard
        note = page.get_by_role("note").filter(has_text=reason).first
        expect(note, name).to_contain_text(verdict["label"])
        serving = page.get_by_role("button", name=f"Serve version {number} anyway", exact=True)
        expect(serving, name).to_have_count(0 if case.serves else 1)
        page = visitor.open(f"#/jobs/{job['id']}")
        expect(page.get_by_role("note").filter(has_text=reason).first, name).to_be_visible()
    page = visitor.open("#/models")
    for name, case in CASES.items():
        row = page.get_by_role("table", name="Models").locator(f'tr[data-key="{name}"]')
        if case.model is None:
            expect(row, name).to_contain_text(jobs[name]["verdict"]["label"] if case.serves else "none")
