"""Empty states, errors and the key dialog."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING

import pytest

from service.api.access import keys
from service.storage.database import Database
from tests.service.server import Server
from tests.system.browser.accessibility import audit, expect
from tests.system.browser.conftest import Dashboard, Visit
from tests.system.browser.visitor import PHONE, Visitor

if TYPE_CHECKING:
    from playwright.sync_api import Browser

NOT_THERE = re.compile("not found|no such|there is no|unknown", re.IGNORECASE)


@dataclass(frozen=True)
class Locked:
    """An empty service that requires API keys, and its admin key."""

    url: str
    key: str


@pytest.fixture(scope="module")
def locked(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Locked]:
    """A service that requires API keys."""
    home = tmp_path_factory.mktemp("locked")
    with closing(Database(home)) as database:
        _, key = keys.create(database, "browser", ["admin"], None)
    with Server(home, warm=True, LIPSERVE_KEYS="on") as server:
        yield Locked(server.url, key)


def test_wrong_key_is_asked_for_again(windows: Visit, locked: Locked) -> None:
    visitor = windows(locked.url)
    visitor.expect_refusals(401)
    page = visitor.page
    page.goto(f"{locked.url}/#/")

    dialog = page.get_by_role("dialog", name="API key")
    expect(dialog).to_be_visible()
    expect(dialog.get_by_label("Key", exact=True)).to_be_focused()
    page.keyboard.type("lip_wrong")
    page.keyboard.press("Enter")
    expect(page.get_by_role("dialog", name="API key").get_by_label("Key", exact=True)).to_have_value("")
    page.get_by_role("dialog").get_by_label("Key", exact=True).fill(locked.key)
    page.keyboard.press("Enter")
    expect(page.get_by_role("heading", level=1)).to_be_visible()
    expect(page.get_by_text("panda-sim").first).to_be_visible()
    assert page.evaluate("Object.values(localStorage).join().includes('lip_')") is False
    page.get_by_role("button", name="Forget key").click()
    expect(page.get_by_role("dialog", name="API key")).to_be_visible()


def test_cancelled_key_dialog_does_not_open_again_by_itself(windows: Visit, locked: Locked) -> None:
    visitor = windows(locked.url)
    visitor.expect_refusals(401)
    page = visitor.page
    page.goto(f"{locked.url}/#/")

    page.get_by_role("dialog", name="API key").wait_for()
    page.keyboard.press("Escape")
    expect(page.get_by_text("API key required.").first).to_be_visible()
    with page.expect_response("**/health/ready"):
        pass
    with page.expect_response("**/health/ready"):  # two rounds later
        pass
    expect(page.get_by_role("dialog")).to_have_count(0)
    page.get_by_role("button", name="Retry").first.click()
    expect(page.get_by_role("dialog", name="API key")).to_be_visible()


@pytest.mark.journey
def test_empty_service_shows_first_steps(windows: Visit, locked: Locked) -> None:
    visitor = windows(locked.url, size=PHONE, scheme="dark", touch=True)
    visitor.page.add_init_script(f"sessionStorage.setItem('lipserve-key', {locked.key!r})")

    page = visitor.open("#/")
    expect(page.get_by_role("link", name="Upload a recording").first).to_be_visible()
    expect(page.get_by_text("lipserve simulate panda panda.csv")).to_be_visible()
    for route in ("#/data", "#/jobs", "#/train"):
        page = visitor.open(route)
        expect(page.locator("main .empty").first).to_be_visible()
        assert visitor.overflow() <= 0, route
        assert audit(page) == [], route


def test_missing_pages_and_objects_are_reported(visitor: Visitor) -> None:
    visitor.expect_refusals(404)
    for route in ("#/data/ds_0000000000000000", "#/jobs/job_0000000000000000", "#/models/nobody", "#/live/nobody"):
        page = visitor.open(route)
        expect(page.locator("main").get_by_text(NOT_THERE).first).to_be_visible()
    expect(visitor.open("#/nowhere").get_by_text("does not exist")).to_be_visible()


def test_overview_reports_a_lost_service(windows: Visit, dashboard: Dashboard) -> None:
    visitor = windows(dashboard.server.url)
    page = visitor.open("#/")
    expect(page.get_by_role("region", name="Health").get_by_role("status")).to_contain_text("ready")

    visitor.context.set_offline(True)
    expect(page.get_by_role("region", name="Health").get_by_role("status")).to_contain_text("no connection")
    expect(page.get_by_text("last response")).to_be_visible()
    expect(page.get_by_text("Last update:")).to_be_visible()
    visitor.context.set_offline(False)
    expect(page.get_by_role("region", name="Health").get_by_role("status")).to_contain_text("ready")
    expect(page.get_by_text("Last update:")).to_have_count(0)
    visitor.problems = [problem for problem in visitor.problems if "ERR_INTERNET_DISCONNECTED" not in problem]


def test_api_reference_works_under_its_content_security_policy(windows: Visit, dashboard: Dashboard) -> None:
    visitor = windows(dashboard.server.url)
    page = visitor.page
    page.goto(f"{dashboard.server.url}/docs")
    page.get_by_text("Check that the service is ready").click()
    page.get_by_role("button", name="Try it out").click()
    page.get_by_role("button", name="Execute").click()
    expect(page.get_by_text("can be read and written").first).to_be_visible()
