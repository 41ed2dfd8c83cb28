"""Training form: estimators, selection of recordings, defaults."""

from __future__ import annotations

import re

from lipcore.estimators.catalogue import ESTIMATORS
from tests.service.data import stream, upload
from tests.system.browser.accessibility import audit, expect
from tests.system.browser.conftest import Dashboard
from tests.system.browser.visitor import Visitor


def test_only_recordings_name_robot_and_start_are_open(visitor: Visitor) -> None:
    page = visitor.open("#/train")
    controls = page.locator("form").locator("select, textarea, input, button")
    expect(page.get_by_label("Robot", exact=True).locator("option")).not_to_have_count(1)
    names = {each.get_attribute("name") for each in controls.filter(visible=True).all()}
    assert names <= {"datasets", "model", "robot", None}
    page.get_by_text("Options", exact=True).click()
    expect(page.get_by_label("max iterations", exact=True)).to_be_visible()
    for label in ("Which part", "Start serving the new version", "Start from another unit", "Joint types"):
        expect(page.get_by_label(label, exact=True)).to_be_visible()
    estimators = page.get_by_role("group", name="Estimator")
    known = {each.get_attribute("value") for each in estimators.get_by_role("radio").filter(visible=True).all()}
    assert known == {"auto", *ESTIMATORS}
    expect(estimators.get_by_role("radio", name=re.compile("^auto"))).to_be_checked()
    assert audit(page) == []


def test_robot_of_the_recording_is_selected(visitor: Visitor, dashboard: Dashboard) -> None:
    given = upload(dashboard.client, stream("panda", samples=60, seed=41), name="known-arm.npz", robot="panda")["id"]
    page = visitor.open(f"#/train?datasets={given}&model=known-arm")
    robot = page.get_by_label("Robot", exact=True)
    expect(robot).to_have_value("panda")
    page.get_by_label("Train on known-arm.npz").uncheck()
    expect(robot).to_have_value("")
    page.get_by_label("Train on known-arm.npz").check()
    expect(robot).to_have_value("panda")
    with page.expect_request("**/v1/jobs") as asked:
        page.get_by_role("button", name="Start training").click()
    expect(page.get_by_role("heading", level=1, name="Training known-arm")).to_be_visible()
    dashboard.client.post(f"/v1/jobs/{page.url.rpartition('/')[2]}/cancel")
    assert asked.value.post_data_json["robot"] == "panda"
    robot = visitor.open(f"#/train?datasets={given}").get_by_label("Robot", exact=True)
    robot.select_option("")
    expect(robot).to_have_value("")  # a choice is kept


def test_what_cannot_be_chosen_tells_why(visitor: Visitor, dashboard: Dashboard) -> None:
    upload(dashboard.client, stream("panda", samples=60, seed=41), name="seven-joints.npz")
    page = visitor.open(f"#/train?datasets={dashboard.dataset['id']}")
    row = page.get_by_role("table", name="Recordings").get_by_role("row").filter(has_text="seven-joints.npz")
    expect(row.get_by_role("checkbox")).to_be_disabled()
    expect(row).to_contain_text("cannot be added: 7 joints, not 2")
    chosen = page.get_by_role("checkbox", name="Train on pendulum.npz")
    expect(page.get_by_role("table", name="Recordings").get_by_role("checkbox").first).to_be_checked()  # is in view
    chosen.uncheck()
    expect(row.get_by_role("checkbox")).to_be_enabled()
    page.get_by_text("Options", exact=True).click()
    page.get_by_role("radio", name=re.compile("^lip-chain")).check()
    expect(page.get_by_label("Robot", exact=True)).to_be_disabled()
    expect(page.get_by_text("lip-chain does not start from a robot")).to_be_visible()
    expect(page.get_by_label("Start from another unit")).to_be_disabled()
    expect(page.get_by_text("lip-chain does not start from another version")).to_be_visible()
    assert audit(page) == []


def test_invalid_value_of_a_folded_option_is_shown(visitor: Visitor, dashboard: Dashboard) -> None:
    page = visitor.open(f"#/train?datasets={dashboard.dataset['id']}&model=folded")
    page.get_by_text("Options", exact=True).click()
    page.get_by_label("Share, %").fill("95")
    page.get_by_text("Options", exact=True).click()
    expect(page.get_by_label("Share, %")).to_be_hidden()
    page.get_by_role("button", name="Start training").click()
    expect(page.get_by_label("Share, %")).to_be_focused()


def test_selected_recordings_stay_selected_while_filtering(visitor: Visitor, dashboard: Dashboard) -> None:
    for number in range(3):
        upload(dashboard.client, stream(samples=60, seed=50 + number), name=f"shift-{number}.npz")
    page = visitor.open("#/train")
    page.get_by_role("searchbox", name="Filter recordings").fill("shift-1")
    rows = page.get_by_role("table", name="Recordings").locator("tbody tr")
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
