"""How a model learns: what may be set, what a change of it writes into the log, and holding still."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from service.foundation.errors import InvalidRequestError, NotFoundError
from service.learning import owner
from service.learning.schema import LearningOptions
from tests.service.learning.batches import MODEL, OTHER, batch, everything, opened, roll_back, write


@pytest.fixture
def database(home):
    database = opened(home)
    yield database
    database.close()


def given(database, model=MODEL):
    with database.session() as session:
        return owner.options(session, model)


def put(database, model=MODEL, **fields):
    owner.set_options(database, model, LearningOptions(**fields), 2, 500.0)


def said(database, model=MODEL):
    return [(event.number, event.kind, event.detail) for event in everything(database, model) if event.kind != "batch"]


def test_without_settings_a_model_learns_and_holds_still_after_a_change(database):
    options = given(database)
    assert options == LearningOptions()
    assert (options.enabled, options.on_change, options.forgetting_s, options.torque_limits) == (
        True,
        "hold",
        None,
        None,
    )


def test_what_is_set_comes_back_for_its_model_only(database):
    wanted = {"enabled": False, "on_change": "adapt", "torque_limits": [87.0, 12.0], "auto_promote": False}
    put(database, **wanted)
    assert given(database) == LearningOptions(**wanted)
    assert given(database, OTHER) == LearningOptions()
    put(database)
    assert given(database) == LearningOptions()


def test_only_another_forgetting_is_an_event(database):
    put(database, contact_threshold=5.0)
    assert said(database) == []
    put(database, forgetting_s=60.0)
    write(database, batch(0))
    put(database, forgetting_s=60.0, enabled=False)
    put(database, forgetting_s=30.0)
    put(database)
    assert said(database) == [
        (1, "settings", {"forgetting_s": 60.0}),
        (3, "settings", {"forgetting_s": 30.0}),
        (4, "settings", {"forgetting_s": None}),
    ]
    assert everything(database)[0].received == 500.0


def test_a_rollback_brings_back_the_forgetting_and_leaves_the_rest(database):
    put(database, forgetting_s=60.0)  # 1
    write(database, batch(0))  # 2
    put(database, forgetting_s=30.0, auto_refresh=False)  # 3
    roll_back(database, 2)
    assert given(database) == LearningOptions(forgetting_s=60.0, auto_refresh=False)
    put(database, forgetting_s=60.0)  # as it is
    assert said(database)[-1][1] == "rollback"
    put(database, forgetting_s=30.0)
    assert said(database)[-1][1:] == ("settings", {"forgetting_s": 30.0})


def test_limits_must_be_those_of_the_joints(database):
    with pytest.raises(InvalidRequestError) as caught:
        put(database, torque_limits=[87.0, 12.0, 12.0])
    assert caught.value.message == (
        "torque_limits is a list of 3, expected 2 positive numbers, one for each joint in order"
    )
    assert given(database) == LearningOptions()


def test_an_unknown_model_is_not_found(database):
    with pytest.raises(NotFoundError, match="no model 'nobody'"):
        put(database, model="nobody")


@pytest.mark.parametrize(
    "field",
    [
        {"forgetting_s": 0.5},
        {"forgetting_s": float("inf")},
        {"forgetting_s": float("nan")},
        {"on_change": "stop"},
        {"torque_limits": [87.0, 0.0]},
        {"torque_limits": [87.0, float("inf")]},
        {"contact_threshold": 0.0},
        {"contact_threshold": float("nan")},
        {"learning_rate": 0.1},
    ],
)
def test_what_makes_no_sense_is_refused_by_name(field):
    with pytest.raises(ValidationError) as caught:
        LearningOptions(**field)
    assert caught.value.errors()[0]["loc"][0] == next(iter(field))


def test_every_field_says_what_it_means():
    described = LearningOptions.model_json_schema()["properties"]
    assert all(entry.get("description") for entry in described.values())


def test_a_model_holds_still_until_it_is_released(database):
    def held(model=MODEL):
        with database.session() as session:
            return owner.held(session, model)

    put(database, forgetting_s=60.0)
    assert held() is None
    with database.transaction() as session:
        owner.hold(session, MODEL, {"event": 7, "joints": [1]})
        owner.hold(session, OTHER, {"event": 1})
    assert (held(), held(OTHER)) == ({"event": 7, "joints": [1]}, {"event": 1})
    with database.transaction() as session:
        owner.release(session, MODEL)
        owner.release(session, "nobody")
    assert (held(), held(OTHER)) == (None, {"event": 1})
    assert given(database) == LearningOptions(forgetting_s=60.0)
