"""Torque queries: the service answers what lipcore's own model answers."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from tests.service.data import service_of, train

EXACT = {"rtol": 1e-12, "atol": 1e-12}


@pytest.fixture(scope="module")
def motion():
    """Twelve instants of two joints, near the training data and away from it."""
    return dict(zip(("q", "dq", "ddq"), np.random.default_rng(4).uniform(-2, 2, (3, 12, 2)), strict=True))


def ask(api, model, motion, **request):
    body = {name: np.asarray(values).tolist() for name, values in motion.items()}
    answer = api.post(f"/v1/models/{model}/predict", json=body | request)
    assert answer.status_code == 200, answer.text
    return answer.json()


def test_a_batch_is_answered_as_lipcore_does(api, trained, motion):
    answer = ask(api, trained.name, motion, covariance=True)
    expected = trained.model.predict(**motion, covariance=True)
    np.testing.assert_allclose(answer["tau"], expected.tau, **EXACT)
    np.testing.assert_allclose(answer["tau_std"], expected.tau_std, **EXACT)
    np.testing.assert_allclose(answer["covariance"], expected.covariance, **EXACT)
    np.testing.assert_allclose(answer["noise_std"], expected.noise_std, **EXACT)


def test_a_single_query_is_answered_as_its_row_of_a_batch(api, trained, motion):
    batch = ask(api, trained.name, motion, covariance=True)
    for row in range(12):
        single = ask(api, trained.name, {name: values[row] for name, values in motion.items()}, covariance=True)
        for name in ("tau", "tau_std", "covariance"):
            np.testing.assert_allclose(single[name], batch[name][row], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("rows", [None, 1, 12])
def test_answers_are_shaped_as_the_query(api, trained, motion, rows):
    query = {name: values[0] if rows is None else values[:rows] for name, values in motion.items()}
    answer = ask(api, trained.name, query, covariance=True)
    lead = () if rows is None else (rows,)
    assert np.shape(answer["tau"]) == np.shape(answer["tau_std"]) == (*lead, 2)
    assert np.shape(answer["covariance"]) == (*lead, 2, 2)
    assert np.shape(answer["noise_std"]) == (2,)


def test_covariance_is_symmetric_and_has_the_variances_on_its_diagonal(api, trained, motion):
    answer = ask(api, trained.name, motion, covariance=True)
    covariance = np.array(answer["covariance"])
    np.testing.assert_allclose(covariance, covariance.transpose(0, 2, 1), **EXACT)
    np.testing.assert_allclose(np.diagonal(covariance, axis1=1, axis2=2), np.array(answer["tau_std"]) ** 2, rtol=1e-9)
    assert (np.linalg.eigvalsh(covariance) > 0).all()


def test_covariance_is_left_out_unless_asked_for(api, trained, motion):
    assert "covariance" not in ask(api, trained.name, motion)
    assert "covariance" not in ask(api, trained.name, motion, covariance=False)


def test_the_answer_says_what_it_is(api, trained, motion):
    answer = ask(api, trained.name, motion)
    assert (answer["model"], answer["version"], answer["revision"]) == (trained.name, 1, 0)
    assert answer["joint_names"] == ["joint1", "joint2"]
    assert answer["torque_convention"] == "gravity_included"
    shown = api.get(f"/v1/models/{trained.name}/versions/1").json()
    assert answer["noise_std"] == shown["noise_std"]


def test_equal_questions_have_equal_answers(api, trained, motion):
    assert ask(api, trained.name, motion) == ask(api, trained.name, motion)


def test_whole_numbers_are_numbers(api, trained):
    whole = ask(api, trained.name, {"q": [1, 0], "dq": [0, 2], "ddq": [-1, 0]})
    assert whole == ask(api, trained.name, {"q": [1.0, 0.0], "dq": [0.0, 2.0], "ddq": [-1.0, 0.0]})


def test_uncertainty_grows_away_from_the_data(api, trained):
    inside = {name: getattr(trained.samples, name)[40] for name in ("q", "dq", "ddq")}
    outside = {name: values + 2.5 for name, values in inside.items()}
    near, far = (np.array(ask(api, trained.name, query)["tau_std"]) for query in (inside, outside))
    assert (far > 3 * near).all()


def test_torques_are_close_to_the_measured_ones(api, trained):
    query = {name: getattr(trained.samples, name) for name in ("q", "dq", "ddq")}
    answer = ask(api, trained.name, query)
    wrong = np.sqrt(np.mean((np.array(answer["tau"]) - trained.samples.tau) ** 2, axis=0))
    assert (wrong < 0.1 * trained.samples.tau.std(axis=0)).all()


def test_questions_at_the_same_time_do_not_disturb_each_other(api, trained, motion):
    queries = [{name: values[row : row + 3] for name, values in motion.items()} for row in range(9)] * 4
    alone = [ask(api, trained.name, query) for query in queries]
    with ThreadPoolExecutor(8) as pool:
        together = list(pool.map(lambda query: ask(api, trained.name, query), queries))
    assert together == alone


def test_the_shipped_model_answers_from_the_start(strict):
    listed = strict.get("/v1/models").json()["items"]
    assert "panda-sim" in [model["name"] for model in listed]
    answer = ask(strict, "panda-sim", {"q": [0, -0.5, 0, -2, 0, 1.5, 0.7], "dq": [0] * 7, "ddq": [0] * 7})
    assert answer["joint_names"] == [f"panda_joint{joint}" for joint in range(1, 8)]
    assert answer["version"] == 1
    assert np.isfinite(answer["tau"]).all()
    assert strict.get("/v1/models/panda-sim/versions/1").json()["job"] is None


def test_more_models_than_fit_in_memory_all_answer(api, trained, motion):
    """The least recently used one is dropped and loaded again."""
    before = ask(api, trained.name, motion)
    loaded = service_of(api).loaded
    for number in range(loaded.capacity):
        train(api, f"another{number}", trained.dataset)
        ask(api, f"another{number}", motion)
        assert len(loaded._snapshot.served) <= loaded.capacity
    assert ask(api, trained.name, motion) == before
