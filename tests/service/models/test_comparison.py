"""Comparison of two versions on a data set: metrics, paired errors, and a verdict that they support."""

from dataclasses import replace

import numpy as np
import pytest

from lipcore.data.metrics import Comparison, Difference, compare
from service.inference.comparison import _verdict
from tests.service.data import error, stream, upload
from tests.service.models.versions import publish, train_worse, trained_model
from tests.service.training.conftest import assert_invalid

SAMPLES = {"seed": 9, "samples": 400}


@pytest.fixture(scope="module")
def recorded(api):
    """A data set of 40 s that no version was trained on."""
    return upload(api, stream(**SAMPLES))


@pytest.fixture(scope="module")
def arm(api, recorded):
    """A model of three versions: one of another pendulum, one of the recorded pendulum, and an equal one."""
    lineage = {"datasets": [{"id": "ds_of_another_service", "sha256": recorded["sha256"]}]}
    assert publish(api, "compared", train_worse()) == 1
    assert publish(api, "compared") == 2
    assert publish(api, "compared", lineage=lineage) == 3
    return "compared"


def post_comparison(api, model, dataset, *versions):
    return api.post(f"/v1/models/{model}/compare", json={"dataset": dataset, "versions": list(versions)})


def test_better_version_is_named_with_the_evidence(api, arm, recorded):
    found = post_comparison(api, arm, recorded["id"], 1, 2).json()
    assert (found["outcome"], found["better"]) == ("second_better", 2)
    assert found["verdict"].startswith("Version 2 predicts better than version 1: its negative log predictive density")
    assert (found["samples"], found["samples_used"], found["blocks"]) == (400, 400, 40)
    samples = stream(**SAMPLES)
    answers = [model.predict(samples.q, samples.dq, samples.ddq) for model in (train_worse(), trained_model())]
    exact = compare(samples, *(each.interval for each in answers))
    for name in ("nmse", "rmse", "coverage", "nlpd"):
        shown, figures = found["differences"][name], getattr(exact, name)
        for part, value in (("difference", "mean"), ("standard_error",) * 2, ("half_width",) * 2):
            np.testing.assert_allclose(shown[part], getattr(figures, value), rtol=1e-9)
    for place, name in enumerate(("nlpd", "nmse")):
        np.testing.assert_allclose(found[name]["difference"], exact.total.mean[place], rtol=1e-9)
    assert found["warnings"] == []
    for shown in found["versions"]:
        request = {"dataset": recorded["id"], "version": shown["version"]}
        evaluated = api.post(f"/v1/models/{arm}/evaluate", json=request).json()
        assert shown == {name: evaluated[name] for name in shown}


def test_order_changes_the_signs_but_not_the_verdict(api, arm, recorded):
    one, other = (post_comparison(api, arm, recorded["id"], *order).json() for order in ((1, 2), (2, 1)))
    assert (other["outcome"], other["better"], other["verdict"]) == ("first_better", 2, one["verdict"])
    assert other["nlpd"]["difference"] == pytest.approx(-one["nlpd"]["difference"])


def test_equal_versions_do_not_differ_and_training_data_are_noticed(api, arm, recorded):
    api.put(f"/v1/models/{arm}/aliases/second", json={"version": 2})
    found = post_comparison(api, arm, recorded["id"], "second", "serving").json()
    assert (found["outcome"], found["better"], found["nlpd"]["difference"]) == ("no_difference", None, 0.0)
    assert found["verdict"].startswith("Versions 2 and 3 do not differ significantly")
    assert [each["in_training"] for each in found["versions"]] == [False, True]
    assert found["warnings"] == ["Version 3 was trained on this data set, so its figures are too optimistic."]


def test_short_recording_is_inconclusive(api, arm):
    short = upload(api, stream(seed=7))["id"]
    found = post_comparison(api, arm, short, 1, 2).json()
    assert (found["outcome"], found["better"], found["blocks"]) == ("cannot_tell", None, 8)
    assert "8 segments" in found["verdict"]
    assert "Record longer" in found["verdict"]


@pytest.mark.parametrize(
    ("versions", "refusal", "field"),
    [
        ([3, "serving"], (422, "invalid_request"), "versions[1]"),
        ([1, 9], (404, "not_found"), "version"),
        ([1, "nowhere"], (404, "not_found"), "alias"),
    ],
)
def test_wrong_choices_are_named(api, arm, recorded, versions, refusal, field):
    answer = post_comparison(api, arm, recorded["id"], *versions)
    assert error(answer, *refusal)["detail"][0]["field"] == field


def test_unsuitable_data_set_is_rejected(api, arm):
    error(post_comparison(api, arm, "ds_none", 1, 2), 404, "not_found")
    others = upload(api, replace(stream(seed=7), joint_names=("a", "b")))["id"]
    assert_invalid(post_comparison(api, arm, others, 1, 2), "dataset")


def comparison(density, nmse, blocks=30):
    """Return a comparison with these totals, each a mean and the half width of its interval."""
    nothing = Difference(np.zeros(1), np.zeros(1), np.zeros(1), np.ones(1))
    mean, width = np.array([[density[0], nmse[0]], [density[1], nmse[1]]])
    return Comparison(nothing, nothing, nothing, nothing, Difference(mean, width / 2, width, np.full(1, 60.0)), blocks)


@pytest.mark.parametrize(
    ("density", "nmse", "outcome", "words"),
    [
        ((-1.0, 0.2), (-0.01, 0.002), "second_better", "The errors of version 5 are smaller: its mean nMSE is lower"),
        ((-1.0, 0.2), (0.01, 0.002), "second_better", "The errors of version 5 are larger: its mean nMSE is higher"),
        ((-1.0, 0.2), (0.001, 0.002), "second_better", "which is not significant"),
        ((1.0, 0.2), (0.01, 0.002), "first_better", "The errors of version 4 are smaller"),
        ((0.1, 0.2), (0.01, 0.002), "no_difference", "The errors of version 5 are larger"),
        ((0.1, 0.2), (0.001, 0.002), "no_difference", "differ by 0.1 ± 0.2 nats per sample"),
    ],
)
def test_text_agrees_with_the_numbers(density, nmse, outcome, words):
    verdict, text = _verdict(4, 5, comparison(density, nmse))
    assert verdict == outcome
    assert words in text
    assert ("its stated uncertainty is more accurate" in text) == (outcome == "second_better" and nmse[0] > nmse[1])
    assert _verdict(4, 5, replace(comparison(density, nmse), blocks=19))[0] == "cannot_tell"
