"""Data sets and jobs in the browser: rejected upload, episodes, deletion, cancelled and retried job."""

import re
from dataclasses import replace

import numpy as np

from lipcore.estimators.catalogue import ESTIMATORS
from lipcore.robots.library import profile_urdf
from lipcore.robots.urdf_units import scaled
from lipcore.vocabulary import ROBOT_ESTIMATORS
from tests.service.data import ENDLESS, arrays, columns, csv, ended, job, npz, queue, stream, upload
from tests.system.browser.accessibility import audit, expect
from tests.system.browser.conftest import Dashboard
from tests.system.browser.visitor import Visitor

LONG = {**ENDLESS, "hyperparameter_samples": 250, "starts": 1}
"""Options of a long fit with short iterations."""
SET_DEGREES = "Set the unit of q to deg and retry"


def file(name: str, body: bytes) -> dict[str, object]:
    """Return a file in Playwright's format."""
    return {"name": name, "mimeType": "application/octet-stream", "buffer": body}


def test_rejected_recording_is_imported_with_the_proposed_option(visitor: Visitor, dashboard: Dashboard) -> None:
    visitor.expect_refusals(422)
    table = columns(stream(seed=11))
    for joint in (1, 2):
        table[f"q{joint}"] = [f"{np.rad2deg(float(value)) + 180:.12g}" for value in table[f"q{joint}"]]
    page = visitor.open("#/data")
    page.get_by_label("Recordings to upload").set_input_files([file("degrees.csv", csv(table))])
    page.get_by_label("Name", exact=True).fill("in degrees")
    page.get_by_role("button", name="Upload", exact=True).click()

    refusal = page.get_by_role("alert")
    expect(refusal).to_contain_text("degrees.csv could not be imported. Nothing was stored.")
    expect(refusal).to_contain_text("if these are degrees")
    assert audit(page) == []
    refusal.get_by_role("button", name=SET_DEGREES).click()
    expect(page.get_by_text("in degrees: 80 samples of 2 joints")).to_be_visible()
    expect(page.get_by_text("q is converted from deg").first).to_be_visible()
    expect(page.get_by_label("Unit of position")).to_have_value("")  # the option applies to this file only

    page.get_by_role("link", name="View report").click()
    visitor.settled()
    page.get_by_role("button", name="Delete").click()
    page.get_by_role("dialog").get_by_role("button", name="Cancel").click()
    expect(page.get_by_role("heading", level=1, name="in degrees")).to_be_visible()
    page.get_by_role("button", name="Delete").click()
    page.get_by_role("dialog").get_by_role("button", name="Delete").click()
    expect(page.get_by_role("heading", level=1, name="Data sets")).to_be_visible()
    visitor.settled()
    names = {each["name"] for each in dashboard.client.get("/v1/datasets").json()["items"]}
    assert "in degrees" not in names
    assert "pendulum.npz" in names


def test_urdf_in_other_units_is_added_with_the_proposed_scale(visitor: Visitor, dashboard: Dashboard) -> None:
    visitor.expect_refusals(422)
    exported = scaled(profile_urdf("kinova"), {"length": 1e3, "inertia": 1e6})
    page = visitor.open("#/data")
    page.get_by_text("Import options: robot").click()
    page.get_by_label("URDF to upload").set_input_files([file("arm.urdf", exported.encode())])
    expect(page.get_by_text("This fits length in mm, inertia in kg·mm²").first).to_be_visible()
    assert audit(page) == []
    page.get_by_role("button", name="Upload in these units").click()
    expect(page.get_by_text(re.compile("added, 6 joints"))).to_be_visible()
    for robot in dashboard.client.get("/v1/robots").json()["items"]:
        dashboard.client.delete(f"/v1/robots/{robot['id']}")


def test_import_options_set_how_a_file_is_read(visitor: Visitor) -> None:
    samples = stream(seed=12)
    body = npz(**{**arrays(samples), "tau": samples.tau / np.array([2.0, 4.0])})
    page = visitor.open("#/data")
    page.get_by_text("Import options: robot").click()
    constants = page.get_by_label("Torque constants, N·m/A")
    expect(constants).to_be_hidden()
    page.get_by_label("Meaning of the torque column").select_option("current")
    constants.fill("2, 4")
    page.get_by_label("Joint names").fill("shoulder, elbow")
    page.get_by_label("Recordings to upload").set_input_files([file("current.npz", body)])
    expect(page.get_by_text("Import options: Meaning")).to_contain_text("Torque constants: 2, 4")
    assert audit(page) == []
    page.get_by_role("button", name="Upload", exact=True).click()
    page.get_by_role("link", name="View report").click()
    expect(page.get_by_role("heading", level=1, name="current.npz")).to_be_visible()
    page.get_by_role("tab", name="Preparation").click()
    expect(page.get_by_text("torque is motor current times the torque constants 2, 4 N·m/A")).to_be_visible()
    page.get_by_text("samples of 2 joints").click()
    expect(page.get_by_text("Joints: shoulder, elbow")).to_be_visible()


def test_files_are_dropped_below_the_options_that_they_obey(visitor: Visitor) -> None:
    page = visitor.open("#/data")
    card = page.get_by_role("region", name="Upload a recording")
    options = card.get_by_text("Import options: robot").bounding_box()
    zone = card.get_by_text("Drop recordings anywhere").bounding_box()
    assert options is not None
    assert zone is not None
    assert options["y"] + options["height"] <= zone["y"]


def test_list_shows_the_worst_finding_of_a_recording(visitor: Visitor, dashboard: Dashboard) -> None:
    samples = stream("panda", samples=300, seed=15)
    upload(dashboard.client, replace(samples, tau=-samples.tau), name="reversed", robot="panda")
    report = dashboard.client.get("/v1/datasets/reversed").json()["report"]
    assert report["remedies"][0]["cause"] == "torque_sign"
    page = visitor.open("#/data")
    row = page.get_by_role("table", name="Recordings").get_by_role("row").filter(has_text="reversed")
    expect(row).to_contain_text(report["remedies"][0]["text"].partition(". ")[0])
    expect(row).to_contain_text(re.compile("[1-9] more"))
    expect(row.get_by_text("warning")).to_be_visible()
    row.get_by_role("link", name="Read again: reversed").click()
    expect(page.get_by_role("tab", name="Read again", selected=True)).to_be_visible()
    page.get_by_role("button", name="Read again with").first.click()
    expect(page).not_to_have_url(re.compile("tab=again"))
    expect(page.get_by_role("heading", level=1, name="reversed")).to_be_visible()
    again = dashboard.client.get("/v1/datasets/reversed").json()["report"]
    assert "torque_sign" not in {each["cause"] for each in again["remedies"]}


def test_lines_have_gaps_between_episodes(visitor: Visitor, dashboard: Dashboard) -> None:
    samples = stream(seed=13, samples=120)
    episode = np.repeat([0, 1], 60)
    body = npz(**{**arrays(samples), "t": np.tile(samples.t[:60], 2)}, episode=episode)
    answer = dashboard.client.post(
        "/v1/datasets", content=body, headers={"content-type": "application/x-npz"}, params={"name": "two episodes"}
    )
    assert answer.status_code == 201, answer.text
    page = visitor.open(f"#/data/{answer.json()['id']}")
    expect(page.locator(".strip .linked")).to_have_count(4)
    # the time of each episode starts again, so episodes would overlap
    expect(page.get_by_label("Horizontal axis", exact=True)).to_have_value("rows")
    breaks = "[...document.querySelectorAll('.js-plotly-plot')].map((each) => each.data.map(({y}) => y.indexOf(null)))"
    assert page.evaluate(breaks) == [[60, 60]] * 4
    page.get_by_label("Joint", exact=True).select_option(samples.joint_names[0])
    page.wait_for_function("document.querySelector('.js-plotly-plot').data.length === 1")


def test_form_offers_every_estimator(visitor: Visitor) -> None:
    page = visitor.open("#/train")
    page.get_by_text("Options", exact=True).click()
    assert [each.get_attribute("value") for each in page.get_by_role("radio").all()] == list(
        dict.fromkeys(["auto", "rigid-body", "rigid-body+local", "lip-chain", "rigid-body+lip-chain", *ESTIMATORS])
    )
    for name in ESTIMATORS:
        page.locator(f'input[type=radio][value="{name}"]').check()
        robot = page.get_by_label("Robot", exact=True)
        expect(robot).to_be_enabled() if name in ROBOT_ESTIMATORS else expect(robot).to_be_disabled()
    page.get_by_role("radio", name="auto (default)").check()
    expect(page.get_by_label("Robot", exact=True)).to_be_enabled()
    page.get_by_label("Model name").fill("refused")
    page.get_by_role("button", name="Start training").click()
    expect(page.get_by_role("alert")).to_contain_text("Choose at least one recording")


def test_job_page_survives_lost_connection_cancel_and_retry(visitor: Visitor, dashboard: Dashboard) -> None:
    client = dashboard.client
    dataset = upload(client, stream("ur5", samples=400), name="ur5.npz")
    first = queue(client, "stopped", dataset["id"], options=LONG)["id"]
    page = visitor.open("#/")
    row = page.get_by_role("listitem").filter(has_text="stopped")
    expect(row.get_by_role("progressbar")).to_be_visible()
    expect(row).to_contain_text("up to")
    page.route("**/events", lambda route: route.abort())
    visitor.open(f"#/jobs/{first}")
    expect(page.get_by_text("Connection to the service lost")).to_be_visible()
    page.unroute("**/events")
    expect(page.get_by_text("up to")).to_be_visible()
    expect(page.get_by_text("Connection to the service lost")).to_be_hidden()
    expect(page.get_by_role("progressbar", name="Training progress")).to_be_visible()

    page.get_by_role("button", name="Cancel training").click()
    page.get_by_role("dialog").get_by_role("button", name="Cancel training").click()
    again = page.get_by_role("button", name="Retry")
    expect(again).to_be_visible()
    assert ended(client, first)["state"] == "cancelled"
    again.click()
    expect(page).to_have_url(re.compile(rf"#/jobs/(?!{first})"))
    second = page.url.rpartition("/")[2]
    expect(page.get_by_role("link", name="an earlier job")).to_have_attribute("href", f"#/jobs/{first}")
    client.post(f"/v1/jobs/{second}/cancel")
    expect(again).to_be_visible()
    assert job(client, second)["retry_of"] == first
    visitor.problems = [
        problem for problem in visitor.problems if "net::ERR_FAILED" not in problem
    ]  # caused by this test
