"""Metrics for Prometheus: its own parser reads them, and they say what the other routes say."""

from __future__ import annotations

import pytest
from prometheus_client import REGISTRY
from prometheus_client.openmetrics.parser import text_string_to_metric_families as parse_open
from prometheus_client.parser import text_string_to_metric_families as parse

from lipcore.vocabulary import CODES
from service.journal import log
from tests.service.learning.lessons import lesson

GAUGES = {
    "lipserve_quality_nmse",
    "lipserve_quality_coverage",
    "lipserve_quality_nlpd",
    "lipserve_revision",
    "lipserve_novel_share",
    "lipserve_learning_lag_events",
}


def scraped(school, model):
    """Samples of one model, {(name, the other labels): value}."""
    answer = school.client.get("/metrics")
    assert answer.status_code == 200
    assert answer.headers["content-type"].startswith("text/plain")
    samples = {}
    for family in parse(answer.text):
        assert family.documentation
        for sample in family.samples:
            if sample.labels.pop("model", None) == model:
                samples[sample.name, *sorted(sample.labels.items())] = sample.value
    return samples


def test_every_metric_is_there_with_its_kind(school):
    school.enrol("kinds").teach(0)
    kinds = {family.name: family.type for family in parse(school.client.get("/metrics").text)}
    assert kinds.items() >= (dict.fromkeys(GAUGES, "gauge") | {"lipserve_observations": "counter"}).items()


def test_quality_is_that_of_the_other_route(school):
    pupil = school.enrol("scraped")
    pupil.teach(0, 1)
    samples, seen = scraped(school, "scraped"), pupil.get("quality")
    for window in seen["windows"]:
        for name in ("nmse", "coverage", "nlpd"):
            for joint, value in zip(seen["joint_names"], window[name], strict=True):
                key = (f"lipserve_quality_{name}", ("joint", joint), ("window", f"{window['seconds']:g}"))
                assert samples[key] == pytest.approx(value, rel=1e-12)
    assert samples["lipserve_revision", ("version", "1")] == 2
    assert samples["lipserve_learning_lag_events",] == 0
    assert samples["lipserve_novel_share",] == pupil.get("learning")["status"]["novel_share"]


def test_rows_are_counted_by_what_became_of_them(school):
    pupil = school.enrol("rows")
    pupil.teach(0)
    q = lesson(1)["q"]
    q[4][0] = None
    pupil.teach(1, q=q)
    pupil.post("observations", lesson(1, q=q))  # again, which counts no row
    samples = scraped(school, "rows")
    counted = {
        dict(key[1:])["outcome"]: value for key, value in samples.items() if key[0] == "lipserve_observations_total"
    }
    assert counted == dict.fromkeys(CODES, 0) | {"learnt": 19, "non_finite": 1}


def test_what_is_not_known_is_left_out(school):
    pupil = school.enrol("left-out")
    tau = [[row[0], 0.25] for row in lesson(0)["tau"]]
    pupil.teach(0, tau=tau)
    joints = {dict(key[1:])["joint"] for key in scraped(school, "left-out") if key[0] == "lipserve_quality_nmse"}
    assert joints == {"joint1"}


def test_what_is_not_learnt_yet_is_the_lag(school):
    school.enrol("lagging").teach(0)
    with school.service.database.transaction() as session:  # which the learner is not told of
        log.append(session, "lagging", "settings", {"forgetting_s": None}, 0.0)
    assert scraped(school, "lagging")["lipserve_learning_lag_events",] == 1


def test_openmetrics_is_answered_where_it_is_accepted(school):
    answer = school.client.get("/metrics", headers={"accept": "application/openmetrics-text; version=1.0.0"})
    assert answer.headers["content-type"].startswith("application/openmetrics-text")
    assert {family.name for family in parse_open(answer.text)} >= GAUGES


def test_nothing_is_kept_outside_the_service(school):
    school.client.get("/metrics")
    assert not [family.name for family in REGISTRY.collect() if family.name.startswith("lipserve")]
