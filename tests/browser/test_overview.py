"""The overview: live health, what runs, what is there, and what to do next."""

from __future__ import annotations

import re

import pytest

from tests.browser.accessibility import audit
from tests.browser.conftest import Dashboard
from tests.browser.looking import expect
from tests.browser.visitor import Visitor
from tests.service.data import ENDLESS, queue, stream, upload


def test_it_tells_that_the_service_is_well_and_what_there_is(visitor: Visitor) -> None:
    page = visitor.open("#/")

    expect(page.get_by_role("region", name="Health").get_by_role("status")).to_contain_text("ready")
    expect(page.get_by_role("region", name="Health").get_by_text("database")).to_be_visible()
    expect(page.get_by_role("link", name="Data sets")).to_contain_text(re.compile("[1-9]"))
    models = page.get_by_role("region", name="Newest models")
    first = models.get_by_role("link").first
    first.focus()
    assert audit(page) == []
    with page.expect_response("**/v1/jobs"), page.expect_response("**/health/ready"):
        pass
    expect(first).to_be_focused()  # looking again takes it from nobody


@pytest.mark.slow
def test_a_job_s_progress_is_seen_as_it_runs(visitor: Visitor, dashboard: Dashboard) -> None:
    page = visitor.open("#/")
    dataset = upload(dashboard.client, stream("ur5", samples=200), name="slow.npz")
    job = queue(dashboard.client, "slow-one", dataset["id"], options=ENDLESS)

    row = page.get_by_role("listitem").filter(has_text="slow-one")
    expect(row.get_by_role("progressbar")).to_be_visible()
    expect(row).to_contain_text("at most about")
    assert dashboard.client.post(f"/v1/jobs/{job['id']}/cancel").status_code == 200
    expect(row).to_contain_text("cancelled")
