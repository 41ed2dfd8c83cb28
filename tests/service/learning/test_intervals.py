"""Adaptive intervals: their scale per stream, over restarts, and when disabled."""

import numpy as np
import pytest

import lipcore
from lipcore.online.adaptive import AdaptiveScale
from lipcore.online.record import Record
from service.journal import log
from tests.service.learning.learning_models import observation_batch, start_service
from tests.service.learning.test_frames import make_frames
from tests.service.learning.test_quality import scrape_metrics

BIAS_NM = 0.5
"""Far outside every interval."""
CONTACT_OPTIONS = {"on_change": "hold", "contact_threshold": 8.0}
"""Biased rows are contacts and are not learnt."""
MOTION_FIELDS = ("q", "dq", "ddq")


def trained_scale(learning_service):
    """Return the scale that held-out blocks of the training gave."""
    return list(lipcore.load(learning_service.trained).conformal.scale)


def biased_batch(number, stream_id="arm"):
    """Return a batch with a bias on the torque of the second joint."""
    body = observation_batch(number, stream_id)
    return body | {"tau": [[first, second + BIAS_NM] for first, second in body["tau"]]}


def is_outside_interval(body, answer):
    """Return which torques of a batch are outside the interval of their prediction, (N, n)."""
    error = np.abs(np.subtract(body["tau"], answer["tau"]))
    total = np.sqrt(np.square(answer["tau_std"]) + np.square(answer["noise_std"]))
    return error > 1.959963984540054 * np.array(answer["scale"]) * total


def read_scale_state(learning_service, learning_model, stream_id="arm"):
    """Return the stored scale of a stream after its last batch."""
    with learning_service.service.database.session() as session:
        scale = log.stream(session, learning_model.name, stream_id).record["scale"]
        return scale and scale["state"]


def test_rejected_rows_widen_only_their_own_stream(learning_service, learning_model):
    body = biased_batch(0)
    motion = {name: body[name] for name in MOTION_FIELDS}
    before = learning_model.predict(motion)
    assert before["scale"] == trained_scale(learning_service)
    assert before["guaranteed"] == list(lipcore.load(learning_service.trained).conformal.guaranteed)
    assert is_outside_interval(body, before)[:, 1].all()
    # rows are contacts and are not learnt
    learning_model.put("learning", {"on_change": "hold", "contact_threshold": 8.0})
    reply = learning_model.post("observations", body)
    assert reply["rejected"] == {"contact": 10}
    scale = learning_service.service.loaded.get(learning_model.name, None).scales.of("arm").tolist()
    assert scale[0] < 2.0
    assert scale[1] > 10.0
    after = learning_model.predict(motion)
    assert not is_outside_interval(body, after | {"scale": scale})[:, 1].any()
    assert [after[name] for name in ("tau", "tau_std", "scale")] == [
        before[name] for name in ("tau", "tau_std", "scale")
    ]
    learning_model.put("learning", {"on_change": "learn", "contact_threshold": 100})
    learning_model.post("observations", biased_batch(1))
    assert learning_model.predict(motion)["scale"][1] > 10.0


def test_quality_shows_model_and_answered_coverage(learning_service, learning_model):
    learning_model.put("learning", {"on_change": "learn", "contact_threshold": 100})
    for number in range(3):
        learning_model.post("observations", biased_batch(number))
    window = learning_model.get("quality")["windows"][0]
    assert window["coverage"][1] < 0.2
    with learning_service.service.database.session() as session:
        events = [log.find_batch(session, learning_model.name, "arm", number) for number in range(3)]
    inside = [np.array(event.report["answered"]["inside"]) for event in events]
    assert [event.report["answered"]["rows"] for event in events] == [10, 10, 10]
    assert inside[0][1] == 0  # before the scale had adapted
    assert window["coverage_answered"] == pytest.approx((sum(inside) / 30).tolist())
    assert Record.from_json(events[0].record).coverage[1] == 0
    scale = learning_model.get("quality")["scale"]
    samples = scrape_metrics(learning_service, learning_model.name)
    for joint, value in zip(("joint1", "joint2"), scale, strict=True):
        assert samples["lipserve_interval_scale", ("joint", joint)] == value


def test_default_scale_is_the_widest_of_all_streams(learning_service, learning_model):
    learning_model.put("learning", {"on_change": "learn", "contact_threshold": 100})
    learning_model.post("observations", biased_batch(0, "sick"))
    learning_model.put("learning", CONTACT_OPTIONS)
    for number in range(40):
        learning_model.post("observations", observation_batch(number, "well"))
    scales = learning_service.service.loaded.get(learning_model.name, None).scales
    sick, well = scales.of("sick"), scales.of("well")
    assert sick[1] > 10.0 > well[1]
    assert scales.of("unheard").tolist() == trained_scale(learning_service)
    assert (
        learning_model.predict()["scale"]
        == np.maximum(np.maximum(sick, well), trained_scale(learning_service)).tolist()
    )


def test_frames_are_judged_by_their_answered_interval(learning_service, learning_model):
    learners = learning_service.service.learners
    given = make_frames(learning_service, learning_model, range(10))
    far = given.tau + BIAS_NM
    for sequences, factor in ((range(10), 1.0), (range(10, 20), 1.0), (range(20, 30), 1e4)):
        block = make_frames(learning_service, learning_model, sequences, tau=far, factor=np.full((10, 2), factor))
        learners.observe_frames(block)
    with learning_service.service.database.session() as session:
        inside = [
            log.find_batch(session, learning_model.name, "socket", n).report["answered"]["inside"] for n in (0, 10, 20)
        ]
    assert inside == [[0, 0], [0, 0], [10, 10]]


def test_disabling_adaptive_intervals_restores_trained_scale(learning_service, learning_model):
    learning_model.post("observations", biased_batch(0))
    learning_model.post("observations", biased_batch(0, "another"))
    assert learning_model.predict()["scale"][1] > 1.0
    learning_model.put("learning", {"adaptive_intervals": False, "on_change": "learn", "contact_threshold": 100})
    assert learning_model.predict()["scale"] == trained_scale(learning_service)
    learning_model.post("observations", biased_batch(1))
    assert learning_model.predict()["scale"] == trained_scale(learning_service)
    assert read_scale_state(learning_service, learning_model) is None
    assert learning_model.get("quality")["windows"][0]["coverage_answered"] != [None, None]  # from the batch before
    learning_model.put("learning", {"on_change": "learn", "contact_threshold": 100})
    learning_model.post("observations", biased_batch(2))
    assert learning_model.predict()["scale"][1] > 1.0


def test_new_version_starts_with_its_trained_scale(learning_service, learning_model):
    learning_model.post("observations", biased_batch(0))
    learning_service.publish(learning_model.name)
    learning_service.service.loaded.adopt(learning_model.name)
    assert learning_model.predict()["version"] == 2
    assert learning_model.predict()["scale"] == trained_scale(learning_service)
    assert learning_model.post("predict", {"q": [0, 0], "dq": [0, 0], "ddq": [0, 0], "version": 1})["scale"][1] > 1.0


@pytest.mark.slow
def test_scale_survives_restart_bitwise(learning_service, tmp_path):
    with start_service(tmp_path, learning_service.trained) as first:
        learning_model = first.create_model("lasting")
        learning_model.post("observations", biased_batch(0))
        learning_model.post("observations", observation_batch(1))
        scale, scale_state = learning_model.predict()["scale"], read_scale_state(first, learning_model)
    assert scale[1] > 1.0
    with start_service(tmp_path, learning_service.trained) as again:
        learning_model = type(learning_model)(again.client, "lasting")
        assert learning_model.predict()["scale"] == scale
        body = observation_batch(2)
        answer = learning_model.predict({name: body[name] for name in MOTION_FIELDS})
        learning_model.post("observations", body)
        error = np.abs(np.subtract(body["tau"], answer["tau"]))
        total = 1.959963984540054 * np.sqrt(np.square(answer["tau_std"]) + np.square(answer["noise_std"]))
        with again.service.database.session() as session:
            time = log.rows_of(log.find_batch(session, "lasting", "arm", 2)).time
        expected = AdaptiveScale.from_json(scale_state).step(time, error / total)
        assert read_scale_state(again, learning_model)["log"] == pytest.approx(expected.log.tolist(), rel=1e-9)


def test_stationary_rows_count_for_the_scale(learning_service, learning_model):
    body = biased_batch(0)
    still = body | {"dq": np.zeros((10, 2)).tolist()}
    assert learning_model.post("observations", still)["rejected"] == {"stationary": 10}
    assert learning_model.predict()["scale"][1] > 10.0
    window = learning_model.get("quality")["windows"][0]
    assert (window["rows"], window["coverage"]) == (0, [None, None])
    assert window["coverage_answered"][1] == 0.0


def test_open_inference_protocol_returns_the_scale(learning_model):
    learning_model.post("observations", biased_batch(0))
    inputs = [{"name": name, "shape": [2], "datatype": "FP64", "data": [0.1, 0.2]} for name in MOTION_FIELDS]
    answer = learning_model.client.post(
        f"/v2/models/{learning_model.name}/infer", json={"inputs": inputs, "outputs": [{"name": "scale"}]}
    )
    (tensor,) = answer.json()["outputs"]
    assert (tensor["name"], tensor["shape"], tensor["data"]) == ("scale", [2], learning_model.predict()["scale"])
