"""Episodes and gaps: where a recording is not contiguous, nothing is filtered or differentiated across."""

from __future__ import annotations

import numpy as np
import pytest

from tests.service.data import arrays, error, npz, post, stream
from tests.service.test_upload_formats import created, stored

SMOOTH = stream(samples=300, rate=50.0, noise=0.0)


def test_gaps_split_a_recording(api):
    t = SMOOTH.t.copy()
    t[100:] += 2.0
    t[220:] += 0.5
    dataset = created(post(api, npz(**arrays(SMOOTH) | {"t": t})))
    assert dataset["report"]["gaps"] == 2
    assert dataset["report"]["episodes"] == 3
    assert dataset["report"]["preparation"] == ["split at 2 gaps in time"]
    assert dataset["report"]["rate_hz"] == pytest.approx(50.0)
    assert [part.start for part in stored(api, dataset).episodes()] == [0, 100, 220]


def test_a_step_that_is_a_little_long_is_no_gap(api):
    t = SMOOTH.t.copy()
    t[100:] += 0.4 / 50
    assert created(post(api, npz(**arrays(SMOOTH) | {"t": t})))["report"]["gaps"] == 0


def test_episodes_are_kept_apart(api):
    episode = np.repeat([5, 2, 5], 100)
    dataset = created(post(api, npz(**arrays(SMOOTH), episode=episode)))
    assert dataset["report"]["episodes"] == 3
    assert [part.start for part in stored(api, dataset).episodes()] == [0, 100, 200]


def test_time_may_start_anew_with_an_episode(api):
    episode = np.repeat([0, 1], 150)
    t = np.tile(np.arange(150) / 50, 2)
    assert created(post(api, npz(**arrays(SMOOTH) | {"t": t}, episode=episode)))["report"]["episodes"] == 2


def test_dt_gives_times_that_start_anew_with_every_episode(api):
    episode = np.repeat([0, 1], [100, 200])
    dataset = created(post(api, npz(**arrays(SMOOTH, "q", "dq", "ddq", "tau"), dt=0.02, episode=episode)))
    assert dataset["report"]["rate_hz"] == pytest.approx(50.0)
    expected = np.concatenate([np.arange(100), np.arange(200)]) * 0.02
    np.testing.assert_allclose(stored(api, dataset).t, expected, atol=1e-12)


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


def test_fragments_that_the_filter_leaves_nothing_of_are_dropped_and_counted(api):
    """25 samples at 50 Hz can be filtered, but lie within the filter's edges of 13 samples at both ends."""
    t = SMOOTH.t.copy()
    t[265:] += 1.0
    t[290:] += 1.0
    dataset = created(post(api, npz(**arrays(SMOOTH, "q", "tau") | {"t": t})))
    assert dataset["report"]["rows"] == 265 - 2 * 13
    assert dataset["report"]["episodes"] == 1
    assert "61 samples cut off at the filter's edges" in dataset["report"]["preparation"]


def test_a_recording_of_fragments_only_is_refused(api):
    body = npz(**arrays(SMOOTH, "q", "tau", "t"), episode=np.arange(300) // 20)
    said = error(post(api, body), 422, "invalid_data")
    assert said["detail"][0]["field"] == "rows"
    assert "long enough to filter at 4 Hz" in said["message"]


def test_episodes_of_one_sample_each_are_refused(api):
    said = error(post(api, npz(**arrays(SMOOTH), episode=np.arange(300))), 422, "invalid_data")
    assert said["detail"][0]["field"] == "episode"
