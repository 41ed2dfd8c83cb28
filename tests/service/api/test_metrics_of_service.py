"""/metrics beyond learning: it counts requests and jobs, and the documentation lists every metric."""

import pytest
from prometheus_client.openmetrics.parser import text_string_to_metric_families as parse_open
from prometheus_client.parser import text_string_to_metric_families as parse
from sqlalchemy import delete

from docs import metrics as table
from service.models import registry
from service.storage.database import JobRow
from service.training.metrics import JobMetrics
from tests import ROOT
from tests.docs.test_monitoring import EXPRESSIONS, METRIC
from tests.service.api.test_requests import QUERY
from tests.service.data import QUICK, queue, service_of, stream, upload
from tests.service.learning.learning_models import QUERIES, publish

DOCUMENT = ROOT / "docs/reference/metrics.md"
FAST_OPTIONS = {**QUICK, "posterior_samples": 40}
"""Options of a fit within the limits of the strict service."""
PARTS = ("_bucket", "_count")
"""Ends of the series of a histogram."""
PREDICT = "/v1/models/{model}/predict"


def scrape(api):
    """Return all samples as {(name, labels): value}."""
    families = list(parse(api.get("/metrics").text))
    return {(s.name, frozenset(s.labels.items())): s.value for family in families for s in family.samples}


def value(samples, name, **labels):
    return samples.get((name, frozenset(labels.items())), 0)


def increases(api, send_requests):
    """Return how much each sample grows during some requests."""
    before = scrape(api)
    send_requests()
    after = scrape(api)
    return {key: now - before.get(key, 0) for key, now in after.items() if now != before.get(key, 0)}


def test_documented_metrics_are_the_exported_ones(api):
    assert "\n".join(table.lines()) in DOCUMENT.read_text()
    documented = {kind.name.removesuffix("_total"): kind for kind in table.KINDS}
    shown = {family.name: family for family in parse(api.get("/metrics").text)}
    assert {name for name in shown if name.startswith("lipserve_")} == set(documented)
    for name, kind in documented.items():
        family = shown[name]
        assert (family.type, family.documentation) == (kind.kind, kind.meaning)
        for sample in family.samples:
            assert set(sample.labels) - {"le"} == set(kind.labels)
    answer = api.get("/metrics", headers={"accept": "application/openmetrics-text; version=1.0.0"})
    assert set(documented) <= {each.name for each in parse_open(answer.text)}


def test_dashboard_and_alerts_query_exported_metrics(api):
    shown = {f"{family.name}{end}" for family in parse(api.get("/metrics").text) for end in ("", "_total", *PARTS)}
    queried = {name for each in EXPRESSIONS for name, _ in METRIC.findall(each)}
    assert "process_cpu_seconds_total" in queried
    assert queried <= shown


def test_requests_are_counted_by_route_and_model(api):
    def send_requests():
        for _ in range(3):
            assert api.post("/v1/models/panda-sim/predict", json=QUERY).status_code == 200

    more = increases(api, send_requests)
    route_labels = {"method": "POST", "route": PREDICT}
    assert value(more, "lipserve_requests_total", **route_labels, status="200") == 3
    timed, labels = "lipserve_request_duration_seconds", {**route_labels, "model": "panda-sim"}
    assert value(more, f"{timed}_count", **labels) == value(more, f"{timed}_bucket", **labels, le="+Inf") == 3
    assert 0 < value(more, f"{timed}_sum", **labels) < 60


def test_errors_are_counted_by_code(api):
    def send_requests():
        assert api.post("/v1/models/panda-sim/predict", json={}).status_code == 422
        assert api.get("/v1/jobs/nobody").status_code == 404

    more = increases(api, send_requests)
    assert value(more, "lipserve_errors_total", route=PREDICT, code="invalid_request") == 1
    assert value(more, "lipserve_errors_total", route="/v1/jobs/{job}", code="not_found") == 1
    assert value(more, "lipserve_requests_total", method="POST", route=PREDICT, status="422") == 1
    # the label names an existing model, although its request was rejected
    assert value(more, "lipserve_request_duration_seconds_count", method="POST", route=PREDICT, model="panda-sim") == 1


def test_invented_names_are_no_labels(api):
    def send_requests():
        for number in range(3):
            assert api.post(f"/v1/models/made-up-{number}/predict", json=QUERY).status_code == 404
            assert api.get(f"/made-up-{number}").status_code == 404
            assert api.request(f"MADEUP{number}", "/v1/models").status_code == 405

    more = increases(api, send_requests)
    assert "made-up" not in str(more).lower()
    assert value(more, "lipserve_request_duration_seconds_count", method="POST", route=PREDICT, model="") == 3
    assert value(more, "lipserve_requests_total", method="GET", route="", status="404") == 3
    assert value(more, "lipserve_requests_total", method="other", route="/v1/models", status="405") == 3


@pytest.mark.own_files("counts the bytes of files below the home")
def test_service_reports_version_and_uptime(api):
    samples = scrape(api)
    assert value(samples, "lipserve_requests_in_flight") == 1  # this scrape
    assert service_of(api).meters.requests.in_flight.total == 0
    assert value(samples, "lipserve_models_loaded") == len(service_of(api).loaded.versions())
    assert value(samples, "lipserve_disk_used_bytes", what="versions") > 1000
    assert value(samples, "lipserve_disk_free_bytes") > 0
    assert value(samples, "process_resident_memory_bytes") > 1e7
    assert value(samples, "lipserve_ready", part="database") == 1


BEGAN = "2026-01-01T00:00:00.000+00:00"
ENDED = [
    ("succeeded", BEGAN, "2026-01-01T00:00:20.000+00:00"),
    ("succeeded", BEGAN, "2026-01-01T02:00:00.000+00:00"),
    ("failed", BEGAN, "2026-01-01T00:00:00.500+00:00"),
    ("failed", "2026-01-01T00:00:01.000+00:00", BEGAN),  # the clock was set back
    ("cancelled", None, BEGAN),
]


@pytest.fixture
def jobs(api):
    """Job metrics before and after jobs of known durations ended; the jobs are rows in the database."""
    database = service_of(api).database
    before = families(database)
    with database.transaction() as session:
        for number, (state, started, finished) in enumerate(ENDED):
            row = JobRow(id=f"job_metrics_{number}", model="m", state=state, request={}, progress={}, created_at=BEGAN)
            row.started_at, row.finished_at = started, finished
            session.add(row)
    yield before, families(database)
    with database.transaction() as session:
        session.execute(delete(JobRow).where(JobRow.id.startswith("job_metrics_")))


def families(database):
    return {
        (sample.name, *sample.labels.values()): sample.value
        for family in JobMetrics(database).collect()
        for sample in family.samples
    }


def test_jobs_are_counted_and_timed_by_outcome(jobs):
    before, after = jobs
    more = {key: now - before[key] for key, now in after.items()}
    name = JobMetrics.duration.name
    finished = {state: more[JobMetrics.finished.name, state] for state in ("succeeded", "failed", "cancelled")}
    assert finished == {"succeeded": 2, "failed": 2, "cancelled": 1}
    buckets = {"10.0": 0, "30.0": 1, "3600.0": 1, "10800.0": 2, "+Inf": 2}
    assert {le: more[f"{name}_bucket", "succeeded", le] for le in buckets} == buckets
    assert more[f"{name}_sum", "succeeded"] == pytest.approx(7220.0, abs=1e-3)
    assert more[f"{name}_bucket", "failed", "1.0"] == 2
    assert more[f"{name}_sum", "failed"] == pytest.approx(0.5, abs=1e-3)
    assert more[f"{name}_count", "cancelled"] == 0  # it never started


def test_waiting_jobs_are_counted(no_worker):
    database = service_of(no_worker).database

    def waiting():
        return families(database)[JobMetrics.jobs.name, "queued"]

    before = waiting()
    job = queue(no_worker, "waits-for-metrics", upload(no_worker, stream())["id"], options=FAST_OPTIONS)["id"]
    assert waiting() == before + 1
    assert no_worker.post(f"/v1/jobs/{job}/cancel").json()["state"] == "cancelled"
    assert waiting() == before


def test_deleted_model_leaves_no_label_and_its_requests_stay_counted(api, trained):
    service = service_of(api)
    folder = service.files.version_folder(registry.find(service.database, trained.name, 1).folder)
    publish(service.database, service.files, folder, "brief")

    def send_requests():
        assert api.post("/v1/models/brief/predict", json=QUERIES).status_code == 200
        assert any(("model", "brief") in labels for _, labels in scrape(api))
        assert api.delete("/v1/models/brief").status_code == 204

    found = increases(api, send_requests)
    assert value(found, "lipserve_requests_total", method="POST", route=PREDICT, status="200") == 1
    deleted = {"method": "DELETE", "route": "/v1/models/{model}", "status": "204"}
    assert value(found, "lipserve_requests_total", **deleted) == 1
    assert not any(("model", "brief") in labels for _, labels in scrape(api))
