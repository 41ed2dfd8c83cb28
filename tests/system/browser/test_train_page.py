"""Training form: estimators, selection of recordings, defaults."""

from __future__ import annotations

import re

from lipcore.estimators.catalogue import ESTIMATORS
from tests.service.data import stream, upload
from tests.system.browser.accessibility import audit, expect
from tests.system.browser.conftest import Dashboard
from tests.system.browser.visitor import Visitor


def test_two_estimators_are_visible_and_the_others_folded(visitor: Visitor, dashboard: Dashboard) -> None:
    upload(dashboard.client, stream("panda", samples=60, seed=41), name="known-arm.npz", robot="panda")
    page = visitor.open("#/train")
    estimators = page.get_by_role("group", name="Estimator")
    seen = [each.get_attribute("value") for each in estimators.get_by_role("radio").filter(visible=True).all()]
    assert seen == ["auto", "rigid-body"]
    expect(estimators.get_by_role("radio", name=re.compile("^auto"))).to_be_checked()
    page.get_by_label("Train on known-arm.npz").check()
    expect(estimators.get_by_role("radio", name=re.compile("^rigid-body with .*[Pp]anda"))).to_be_visible()
    estimators.get_by_text("More estimators").click()
    known = {each.get_attribute("value") for each in estimators.get_by_role("radio").filter(visible=True).all()}
    assert known == {"auto", *ESTIMATORS}
    assert audit(page) == []


def test_selected_recordings_stay_selected_while_filtering(visitor: Visitor, dashboard: Dashboard) -> None:
    for number in range(3):
        upload(dashboard.client, stream(samples=60, seed=50 + number), name=f"shift-{number}.npz")
    page = visitor.open("#/train")
    page.get_by_role("searchbox", name="Filter recordings").fill("shift-1")
    rows = page.get_by_role("table", name="Recordings, newest first").locator("tbody tr")
    expect(rows).to_have_count(1)
    page.get_by_label("Train on shift-1.npz").check()
    page.get_by_role("searchbox").fill("shift")
    expect(rows).to_have_count(3)
    expect(page.get_by_label("Train on shift-1.npz")).to_be_checked()
    page.get_by_role("button", name="Recording", exact=True).click()
    names = [each.inner_text() for each in rows.get_by_role("link").all()]
    assert names == ["shift-0.npz", "shift-1.npz", "shift-2.npz"]
    expect(page.get_by_text("1 selected, 60 samples.")).to_be_visible()
    assert audit(page) == []


def test_form_has_the_defaults_of_the_api(visitor: Visitor, dashboard: Dashboard) -> None:
    body = {"model": "defaults", "datasets": [dashboard.dataset["id"]], "estimator": "lip-chain"}
    asked = dashboard.client.post("/v1/jobs", json=body).json()
    dashboard.client.post(f"/v1/jobs/{asked['id']}/cancel")
    assert asked["holdout"]["share"] == 0.3
    page = visitor.open(f"#/train?datasets={dashboard.dataset['id']}&model=defaults")
    page.get_by_role("button", name="Start training").click()
    expect(page.get_by_role("heading", level=1, name="Training defaults")).to_be_visible()
    job = dashboard.client.get(f"/v1/jobs/{page.url.rpartition('/')[2]}").json()
    assert (job["holdout"], job["promotion"]) == (asked["holdout"], asked["promotion"])
    dashboard.client.post(f"/v1/jobs/{job['id']}/cancel")
