"""The causal form: row by row as in batches, late by what it says, all quantities of one moment."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lipcore.preparation.causal import CausalPreparation
from lipcore.preparation.plan import plan
from lipcore.preparation.recipe import PreparationError, Recipe
from tests.lipcore.test_preparation_plan import ALL, RATE, chosen, motion

CAUSAL = Recipe(form="causal")
GIVEN = [("q", "tau"), ("q", "dq", "tau"), ("q", "ddq", "tau"), ALL]
FORCED = Recipe(form="causal", filtering="always")


def two_joints(count, names):
    t = np.arange(count) / RATE
    return {name: np.column_stack([motion(t, seed)[name] for seed in (1, 2)]) for name in names}


def row_by_row(stream, rows):
    answers = [stream.step({name: values[row] for name, values in rows.items()}) for row in range(len(rows["q"]))]
    return [answer for answer in answers if answer is not None]


@given(
    names=st.sampled_from(GIVEN),
    cuts=st.lists(st.integers(0, 120), max_size=5),
    recipe=st.sampled_from([CAUSAL, FORCED, Recipe(form="causal", rate_hz=30), Recipe(form="causal", cutoff_hz=20)]),
)
def test_batches_of_any_size_give_what_single_rows_give(names, cuts, recipe):
    rows = two_joints(120, names)
    single = row_by_row(CausalPreparation(RATE, 2, recipe, names), rows)
    stream = CausalPreparation(RATE, 2, recipe, names)
    stream.batch(rows)
    stream.reset()
    bounds = [0, *sorted(cuts), 120]
    batches = [
        stream.batch({name: values[begin:end] for name, values in rows.items()}) for begin, end in pairwise(bounds)
    ]
    for name in ALL:
        expected = np.array([answer[name] for answer in single]).reshape(-1, 2)
        np.testing.assert_allclose(np.concatenate([b[name] for b in batches]), expected, rtol=0, atol=1e-12)


def phase(values, frequency, t):
    """Of a sinusoid, from whole periods."""
    return np.angle(np.mean(values * np.exp(-2j * np.pi * frequency * t)))


@pytest.mark.parametrize("rate", [50.0, 100.0, 1000.0])
@pytest.mark.parametrize("names", GIVEN)
@pytest.mark.parametrize("cutoff", [4.0, 10.0])
def test_all_quantities_of_a_slow_sinusoid_are_late_by_the_delay_that_is_said(rate, names, cutoff):
    frequency = 0.2
    stream = CausalPreparation(rate, 1, Recipe(form="causal", filtering="always", cutoff_hz=cutoff), names)
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


def test_nothing_is_filtered_or_late_where_all_is_given_and_nothing_asked_for():
    stream = CausalPreparation(RATE, 2, CAUSAL, ALL)
    rows = two_joints(20, ALL)
    assert stream.delay_s == 0
    for name, values in stream.batch(rows).items():
        np.testing.assert_array_equal(values, rows[name])


def test_a_lower_rate_is_a_whole_part_of_the_stream_s():
    stream = CausalPreparation(RATE, 1, Recipe(form="causal", rate_hz=18))
    assert stream.rate_hz == pytest.approx(18)
    rows = chosen(motion(np.arange(302) / RATE), ("q", "dq", "tau"))
    assert len(stream.batch({name: values[:, None] for name, values in rows.items()})["q"]) == 60
    with pytest.raises(PreparationError, match=r"rate is 40 Hz, expected a whole part of 90 Hz, such as 45, 30"):
        CausalPreparation(RATE, 1, Recipe(form="causal", rate_hz=40))


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ({"q": np.zeros((2, 3))}, r"q has shape \(2, 3\), expected \(2, 2\)"),
        ({"tau": np.zeros((1, 2))}, r"tau has shape \(1, 2\), expected \(2, 2\)"),
        ({"dq": np.array([[0.0, 0.0], [0.0, np.nan]])}, "dq is not finite in row 1"),
    ],
)
def test_rows_that_cannot_be_used_are_refused_and_leave_no_trace(rows, said):
    stream, untouched = (CausalPreparation(RATE, 2, CAUSAL) for _ in range(2))
    good = two_joints(60, ("q", "dq", "tau"))
    with pytest.raises(ValueError, match=said):
        stream.batch({name: np.zeros((2, 2)) for name in good} | rows)
    np.testing.assert_array_equal(stream.batch(good)["ddq"], untouched.batch(good)["ddq"])


def test_a_plan_of_the_causal_form_is_the_stream_of_each_part_at_the_moments_told_of():
    t = np.arange(1000) / RATE
    t[400:] += 5
    columns = chosen(motion(t), ("q", "dq", "tau"))
    made = plan(t, None, np.zeros(1000, dtype=bool), tuple(columns), CAUSAL)
    found = made.apply(columns)
    stream = CausalPreparation(1 / np.median(np.diff(t)), 1, CAUSAL)
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
    assert made.steps[1]["text"] == f"q, tau, dq low-passed at 4 Hz as in a live stream, {made.delay_s:.3g} s late"
