"""Notes and tags of versions on the tab of versions, by keyboard alone."""

from __future__ import annotations

import re

from tests.service.data import train
from tests.system.browser.accessibility import audit, expect
from tests.system.browser.conftest import Dashboard
from tests.system.browser.visitor import Visitor

NOTE = "old gripper <b>7 kg</b>"


def test_note_and_tags_are_edited_in_place(visitor: Visitor, dashboard: Dashboard) -> None:
    train(dashboard.client, "noted", dashboard.dataset["id"])
    page = visitor.open("#/models/noted?tab=versions")
    edit = page.get_by_role("button", name=re.compile("^(Add|Edit) note: version 1$"))

    def stored() -> list[object]:
        version = dashboard.client.get("/v1/models/noted/versions/1").json()
        return [version["note"], version["tags"]]

    edit.focus()
    page.keyboard.press("Enter")
    expect(page.get_by_label("Note", exact=True)).to_be_focused()
    assert audit(page) == []
    page.keyboard.type(NOTE)
    page.keyboard.press("Tab")
    page.keyboard.type("line 2, ros")
    page.keyboard.press("Enter")
    expect(page.get_by_text("Note of version 1 saved.")).to_be_visible()
    expect(page.get_by_text(NOTE, exact=True)).to_have_count(2)  # in the heading and in the table
    expect(edit).to_be_focused()
    assert stored() == [NOTE, ["line 2", "ros"]]
    assert audit(page) == []

    edit.press("Enter")
    page.get_by_label("Tags", exact=True).fill("x" * 41)
    visitor.expect_refusals(422)
    page.get_by_role("button", name="Save").click()
    expect(page.locator(".notice.bad")).to_contain_text("at most 40 characters")
    page.get_by_label("Tags", exact=True).press("Escape")
    expect(page.get_by_text("ros", exact=True).first).to_be_visible()

    edit.press("Enter")
    page.get_by_label("Note", exact=True).fill("")
    page.get_by_label("Tags", exact=True).fill("")
    page.get_by_role("button", name="Save").click()
    expect(page.get_by_text(NOTE, exact=True)).to_have_count(0)
    assert stored() == [None, []]
