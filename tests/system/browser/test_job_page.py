"""Page of a job: steps, objective, times, result."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from tests.system.browser.accessibility import audit, expect
from tests.system.browser.conftest import Dashboard
from tests.system.browser.visitor import Visitor

if TYPE_CHECKING:
    from playwright.sync_api import Page, Route

ID = "job_told"
CURVES = "[...document.querySelectorAll('.objective.js-plotly-plot')].map(({data}) => data.map(({x, y}) => [x, y]))"
TICKS = "[...document.querySelectorAll('.objective .xtick text')].map((each) => each.textContent)"


def at(stage: str, estimator: str | None = None, iteration: int = 0, objective: float | None = None) -> dict[str, Any]:
    """Return the progress of a job."""
    progress = {"stage": stage, "estimator": estimator, "iteration": iteration, "max_iterations": 150}
    return {**progress, "objective": objective, "fraction": 0.1, "elapsed_s": 0.0, "remaining_s": None}


def told(visitor: Visitor, dashboard: Dashboard, steps: list[dict[str, Any]], **end: Any) -> Page:
    """Open the page of a job whose events are `steps`, and `end` if it has ended."""
    job = {**dashboard.job, "id": ID, "state": "running", "version": None, "estimator": "auto", "finished_at": None}
    events = [{**job, "progress": each} for each in steps]
    if end:
        events.append({**job, "progress": at("done"), **end})
    body = "".join(f"event: job\ndata: {json.dumps(each)}\n\n" for each in events)
    asked: list[Route] = []

    def answer(route: Route) -> None:
        asked.append(route)
        if len(asked) == 1:  # no answer to the next one: nothing has changed since
            route.fulfill(body=body, content_type="text/event-stream")

    visitor.page.route(f"**/v1/jobs/{ID}", lambda route: route.fulfill(json={**job, "progress": at("loading")}))
    visitor.page.route(f"**/v1/jobs/{ID}/events", answer)
    return visitor.open(f"#/jobs/{ID}")


def test_each_search_has_an_objective_with_its_own_axis(visitor: Visitor, dashboard: Dashboard) -> None:
    geometry = [at("geometry", "rigid-body", each, 560.0 - each) for each in (1, 2, 3)]
    fit = [at("hyperparameters", "rigid-body", each, 2036.0 / each) for each in (4, 5)]
    page = told(visitor, dashboard, [*geometry, *fit])
    visitor.until(lambda: len(page.evaluate(CURVES)) == 2)
    visitor.until(lambda: page.evaluate(CURVES)[1] == [[[4, 5], [509.0, 407.2]]])
    assert page.evaluate(CURVES)[0] == [[[1, 2, 3], [559.0, 558.0, 557.0]]]
    # the objective of the fit is of other samples: in one plot it would rise
    for _, values in (curve for plot in page.evaluate(CURVES) for curve in plot):
        assert values == sorted(values, reverse=True)
    expect(page.get_by_text("Within one plot, lower is a better fit.")).to_be_visible()
    expect(page.get_by_text("This page was opened during the job")).to_have_count(0)  # nothing is missing
    labels = page.evaluate(TICKS)
    assert sorted(labels) == ["1", "2", "3", "4", "5"]  # whole numbers, none twice
    assert audit(page) == []


def test_steps_of_each_estimator_are_shown(visitor: Visitor, dashboard: Dashboard) -> None:
    steps = [
        at("geometry", "rigid-body", 1, 9.0),
        at("hyperparameters", "rigid-body", 2, 8.0),
        at("posterior", "rigid-body"),
        at("hyperparameters", "lip-chain", 1, 7.0),
    ]
    page = told(visitor, dashboard, steps)
    expect(page.get_by_role("list", name="Steps of rigid-body").get_by_role("listitem")).to_have_text(
        [f"✓ {each}, done" for each in ("geometry", "fit", "posterior", "evaluating")]
    )
    chain = page.get_by_role("list", name="Steps of lip-chain").get_by_role("listitem")
    expect(chain).to_have_text(["◌ fit, now", "· posterior", "· evaluating"])
    expect(page.get_by_role("list", name="Steps of the version")).to_be_visible()


def test_no_time_is_shown_before_it_is_known(visitor: Visitor, dashboard: Dashboard) -> None:
    page = told(visitor, dashboard, [at("loading")])
    expect(page.get_by_text("started just now")).to_be_visible()
    expect(page.get_by_text("time left unknown")).to_be_visible()
    expect(page.get_by_text("µs")).to_have_count(0)


def test_result_shows_the_objective_of_the_chosen_estimator(visitor: Visitor, dashboard: Dashboard) -> None:
    steps = [
        *[at("hyperparameters", "lip-chain", each, 30.0 - each) for each in (1, 2)],
        *[at("hyperparameters", "rigid-body", each, 20.0 - each) for each in (1, 2)],
    ]
    page = told(visitor, dashboard, steps, state="succeeded", version=1)
    expect(page.get_by_role("link", name="View version 1")).to_be_visible()
    expect(page.get_by_role("img", name="Fit of lip-chain")).to_be_visible()  # of the model that the fixture trained
    assert page.evaluate(CURVES) == [[[[1, 2], [29.0, 28.0]]]]
    expect(page.get_by_role("img", name="rigid-body")).to_have_count(0)


def test_verdict_comes_before_the_figures(visitor: Visitor, dashboard: Dashboard) -> None:
    page = visitor.open(f"#/jobs/{dashboard.job['id']}")
    result = page.get_by_role("region", name="Result")
    note, figures = result.get_by_role("note"), result.get_by_role("table")
    expect(figures.get_by_role("row")).to_have_count(3)
    first, below = note.bounding_box(), figures.bounding_box()
    assert first is not None
    assert below is not None
    assert first["y"] + first["height"] <= below["y"]
    assert audit(page) == []


def test_objective_is_saved_as_csv_and_png_by_keyboard(visitor: Visitor, dashboard: Dashboard) -> None:
    page = told(visitor, dashboard, [at("hyperparameters", "lip-chain", each, 8.0 - each) for each in (1, 2)])
    visitor.until(lambda: page.evaluate(CURVES) == [[[[1, 2], [7.0, 6.0]]]])
    page.get_by_role("button", name="as CSV").focus()
    with page.expect_download() as numbers:
        page.keyboard.press("Enter")
    assert numbers.value.suggested_filename == "objective-of-lip-chain-pendulum.csv"
    lines = numbers.value.path().read_text().splitlines()
    assert lines == ['estimator,search,iteration,"objective, nats"', "lip-chain,fit,1,7", "lip-chain,fit,2,6"]
    page.get_by_role("button", name="as PNG").focus()
    with page.expect_download() as picture:
        page.keyboard.press("Enter")
    assert picture.value.path().read_bytes().startswith(b"\x89PNG")
