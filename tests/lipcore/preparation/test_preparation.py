"""Tests of recipes: the paper's defaults, other options, the causal form, and refusals."""

import json
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import butter, sosfiltfilt

from lipcore.preparation.causal import CausalFilter
from lipcore.preparation.filtering import resolve_filters
from lipcore.preparation.plan import plan
from lipcore.preparation.recipe import PreparationError, Recipe

RATE = 90.0
"""Hz. A period of the cut-off is 22.5 samples, far from a whole number, so that rounding cannot matter."""
ALL = ("q", "dq", "ddq", "tau")
TIMES = np.arange(1000) / RATE
NONE_MISSING = np.zeros(1000, dtype=bool)
DEFAULTS = Recipe()
FREQUENCIES = np.array([0.1, 0.23, 0.41, 0.7, 1.1])


def motion(t, seed=0):
    """Return position, velocity, acceleration and torque of a joint at any time."""
    rng = np.random.default_rng(seed)
    speed = 2 * np.pi * FREQUENCIES
    size, angle = rng.uniform(0.2, 1, len(speed)) / speed, np.outer(t, speed) + rng.uniform(0, 6, len(speed))
    q, dq, ddq = np.sin(angle) @ size, np.cos(angle) @ (size * speed), -np.sin(angle) @ (size * speed**2)
    return {"q": q, "dq": dq, "ddq": ddq, "tau": 3 * ddq + 5 * np.cos(q)}


def select_columns(columns, names):
    return {name: columns[name] for name in names}


def prepare(t, columns, recipe=DEFAULTS, episode=None, missing=None):
    """Return the plan of a recording and its prepared columns."""
    made = plan(t, episode, np.zeros(len(t), dtype=bool) if missing is None else missing, tuple(columns), recipe)
    return made, made.apply(columns)


def prepare_like_the_paper(columns, rate, cutoff=4.0):
    """Prepare one even recording with SciPy alone."""
    sections = butter(4, cutoff, fs=rate, output="sos")
    found = {name: sosfiltfilt(sections, values) for name, values in columns.items()}
    found.setdefault("dq", np.gradient(found["q"], 1 / rate, edge_order=2))
    found["ddq"] = np.gradient(sosfiltfilt(sections, found["dq"]), 1 / rate, edge_order=2)
    edge = int(np.ceil(rate / cutoff))
    return {name: found[name][edge:-edge] for name in ALL}


def step_texts(made):
    return [step["text"] for step in made.steps]


@pytest.mark.parametrize("names", [("q", "tau"), ("q", "dq", "tau")])
def test_defaults_match_the_paper(names):
    columns = select_columns(motion(TIMES), names)
    made, found = prepare(TIMES, columns)
    for name, expected in prepare_like_the_paper(columns, RATE).items():
        np.testing.assert_allclose(found[name], expected, rtol=0, atol=1e-12 * max(1, np.abs(expected).max()))
    np.testing.assert_array_equal(made.t, TIMES[23:-23])
    assert (made.rate, made.cutoff, made.delay_s, made.edges) == (pytest.approx(RATE), 4.0, 0.0, 46)
    assert step_texts(made) == [
        f"{', '.join(['q', 'tau', *names[1:-1]])} low-passed at 4 Hz without delay",
        f"{' and '.join(made.derived)} derived by central differences",
        "46 samples cut off at the filter's edges",
    ]


def test_complete_columns_stay_unchanged():
    t = np.cumsum(np.random.default_rng(0).uniform(0.5, 1.4, 1000)) / RATE
    for recipe, stamps in ((Recipe(), t), (Recipe(rate_hz=100.0), np.arange(1000) / 99.7)):
        columns = motion(stamps)
        made, found = prepare(stamps, columns, recipe)
        assert [step["step"] for step in made.steps] in ([], ["split"])
        for name, values in found.items():
            np.testing.assert_array_equal(values, columns[name])


def test_complete_columns_need_no_times():
    made = plan(None, np.repeat([5.0, 2.0, 5.0], [300, 300, 400]), NONE_MISSING, ALL, Recipe())
    np.testing.assert_array_equal(made.t, np.arange(1000))
    np.testing.assert_array_equal(made.episode, np.repeat([0, 1, 2], [300, 300, 400]))
    assert made.rate is None
    assert step_texts(made) == ["3 episodes kept separate"]


def test_filters_do_not_cross_episodes_or_gaps():
    """Three parts together give the same results as each part alone."""
    t = TIMES + (np.arange(1000) >= 600)
    columns = select_columns(motion(t), ("q", "tau"))
    made, found = prepare(t, columns, episode=np.repeat([0.0, 1.0], [300, 700]))
    assert (made.gaps, made.episodes) == (1, 3)
    assert step_texts(made)[:2] == ["2 episodes kept separate", "split at 1 gap in time"]
    for index, part in enumerate((slice(0, 300), slice(300, 600), slice(600, 1000))):
        expected = prepare_like_the_paper({name: values[part] for name, values in columns.items()}, RATE)
        for name in ALL:
            np.testing.assert_allclose(found[name][made.episode == index], expected[name], rtol=1e-9, atol=1e-11)


def test_missing_rows_are_removed_and_short_gaps_bridged():
    """Three missing rows, 44 ms, are bridged at a cut-off of 4 Hz; a second of them splits the recording."""
    missing = np.zeros(1000, dtype=bool)
    missing[200:203] = missing[600:700] = True
    columns = select_columns(motion(TIMES), ("q", "tau"))
    for values in columns.values():
        values[missing] = np.nan
    made, found = prepare(TIMES, columns, missing=missing)
    assert (made.missing, made.first_missing, made.gaps, made.resampled) == (103, 201, 1, True)
    assert step_texts(made)[0] == "103 rows with missing values left out, the first is row 201"
    assert len(made) == (600 - 46) + (300 - 46)
    true = motion(made.t)
    for name, tolerance in (("q", 2e-3), ("dq", 1e-2), ("ddq", 4e-2), ("tau", 1e-2)):
        wrong = np.abs(found[name] - true[name])
        assert wrong.max() < tolerance * np.ptp(true[name])  # the maximum is at the ends of parts
        assert wrong[160:200].max() < 0.2 * tolerance * np.ptp(true[name])  # in the bridged gap


def test_missing_rows_without_times_split_the_recording():
    missing = np.zeros(10, dtype=bool)
    missing[[3, 4, 9]] = True
    made = plan(None, None, missing, ALL, Recipe())
    np.testing.assert_array_equal(made.episode, [0, 0, 0, 1, 1, 1, 1])
    np.testing.assert_array_equal(made.apply({name: np.arange(10.0) for name in ALL})["q"], [0, 1, 2, 5, 6, 7, 8])


def test_first_row_of_equal_stamps_is_kept():
    t = TIMES.copy()
    t[[11, 12, 40]] = t[[10, 10, 39]]
    made, found = prepare(t, dict.fromkeys(ALL, np.arange(1000.0)), Recipe(gap_steps=5))
    assert (made.repeated, len(made)) == (3, 997)
    assert step_texts(made) == ["3 rows with a repeated time stamp left out, the first is row 12"]
    assert 10 in found["q"]
    assert not {11, 12, 40} & set(found["q"])


@pytest.mark.parametrize(("rate", "spread"), [(30.0, 0.4), (100.0, 0.4), (500.0, 0.4), (100.0, 0.9)])
def test_uneven_stamps_are_resampled(rate, spread):
    rng = np.random.default_rng(4)
    count = int(20 * rate)
    t = 1.7e9 + (np.arange(count) + rng.uniform(-spread / 2, spread / 2, count)) / rate
    made, found = prepare(t, select_columns(motion(t - 1.7e9), ("q", "tau")))
    true = motion(made.t - 1.7e9)
    assert made.resampled
    assert made.rate == pytest.approx(rate, rel=0.01)
    np.testing.assert_allclose(np.diff(made.t), 1 / made.rate, rtol=1e-3)
    for name, tolerance in (("q", 0.001), ("dq", 0.01), ("ddq", 0.03), ("tau", 0.02)):
        wrong = found[name] - true[name]
        assert np.sqrt(np.mean(wrong**2)) < tolerance * true[name].std()


@pytest.mark.parametrize(("rate", "whole"), [(45.0, True), (18.0, True), (25.0, False), (64.0, False)])
def test_lower_rate_may_be_chosen(rate, whole):
    t = np.arange(2000) / RATE
    columns = select_columns(motion(t), ("q", "tau"))
    made, found = prepare(t, columns, Recipe(rate_hz=rate))
    true = motion(made.t)
    assert made.rate == pytest.approx(rate)
    np.testing.assert_allclose(np.diff(made.t), 1 / rate, rtol=1e-9)
    for name in ALL:
        assert np.abs(found[name] - true[name]).max() < 0.02 * np.ptp(true[name])
    if whole:
        expected = prepare(t, columns)[1]["ddq"][:: int(RATE / rate)]
        np.testing.assert_allclose(found["ddq"], expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def test_lower_rate_filters_out_aliases():
    """At 18 Hz, a vibration of 17 Hz would look like one of 1 Hz."""
    t = np.arange(2000) / RATE
    made, smooth = prepare(t, motion(t), Recipe(rate_hz=18))
    shaken = made.apply({name: values + np.sin(2 * np.pi * 17 * t) for name, values in motion(t).items()})
    assert made.cutoff == pytest.approx(7.2)
    for name in ALL:
        assert np.abs(shaken[name] - smooth[name]).max() < 0.01


def test_filtering_may_be_forced_or_disabled():
    columns = motion(TIMES)
    _, always = prepare(TIMES, columns, Recipe(filtering="always", cutoff_hz=11))
    sections = butter(4, 11, fs=RATE, output="sos")
    for name in ALL:
        np.testing.assert_allclose(always[name], sosfiltfilt(sections, columns[name])[9:-9], rtol=0, atol=1e-12)
    _, found = prepare(TIMES, select_columns(columns, ("q", "tau")), Recipe(filtering="never"))
    np.testing.assert_array_equal(found["q"], columns["q"])
    dq = np.gradient(columns["q"], 1 / RATE, edge_order=2)
    np.testing.assert_allclose(found["ddq"], np.gradient(dq, 1 / RATE, edge_order=2), rtol=0, atol=1e-9)


def test_ends_may_be_cut_off():
    made = plan(TIMES, np.repeat([0.0, 1.0], 500), NONE_MISSING, ALL, Recipe(trim_s=0.5))
    np.testing.assert_array_equal(made.t, np.concatenate([TIMES[45:455], TIMES[545:955]]))
    assert step_texts(made)[-1] == "180 samples cut off at the ends of parts"
    assert len(plan(TIMES, None, NONE_MISSING, ("q", "tau"), Recipe(trim_s=0.0))) == 1000


@pytest.mark.parametrize(
    ("changed", "field", "value", "expected"),
    [
        ({"t": None}, "t", "missing", "times, because dq and ddq must be derived"),
        ({"t": None, "names": ALL, "recipe": Recipe(rate_hz=10)}, "t", "missing", "a rate of 10 Hz is requested"),
        ({"t": None, "names": ALL, "recipe": Recipe(filtering="always")}, "t", "missing", "to be low-passed"),
        ({"t": None, "names": ALL, "recipe": Recipe(trim_s=1)}, "t", "missing", "are to be cut off"),
        ({"recipe": Recipe(cutoff_hz=45)}, "cutoff", "45 Hz", "less than half the rate of 90 Hz"),
        ({"recipe": Recipe(rate_hz=200)}, "rate", "200 Hz", "at most the recording's rate, 90 Hz"),
        ({"episode": np.arange(1000.0)}, "episode", "different for every sample", "episodes of several samples"),
        ({"episode": np.arange(1000) // 20}, "rows", 1000, "long enough to filter at 4 Hz: at least 47 samples"),
        ({"names": ALL, "recipe": Recipe(trim_s=6)}, "rows", 1000, "long enough to use: at least 1081 samples"),
        ({"t": np.arange(1000) * 1e-9}, "t", "in steps of 1e-09", "seconds, in steps of at least 1e-06"),
        ({"t": 5 - np.arange(1000.0)}, "t, row 2", "4", "at least 5, the time before it"),
        ({"names": ("q", "dq")}, "tau", "missing", "columns for it"),
        ({"missing": np.ones(1000, dtype=bool)}, "rows", 0, "at least one row without missing values"),
    ],
)
def test_unsuitable_recording_is_rejected(changed, field, value, expected):
    known = {"t": TIMES, "episode": None, "missing": NONE_MISSING, "names": ("q", "tau"), "recipe": DEFAULTS}
    with pytest.raises(PreparationError) as caught:
        plan(*(known | changed).values())
    assert (caught.value.field, caught.value.value) == (field, value)
    assert expected in caught.value.expected


recipes = st.builds(
    Recipe,
    cutoff_hz=st.floats(1, 20),
    filtering=st.sampled_from(["derived", "always", "never"]),
    form=st.sampled_from(["acausal", "causal"]),
    rate_hz=st.none() | st.floats(5, 85),
    trim_s=st.none() | st.floats(0, 0.5),
    gap_steps=st.floats(1.5, 10),
)


@given(recipe=recipes, uneven=st.booleans(), names=st.sampled_from([ALL, ("q", "tau"), ("q", "dq", "tau")]))
def test_every_recipe_is_linear_finite_and_reproducible(recipe, uneven, names):
    rng = np.random.default_rng(7)
    t = np.arange(800) / RATE
    t[500:] += 0.7
    t += rng.uniform(0, 0.6, 800) / RATE if uneven else 0
    missing = np.zeros(800, dtype=bool)
    missing[[100, 101, 300]] = True
    made = plan(t, None, missing, names, recipe)
    again = plan(t, None, missing, names, Recipe.from_json(json.loads(json.dumps(recipe.to_json()))))
    assert json.loads(json.dumps(made.steps)) == again.steps
    one = select_columns(motion(t, 1), names)
    first, scaled = made.apply(one), again.apply({name: -2.5 * one[name] for name in names})
    for name in ALL:
        assert first[name].shape == made.t.shape == made.episode.shape
        assert np.isfinite(first[name]).all()
        size = np.abs(scaled[name]).max()
        np.testing.assert_allclose(scaled[name], -2.5 * first[name], rtol=0, atol=1e-9 * size)
    within = np.diff(made.episode) == 0
    assert (np.diff(made.t)[within] > 0).all()
    assert made.episodes == made.episode[-1] + 1


CAUSAL_RECIPE = Recipe(form="causal")
GIVEN_COLUMNS = [("q", "tau"), ("q", "dq", "tau"), ("q", "ddq", "tau"), ALL]
FORCED_RECIPE = Recipe(form="causal", filtering="always")


def two_joints(count, names):
    t = np.arange(count) / RATE
    return {name: np.column_stack([motion(t, seed)[name] for seed in (1, 2)]) for name in names}


def causal_filter(rate, n_joints, recipe, names=("q", "dq", "tau")):
    """Return the filter of a recipe for consecutive rows."""
    return CausalFilter(resolve_filters(rate, tuple(name for name in ALL if name in names), recipe), n_joints)


@given(
    names=st.sampled_from(GIVEN_COLUMNS),
    cuts=st.lists(st.integers(0, 120), max_size=5),
    recipe=st.sampled_from([CAUSAL_RECIPE, FORCED_RECIPE, Recipe(form="causal", cutoff_hz=20)]),
)
def test_batch_size_does_not_change_the_results(names, cuts, recipe):
    rows = two_joints(120, names)
    stream = causal_filter(RATE, 2, recipe, names)
    stream.batch(rows)
    answers = []
    for bounds in (range(121), [0, *sorted(cuts), 120]):
        stream.reset()
        parts = [{name: values[begin:end] for name, values in rows.items()} for begin, end in pairwise(bounds)]
        batches = [stream.batch(part) for part in parts]
        answers.append({name: np.concatenate([batch[name] for batch in batches]) for name in ALL})
    for name in ALL:
        np.testing.assert_allclose(answers[1][name], answers[0][name], rtol=0, atol=1e-12)


def phase(values, frequency, t):
    """Return the phase of a sinusoid, from whole periods."""
    return np.angle(np.mean(values * np.exp(-2j * np.pi * frequency * t)))


@pytest.mark.parametrize("rate", [50.0, 100.0, 1000.0])
@pytest.mark.parametrize("names", GIVEN_COLUMNS)
@pytest.mark.parametrize("cutoff", [4.0, 10.0])
def test_slow_sinusoids_have_the_stated_delay(rate, names, cutoff):
    frequency = 0.2
    stream = causal_filter(rate, 1, Recipe(form="causal", filtering="always", cutoff_hz=cutoff), names)
    t = np.arange(int(15 * rate)) / rate
    speed = 2 * np.pi * frequency
    true = {"q": np.sin(speed * t), "dq": speed * np.cos(speed * t), "ddq": -(speed**2) * np.sin(speed * t)}
    true["tau"] = 3 * true["q"]
    found = stream.batch({name: true[name][:, None] for name in names})
    last = slice(-int(5 * rate), None)
    for name in ALL:
        late = (phase(true[name][last], frequency, t[last]) - phase(found[name][last, 0], frequency, t[last])) / speed
        assert (late + 2.5) % 5 - 2.5 == pytest.approx(stream.delay_s, rel=2e-3)
        assert np.ptp(found[name][last]) == pytest.approx(np.ptp(true[name][last]), rel=2e-3)


def test_complete_rows_are_not_filtered_or_delayed():
    stream = causal_filter(RATE, 2, CAUSAL_RECIPE, ALL)
    rows = two_joints(20, ALL)
    assert stream.delay_s == 0
    for name, values in stream.batch(rows).items():
        np.testing.assert_array_equal(values, rows[name])


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ({"q": np.zeros((2, 3))}, r"q has shape \(2, 3\), expected \(2, 2\)"),
        ({"tau": np.zeros((1, 2))}, r"tau has shape \(1, 2\), expected \(2, 2\)"),
        ({"dq": np.array([[0.0, 0.0], [0.0, np.nan]])}, "dq is not finite in row 1"),
    ],
)
def test_rejected_rows_leave_the_filter_unchanged(rows, message):
    stream, untouched = (causal_filter(RATE, 2, CAUSAL_RECIPE) for _ in range(2))
    good = two_joints(60, ("q", "dq", "tau"))
    with pytest.raises(ValueError, match=message):
        stream.batch({name: np.zeros((2, 2)) for name in good} | rows)
    np.testing.assert_array_equal(stream.batch(good)["ddq"], untouched.batch(good)["ddq"])


def test_causal_plan_equals_the_stream_of_each_part():
    t = TIMES + 5 * (np.arange(1000) >= 400)
    columns = select_columns(motion(t), ("q", "dq", "tau"))
    made, found = prepare(t, columns, CAUSAL_RECIPE)
    stream = causal_filter(1 / np.median(np.diff(t)), 1, CAUSAL_RECIPE)
    for index, part in enumerate((slice(0, 400), slice(400, 1000))):
        stream.reset()
        expected = stream.batch({name: values[part, None] for name, values in columns.items()})
        mine = made.episode == index
        settled = slice(-np.count_nonzero(mine), None)
        assert len(t[part]) - np.count_nonzero(mine) == pytest.approx(2 * RATE / 4 + 2, abs=1)
        for name in ALL:
            np.testing.assert_allclose(found[name][mine], expected[name][settled, 0], rtol=0, atol=1e-9)
        np.testing.assert_allclose(made.t[mine], t[part][settled] - stream.delay_s, rtol=0, atol=1e-9)
    true = motion(made.t)
    for name in ALL:
        assert np.sqrt(np.mean((found[name] - true[name]) ** 2)) < 0.05 * true[name].std()
    assert made.delay_s == pytest.approx(stream.delay_s)
    filtered = "q, tau, dq low-passed at 4 Hz as in a live stream"
    assert step_texts(made)[1] == f"{filtered}, with a delay of {made.delay_s:.3g} s"
