"""Adaptive intervals: their scale per stream, over restarts, and when disabled."""

import numpy as np
import pytest

import lipcore
from lipcore.online.adaptive import AdaptiveScale
from lipcore.online.record import Record
from service.journal import log
from tests.service.learning.learning_models import LearningModel, observation_batch, start_service
from tests.service.learning.recordings import read_logged_rows
from tests.service.learning.test_frames import make_frames
from tests.service.learning.test_quality import scrape_metrics

BIAS_NM = 0.5
"""Far outside every interval."""
CONTACT_OPTIONS = {"on_change": "hold", "contact_threshold": 8.0}
"""Biased rows are contacts and are not learnt."""
LEARN_OPTIONS = {"on_change": "learn", "contact_threshold": 100}


@pytest.fixture(scope="module")
def trained_scale(learning_service):
    """Scale that held-out blocks of the training gave."""
    return list(lipcore.load(learning_service.trained).conformal.scale)


def biased_batch(number, stream_id="arm"):
    """Return a batch with a bias on the torque of the second joint."""
    body = observation_batch(number, stream_id)
    return body | {"tau": [[first, second + BIAS_NM] for first, second in body["tau"]]}


def send_biased_batch(learning_model, number=0, stream_id="arm"):
    """Send a biased batch; return the scale of predictions afterwards."""
    learning_model.post("observations", biased_batch(number, stream_id))
    return learning_model.predict()["scale"]


def relative_errors(body, answer):
    """Return the errors of a batch relative to its unscaled 95 % intervals, (N, n)."""
    total = np.sqrt(np.square(answer["tau_std"]) + np.square(answer["noise_std"]))
    return np.abs(np.subtract(body["tau"], answer["tau"])) / (1.959963984540054 * total)


def read_scale_state(learning_service, learning_model):
    """Return the stored scale of the stream after its last batch."""
    with learning_service.service.database.session() as session:
        scale = log.stream(session, learning_model.name, "arm").record["scale"]
        return scale and scale["state"]


def test_rejected_rows_widen_only_their_own_stream(learning_service, learning_model, trained_scale):
    body = biased_batch(0)
    before = learning_model.predict_motion(body)
    assert before["scale"] == trained_scale
    assert before["guaranteed"] == list(lipcore.load(learning_service.trained).conformal.guaranteed)
    assert (relative_errors(body, before)[:, 1] > before["scale"][1]).all()
    learning_model.put("learning", CONTACT_OPTIONS)
    assert learning_model.post("observations", body)["rejected"] == {"contact": 10}
    scale = learning_service.service.loaded.get(learning_model.name, None).scales.of("arm").tolist()
    assert scale[0] < 2.0
    assert scale[1] > 10.0
    after = learning_model.predict_motion(body)
    for name in ("tau", "tau_std", "scale"):
        assert after[name] == before[name]
    assert (relative_errors(body, after)[:, 1] <= scale[1]).all()
    learning_model.put("learning", LEARN_OPTIONS)
    learning_model.post("observations", biased_batch(1))
    assert learning_model.predict_motion(body)["scale"][1] > 10.0


def test_quality_shows_model_and_answered_coverage(learning_service, learning_model):
    for number in range(3):
        learning_model.post("observations", biased_batch(number))
    window = learning_model.get("quality")["windows"][0]
    assert window["coverage"][1] < 0.2
    events = [learning_model.find_batch(number) for number in range(3)]
    inside = [np.array(event.report["answered"]["inside"]) for event in events]
    assert [event.report["answered"]["rows"] for event in events] == [10, 10, 10]
    assert inside[0][1] == 0  # before the scale had adapted
    assert window["coverage_answered"] == pytest.approx((sum(inside) / 30).tolist())
    assert Record.from_json(events[0].record).coverage[1] == 0
    samples = scrape_metrics(learning_service, learning_model.name)
    shown = [samples["lipserve_interval_scale", ("joint", joint)] for joint in ("joint1", "joint2")]
    assert shown == learning_model.get("quality")["scale"]


def test_default_scale_is_the_widest_of_all_streams(learning_service, learning_model, trained_scale):
    learning_model.post("observations", biased_batch(0, "sick"))
    learning_model.put("learning", CONTACT_OPTIONS)
    for number in range(40):
        learning_model.post("observations", observation_batch(number, "well"))
    scales = learning_service.service.loaded.get(learning_model.name, None).scales
    sick, well = scales.of("sick"), scales.of("well")
    assert sick[1] > 10.0 > well[1]
    assert scales.of("unheard").tolist() == trained_scale
    assert learning_model.predict()["scale"] == np.max([sick, well, trained_scale], axis=0).tolist()


def test_frames_are_judged_by_their_answered_interval(learning_service, learning_model):
    far = make_frames(learning_service, learning_model, range(10)).tau + BIAS_NM
    for first, factor, inside in ((0, 1.0, 0), (10, 1.0, 0), (20, 1e4, 10)):
        sequences = range(first, first + 10)
        block = make_frames(learning_service, learning_model, sequences, tau=far, factor=np.full((10, 2), factor))
        learning_service.service.learners.observe_frames(block)
        assert learning_model.find_batch(first, "socket").report["answered"]["inside"] == [inside, inside]


def test_disabling_adaptive_intervals_restores_trained_scale(learning_service, learning_model, trained_scale):
    send_biased_batch(learning_model)
    assert send_biased_batch(learning_model, stream_id="another")[1] > 1.0
    learning_model.put("learning", LEARN_OPTIONS | {"adaptive_intervals": False})
    assert learning_model.predict()["scale"] == trained_scale
    assert send_biased_batch(learning_model, 1) == trained_scale
    assert read_scale_state(learning_service, learning_model) is None
    assert learning_model.get("quality")["windows"][0]["coverage_answered"] != [None, None]  # from the batch before
    learning_model.put("learning", LEARN_OPTIONS)
    assert send_biased_batch(learning_model, 2)[1] > 1.0


def test_new_version_starts_with_its_trained_scale(learning_service, learning_model, trained_scale):
    send_biased_batch(learning_model)
    learning_service.publish(learning_model.name)
    learning_service.service.loaded.adopt(learning_model.name)
    assert learning_model.predict()["version"] == 2
    assert learning_model.predict()["scale"] == trained_scale
    assert learning_model.post("predict", {"q": [0, 0], "dq": [0, 0], "ddq": [0, 0], "version": 1})["scale"][1] > 1.0


@pytest.mark.slow
def test_scale_survives_restart_bitwise(learning_service, tmp_path):
    with start_service(tmp_path, learning_service.trained) as first:
        learning_model = first.create_model("lasting")
        send_biased_batch(learning_model)
        learning_model.post("observations", observation_batch(1))
        scale, scale_state = learning_model.predict()["scale"], read_scale_state(first, learning_model)
    assert scale[1] > 1.0
    with start_service(tmp_path, learning_service.trained) as again:
        learning_model = LearningModel(again.client, "lasting")
        assert learning_model.predict()["scale"] == scale
        body = observation_batch(2)
        answer = learning_model.predict_motion(body)
        learning_model.post("observations", body)
        time = read_logged_rows(again, learning_model)[2].time
        expected = AdaptiveScale.from_json(scale_state).step(time, relative_errors(body, answer))
        assert read_scale_state(again, learning_model)["log"] == pytest.approx(expected.log.tolist(), rel=1e-9)


def test_stationary_rows_count_for_the_scale(learning_model):
    still = biased_batch(0) | {"dq": np.zeros((10, 2)).tolist()}
    assert learning_model.post("observations", still)["rejected"] == {"stationary": 10}
    assert learning_model.predict()["scale"][1] > 10.0
    window = learning_model.get("quality")["windows"][0]
    assert (window["rows"], window["coverage"]) == (0, [None, None])
    assert window["coverage_answered"][1] == 0.0


def test_open_inference_protocol_returns_the_scale(learning_model):
    scale = send_biased_batch(learning_model)
    inputs = [{"name": name, "shape": [2], "datatype": "FP64", "data": [0.1, 0.2]} for name in ("q", "dq", "ddq")]
    answer = learning_model.client.post(
        f"/v2/models/{learning_model.name}/infer", json={"inputs": inputs, "outputs": [{"name": "scale"}]}
    )
    (tensor,) = answer.json()["outputs"]
    assert (tensor["name"], tensor["shape"], tensor["data"]) == ("scale", [2], scale)
