"""What was not recorded is derived, close to the true, within episodes only, and said to be derived."""

import numpy as np
import pytest

from tests.service.data import arrays, csv, error, npz, post, stream
from tests.service.data import columns as table_of
from tests.service.test_uploads import created, stored

SMOOTH = stream(samples=300, rate=50.0, noise=0.0)
FINE = stream(samples=600, rate=50.0, noise=0.0)


def relative_error(derived, true, name):
    """Root mean square of the error over the spread, worst joint, at the times that were kept."""
    rows = np.searchsorted(true.t, derived.t - 1e-9)
    np.testing.assert_allclose(true.t[rows], derived.t, atol=1e-9)
    wrong = getattr(derived, name) - getattr(true, name)[rows]
    return float((np.sqrt(np.mean(wrong**2, axis=0)) / getattr(true, name).std(axis=0)).max())


@pytest.mark.parametrize("rate", [30.0, 100.0])
def test_both_are_close_to_the_true_ones(api, rate):
    true = stream(samples=int(12 * rate), rate=rate, noise=0.0)
    dataset = created(post(api, npz(**arrays(true, "t", "q", "tau"))))
    derived = stored(api, dataset)
    assert dataset["report"]["derived"] == ["dq", "ddq"]
    for name, tolerance in (("q", 0.001), ("dq", 0.01), ("ddq", 0.03), ("tau", 0.001)):
        assert relative_error(derived, true, name) < tolerance


@pytest.mark.parametrize(("given", "name", "tolerance"), [("dq", "ddq", 0.02), ("ddq", "dq", 0.01)])
def test_only_what_was_not_recorded_is_derived(api, given, name, tolerance):
    dataset = created(post(api, npz(**arrays(FINE, "t", "q", given, "tau"))))
    assert dataset["report"]["derived"] == [name]
    assert relative_error(stored(api, dataset), FINE, name) < tolerance


def test_every_step_is_reported(api):
    table = {name: values for name, values in table_of(FINE).items() if name.strip("0123456789") not in ("dq", "ddq")}
    report = created(post(api, csv(table), "text/csv", cutoff=5))["report"]
    assert report["preparation"] == [
        "q, tau low-passed at 5 Hz without delay",
        "dq and ddq derived by central differences",
        "20 samples cut off at the filter's edges",
    ]
    assert (report["rows_uploaded"], report["rows"]) == (600, 580)


def test_gaps_split_a_recording(api):
    t = SMOOTH.t.copy()
    t[100:] += 2.0
    t[220:] += 0.5
    dataset = created(post(api, npz(**arrays(SMOOTH) | {"t": t})))
    report = dataset["report"]
    assert (report["gaps"], report["episodes"], report["preparation"]) == (2, 3, ["split at 2 gaps in time"])
    assert report["rate_hz"] == pytest.approx(50.0)
    assert [part.start for part in stored(api, dataset).episodes()] == [0, 100, 220]


@pytest.mark.parametrize("clock", [{"t": np.tile(np.arange(150) / 50, 2)}, {"dt": 0.02}])
def test_time_may_start_anew_with_an_episode(api, clock):
    body = npz(**arrays(SMOOTH, "q", "dq", "ddq", "tau"), **clock, episode=np.repeat([5, 2], 150))
    dataset = created(post(api, body))
    assert dataset["report"]["rate_hz"] == pytest.approx(50.0)
    kept = stored(api, dataset)
    assert [part.start for part in kept.episodes()] == [0, 150]
    np.testing.assert_allclose(kept.t, np.tile(np.arange(150), 2) * 0.02, atol=1e-12)


def test_derived_samples_do_not_mix_episodes(api):
    """Each half alone gives the samples that both give together."""
    first, second = SMOOTH.rows(slice(0, 150)), SMOOTH.rows(slice(150, 300))
    episode = np.repeat([0, 1], 150)
    both = stored(api, created(post(api, npz(**arrays(SMOOTH, "q", "tau", "t"), episode=episode))))
    alone = [stored(api, created(post(api, npz(**arrays(half, "q", "tau", "t"))))) for half in (first, second)]
    assert len(both) == len(alone[0]) + len(alone[1]) > 200
    for name in ("t", "q", "dq", "ddq", "tau"):
        expected = np.concatenate([getattr(half, name) for half in alone])
        np.testing.assert_allclose(getattr(both, name), expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(
    ("body", "cutoff", "field", "message"),
    [
        (npz(**arrays(FINE, "q", "tau")), 4, "t", "missing, expected times, since dq and ddq must be derived"),
        (npz(**arrays(FINE, "t", "q", "tau")), 26, "cutoff", "50 Hz"),
        (
            npz(**arrays(SMOOTH.rows(slice(0, 50)), "t", "q", "tau")),
            4,
            "rows",
            "24, expected at least 30 samples",
        ),
        (npz(**arrays(SMOOTH, "q", "tau", "t"), episode=np.arange(300) // 20), 4, "rows", "enough to filter at 4 Hz"),
        (npz(**arrays(SMOOTH), episode=np.arange(300)), 4, "episode", ""),
    ],
    ids=["no times", "cutoff", "too short", "fragments", "episodes of one sample"],
)
def test_recordings_that_do_not_suffice_are_refused(api, body, cutoff, field, message):
    problem = error(post(api, body, cutoff=cutoff), 422, "invalid_data")
    assert problem["detail"][0]["field"] == field
    assert message in problem["message"]
