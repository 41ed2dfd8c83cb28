"""Velocities and accelerations that were not recorded are derived, close to the true ones, and said to be derived."""

from __future__ import annotations

import numpy as np
import pytest

from tests.service.data import arrays, csv, error, npz, post, stream
from tests.service.data import columns as table_of
from tests.service.test_upload_formats import created, stored

RATES = (30.0, 50.0, 100.0)


def fine(rate, noise=0.0):
    return stream(samples=int(12 * rate), rate=rate, noise=noise)


def relative_error(derived, true, name):
    """Root mean square of the error over the spread, worst joint, at the times that were kept."""
    rows = np.searchsorted(true.t, derived.t - 1e-9)
    np.testing.assert_allclose(true.t[rows], derived.t, atol=1e-9)
    wrong = getattr(derived, name) - getattr(true, name)[rows]
    return float((np.sqrt(np.mean(wrong**2, axis=0)) / getattr(true, name).std(axis=0)).max())


@pytest.mark.parametrize("rate", RATES)
def test_both_are_close_to_the_true_ones(api, rate):
    true = fine(rate)
    dataset = created(post(api, npz(**arrays(true, "t", "q", "tau"))))
    derived = stored(api, dataset)
    assert dataset["report"]["derived"] == ["dq", "ddq"]
    for name, tolerance in (("q", 0.001), ("dq", 0.01), ("ddq", 0.03), ("tau", 0.001)):
        assert relative_error(derived, true, name) < tolerance


def test_acceleration_alone_is_derived_from_the_recorded_velocity(api):
    true = fine(50.0)
    dataset = created(post(api, npz(**arrays(true, "t", "q", "dq", "tau"))))
    assert dataset["report"]["derived"] == ["ddq"]
    assert relative_error(stored(api, dataset), true, "ddq") < 0.02


def test_recorded_acceleration_is_kept_where_velocity_is_derived(api):
    true = fine(50.0)
    dataset = created(post(api, npz(**arrays(true, "t", "q", "ddq", "tau"))))
    derived = stored(api, dataset)
    assert dataset["report"]["derived"] == ["dq"]
    assert relative_error(derived, true, "dq") < 0.01
    np.testing.assert_array_equal(derived.ddq, true.ddq[13:-13])


def test_csv_without_them_gives_the_samples_that_npz_gives(api):
    true = fine(50.0)
    table = {name: values for name, values in table_of(true).items() if name.strip("0123456789") not in ("dq", "ddq")}
    from_csv = created(post(api, csv(table), "text/csv"))
    from_npz = created(post(api, npz(**arrays(true, "t", "q", "tau"))))
    assert from_csv["sha256"] == from_npz["sha256"]


def test_every_step_is_reported(api):
    report = created(post(api, npz(**arrays(fine(50.0), "t", "q", "tau")), cutoff=5))["report"]
    assert report["preparation"] == [
        "q, tau low-passed at 5 Hz without delay",
        "dq and ddq derived by central differences",
        "20 samples cut off at the filter's edges",
    ]
    assert report["rows_uploaded"] == 600
    assert report["rows"] == 580


def test_a_lower_cutoff_keeps_more_noise_out(api):
    true = fine(100.0)
    noisy = {**arrays(true, "t", "tau"), "q": true.q + 1e-4 * np.random.default_rng(3).standard_normal(true.q.shape)}
    errors = [
        relative_error(stored(api, created(post(api, npz(**noisy), cutoff=cutoff))), true, "ddq") for cutoff in (2, 20)
    ]
    assert errors[0] < 0.2 * errors[1]


def test_jitter_of_the_clock_is_tolerated(api):
    true = fine(50.0)
    t = true.t + np.random.default_rng(1).uniform(-0.1, 0.1, len(true)) / 50
    assert created(post(api, npz(**arrays(true, "q", "tau"), t=t)))["report"]["derived"] == ["dq", "ddq"]


def test_uneven_steps_are_put_on_an_even_clock_where_something_is_derived(api):
    true = fine(50.0)
    t = true.t.copy()
    t[41:] += 0.4 / 50
    report = created(post(api, npz(**arrays(true, "q", "tau"), t=t)))["report"]
    assert report["preparation"][0].startswith("put on an even clock")
    untouched = created(post(api, npz(**arrays(true, "q", "dq", "ddq", "tau"), t=t)))["report"]
    assert (untouched["derived"], untouched["preparation"]) == ([], [])


def test_missing_times_are_refused_where_something_is_derived(api):
    said = error(post(api, npz(**arrays(fine(50.0), "q", "tau"))), 422, "invalid_data")
    assert said["detail"] == [
        {"field": "t", "value": "missing", "expected": "times, since dq and ddq must be derived"},
    ]


def test_a_cutoff_above_half_the_rate_is_refused(api):
    said = error(post(api, npz(**arrays(fine(30.0), "t", "q", "tau")), cutoff=16), 422, "invalid_data")
    assert said["detail"][0]["field"] == "cutoff"
    assert "30 Hz" in said["message"]


def test_too_few_samples_after_trimming_are_refused(api):
    short = stream(samples=50, rate=50.0, noise=0.0)
    said = error(post(api, npz(**arrays(short, "t", "q", "tau"))), 422, "invalid_data")
    assert said["detail"][0] == {
        "field": "rows",
        "value": "24",
        "expected": "at least 30 samples after trimming the filter's edges",
    }
