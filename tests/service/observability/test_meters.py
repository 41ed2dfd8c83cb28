"""What is counted: in the right bucket, and without labels that clients could make up."""

from __future__ import annotations

import pytest

from service.web.observability.meters import BOUNDS, OTHER, Durations, Kind, Meters, MetricKind, RequestMeter, merged


def test_a_duration_counts_up_to_its_bound():
    durations = Durations((0.1, 1.0))
    for seconds in (0.0, 0.1, 0.1000001, 1.0, 5.0):
        durations.add(seconds)
    assert durations.counts == [2, 2, 1]
    assert durations.total == pytest.approx(6.2000001)


def test_histograms_are_cumulative():
    durations = Durations((0.1, 1.0))
    for seconds in (0.05, 0.5, 5.0):
        durations.add(seconds)
    family = MetricKind("histogram", "h_seconds", "said", ("a",)).spread([(["x"], durations)])
    found = {(sample.name, sample.labels.get("le")): sample.value for sample in family.samples}
    assert found == {
        ("h_seconds_bucket", "0.1"): 1,
        ("h_seconds_bucket", "1.0"): 2,
        ("h_seconds_bucket", "+Inf"): 3,
        ("h_seconds_count", None): 3,
        ("h_seconds_sum", None): pytest.approx(5.55),
    }


def test_merged_durations_are_those_of_all():
    one, two = Durations(), Durations()
    one.add(BOUNDS[0])
    two.add(BOUNDS[0])
    two.add(1e9)
    both = merged([one, two])
    assert (both.counts[0], both.counts[-1], both.total) == (2, 1, pytest.approx(1e9))


def test_what_clients_make_up_is_not_told_apart():
    meter = RequestMeter(most_models=10)
    for number in range(100):
        meter.find(Kind(f"M{number}", "/r", f"model-{number}", 404, "not_found"), exists=False).add(0.1)
    ((kind, durations),) = meter.known.items()
    assert kind == (OTHER, "/r", "", 404, "not_found")
    assert sum(durations.counts) == 100


def test_models_beyond_the_most_are_taken_together():
    meter = RequestMeter(most_models=2)
    for name in ("a", "b", "c", "d", "a", ""):
        meter.find(Kind("GET", "/r", name, 200, ""), exists=True).add(0.1)
    assert {kind[2]: sum(each.counts) for kind, each in meter.known.items()} == {"a": 2, "b": 1, OTHER: 2, "": 1}


def test_streams_share_the_models_of_requests():
    meters = Meters(most_models=1)
    meters.requests.find(Kind("GET", "/r", "a", 200, ""), exists=True)
    assert meters.stream("b") is meters.stream("c")
    assert meters.stream("a") is not meters.stream("b")
    assert set(meters.streams()) == {"a", OTHER}
