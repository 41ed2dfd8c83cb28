"""Intervals that follow what streams measure: at once, beside the model's own belief, over a restart, or not at all."""

import numpy as np
import pytest

import lipcore
from lipcore.online.adaptive import AdaptiveScale
from lipcore.online.record import Record
from service.journal import log
from tests.service.learning.lessons import lesson
from tests.service.learning.lessons import school as opened
from tests.service.learning.test_frames import frames
from tests.service.learning.test_quality import scraped

BEYOND = 0.5
"""N·m: far outside every interval."""
CAREFUL = {"on_change": "hold", "contact_threshold": 8.0}
"""Rows that are far off are contacts, of which nothing is learnt."""
KEYS = ("q", "dq", "ddq")


def own(school):
    """What left-out blocks of the training have proved, before any stream."""
    return list(lipcore.load(school.trained).conformal.scale)


def off(number, stream_id="arm"):
    """A lesson whose torque of the second joint is far off."""
    body = lesson(number, stream_id)
    return body | {"tau": [[first, second + BEYOND] for first, second in body["tau"]]}


def outside(body, answer):
    """Rows of a batch outside of the interval of an answer to their motion, (N, n)."""
    error = np.abs(np.subtract(body["tau"], answer["tau"]))
    total = np.sqrt(np.square(answer["tau_std"]) + np.square(answer["noise_std"]))
    return error > 1.959963984540054 * np.array(answer["scale"]) * total


def state(school, pupil, stream_id="arm"):
    """The scale after the last batch of a stream, as the database has it."""
    with school.service.database.session() as session:
        scale = log.stream(session, pupil.model, stream_id).record["scale"]
        return scale and scale["state"]


def test_one_batch_widens_what_its_stream_is_answered_and_what_was_kept_out_nobody_elses(school, pupil):
    body = off(0)
    motion = {name: body[name] for name in KEYS}
    before = pupil.predict(motion)
    assert before["scale"] == own(school)
    assert before["guaranteed"] == list(lipcore.load(school.trained).conformal.guaranteed)
    assert outside(body, before)[:, 1].all()
    pupil.put(
        "learning", {"on_change": "hold", "contact_threshold": 8.0}
    )  # rows are contacts: nothing is learnt of them
    said = pupil.post("observations", body)
    assert said["rejected"] == {"contact": 10}
    scale = school.service.loaded.get(pupil.model, None).scales.of("arm").tolist()
    assert scale[0] < 2.0
    assert scale[1] > 10.0
    after = pupil.predict(motion)
    assert not outside(body, after | {"scale": scale})[:, 1].any()
    assert [after[name] for name in ("tau", "tau_std", "scale")] == [
        before[name] for name in ("tau", "tau_std", "scale")
    ]
    pupil.put("learning", {"on_change": "learn", "contact_threshold": 100})
    pupil.post("observations", off(1))
    assert pupil.predict(motion)["scale"][1] > 10.0


def test_the_record_is_the_models_own_and_what_was_answered_stands_beside_it(school, pupil):
    pupil.put("learning", {"on_change": "learn", "contact_threshold": 100})
    for number in range(3):
        pupil.post("observations", off(number))
    window = pupil.get("quality")["windows"][0]
    assert window["coverage"][1] < 0.2
    with school.service.database.session() as session:
        events = [log.find_batch(session, pupil.model, "arm", number) for number in range(3)]
    inside = [np.array(event.report["answered"]["inside"]) for event in events]
    assert [event.report["answered"]["rows"] for event in events] == [10, 10, 10]
    assert inside[0][1] == 0  # before it was known
    assert window["coverage_answered"] == pytest.approx((sum(inside) / 30).tolist())
    assert Record.from_json(events[0].record).coverage[1] == 0
    scale = pupil.get("quality")["scale"]
    samples = scraped(school, pupil.model)
    for joint, value in zip(("joint1", "joint2"), scale, strict=True):
        assert samples["lipserve_interval_scale", ("joint", joint)] == value


def test_questions_get_the_widest_of_the_streams_and_streams_their_own(school, pupil):
    pupil.put("learning", {"on_change": "learn", "contact_threshold": 100})
    pupil.post("observations", off(0, "sick"))
    pupil.put("learning", CAREFUL)
    for number in range(40):
        pupil.post("observations", lesson(number, "well"))
    scales = school.service.loaded.get(pupil.model, None).scales
    sick, well = scales.of("sick"), scales.of("well")
    assert sick[1] > 10.0 > well[1]
    assert scales.of("unheard").tolist() == own(school)
    assert pupil.predict()["scale"] == np.maximum(np.maximum(sick, well), own(school)).tolist()


def test_frames_are_judged_by_what_they_were_answered_with(school, pupil):
    learners = school.service.learners
    given = frames(school, pupil, range(10))
    far = given.tau + BEYOND
    for sequences, factor in ((range(10), 1.0), (range(10, 20), 1.0), (range(20, 30), 1e4)):
        block = frames(school, pupil, sequences, tau=far, factor=np.full((10, 2), factor))
        learners.observe_frames(block)
    with school.service.database.session() as session:
        inside = [log.find_batch(session, pupil.model, "socket", n).report["answered"]["inside"] for n in (0, 10, 20)]
    assert inside == [[0, 0], [0, 0], [10, 10]]


def test_switched_off_it_is_the_versions_own_at_once(school, pupil):
    pupil.post("observations", off(0))
    pupil.post("observations", off(0, "another"))
    assert pupil.predict()["scale"][1] > 1.0
    pupil.put("learning", {"adaptive_intervals": False, "on_change": "learn", "contact_threshold": 100})
    assert pupil.predict()["scale"] == own(school)
    pupil.post("observations", off(1))
    assert pupil.predict()["scale"] == own(school)
    assert state(school, pupil) is None
    assert pupil.get("quality")["windows"][0]["coverage_answered"] != [None, None]  # of the batch before
    pupil.put("learning", {"on_change": "learn", "contact_threshold": 100})
    pupil.post("observations", off(2))
    assert pupil.predict()["scale"][1] > 1.0


def test_another_version_begins_with_its_own_belief(school, pupil):
    pupil.post("observations", off(0))
    school.publish(pupil.model)
    school.service.loaded.adopt(pupil.model)
    assert pupil.predict()["version"] == 2
    assert pupil.predict()["scale"] == own(school)
    assert pupil.post("predict", {"q": [0, 0], "dq": [0, 0], "ddq": [0, 0], "version": 1})["scale"][1] > 1.0


def test_it_survives_a_restart_to_the_last_bit(school, tmp_path):
    with opened(tmp_path, school.trained) as first:
        pupil = first.enrol("lasting")
        pupil.post("observations", off(0))
        pupil.post("observations", lesson(1))
        scale, known = pupil.predict()["scale"], state(first, pupil)
    assert scale[1] > 1.0
    with opened(tmp_path, school.trained) as again:
        pupil = type(pupil)(again.client, "lasting")
        assert pupil.predict()["scale"] == scale
        body = lesson(2)
        answer = pupil.predict({name: body[name] for name in KEYS})
        pupil.post("observations", body)
        error = np.abs(np.subtract(body["tau"], answer["tau"]))
        total = 1.959963984540054 * np.sqrt(np.square(answer["tau_std"]) + np.square(answer["noise_std"]))
        with again.service.database.session() as session:
            time = log.rows_of(log.find_batch(session, "lasting", "arm", 2)).time
        expected = AdaptiveScale.from_json(known).step(time, error / total)
        assert state(again, pupil)["log"] == pytest.approx(expected.log.tolist(), rel=1e-9)


def test_rows_at_rest_are_measured_too(school, pupil):
    body = off(0)
    still = body | {"dq": np.zeros((10, 2)).tolist()}
    assert pupil.post("observations", still)["rejected"] == {"stationary": 10}
    assert pupil.predict()["scale"][1] > 10.0
    window = pupil.get("quality")["windows"][0]
    assert (window["rows"], window["coverage"]) == (0, [None, None])
    assert window["coverage_answered"][1] == 0.0


def test_the_open_inference_protocol_answers_the_scale_of_questions(pupil):
    pupil.post("observations", off(0))
    inputs = [{"name": name, "shape": [2], "datatype": "FP64", "data": [0.1, 0.2]} for name in KEYS]
    answer = pupil.client.post(
        f"/v2/models/{pupil.model}/infer", json={"inputs": inputs, "outputs": [{"name": "scale"}]}
    )
    (tensor,) = answer.json()["outputs"]
    assert (tensor["name"], tensor["shape"], tensor["data"]) == ("scale", [2], pupil.predict()["scale"])
