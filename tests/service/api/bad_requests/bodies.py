"""Bodies that are no JSON object, and JSON with one value of the wrong type, out of range, or with a wrong name."""

from typing import Any

from tests.service.api.bad_requests.bad import (
    ALIASES,
    BATCH,
    COMPARE,
    EVALUATE,
    JOB,
    JOBS,
    LEARNING,
    OBSERVE,
    PREDICT,
    QUERY,
    ROLLBACK,
    TRACE,
    ZERO,
    BadRequest,
    body,
)

INF, NAN = float("inf"), float("nan")
HOMOGLYPH, BIDI, ZERO_WIDTH, NUL, HALF = "p\u0430nda", "a\u202eb", "a\u200bb", "a\x00b", "a\ud800"
VERSION = "/v1/models/panda-sim/versions/1"
ODD = ("", "a b", "a\n", "-a", "../a", "a" * 65, HOMOGLYPH, BIDI, ZERO_WIDTH, NUL, HALF)
"""Invalid names of a model, a stream or an alias."""
TEXTS = (
    *(b"", b" ", b"{", b"[]", b"null", b"0", b"NaN", b'"text"', b"q=0&dq=0", b"<query/>", b"{} {}", b"{}\x00"),
    *(b"{'q': 0}", b'{"q": 0,}', b'{"q": 0x10}', b'{"q": 01}', b'{"q" 0}', b'{"q": "\n"}', b'{"q": "\xff"}'),
    *(b"\xff\xfe{\x00}\x00", b'{"q": "\xed\xa0\x80"}', b'{"q": ' + b"9" * 5000 + b"}", b"[" * 100_000),
    *(b'{"q": ' * 20_000, b"[" * 300 + b"]" * 300),
)
ROUTES = (EVALUATE, OBSERVE, JOBS, ROLLBACK)
TWICE = (
    (PREDICT, "q", b'{"q": [1], "dq": [0], "ddq": [0], "\\u0071": [0]}'),
    (OBSERVE, "tau", b'{"stream_id": "a", "sequence": 0, "q": [0], "dq": [0], "ddq": [0], "tau": [0], "tau": [1]}'),
    (EVALUATE, "dataset", b'{"dataset": "a", "dataset": "b"}'),
    (JOBS, "tied", b'{"model": "a", "datasets": ["b"], "options": {"tied": true, "tied": false}}'),
)


def with_value(
    path: str, base: dict[str, Any], name: str, *values: Any, named: str | None = None, **more: Any
) -> list[BadRequest]:
    """Return correct bodies with one wrong value each."""
    return [body(path, base | {name: value}, named or name, **more) for value in values]


def with_missing_name(
    path: str, base: dict[str, Any], name: str, *values: Any, named: str | None = None
) -> list[BadRequest]:
    """Return correct bodies that name something that does not exist."""
    return with_value(path, base, name, *values, named=named, status=404, code="not_found")


def first_wrong(*values: Any) -> list[list[Any]]:
    """Return lists of seven values, of which the first is no number."""
    return [[value, *ZERO[1:]] for value in values]


def with_option(name: str, *values: Any) -> list[BadRequest]:
    """Return training jobs with one wrong option each."""
    return [body(JOBS, JOB | {"options": {name: value}}, f"options.{name}") for value in values]


def with_learning(name: str, *values: Any, named: str | None = None) -> list[BadRequest]:
    """Return learning options with one wrong value each."""
    return with_value(LEARNING, {}, name, *values, named=named, method="PUT")


def with_payload(name: str, *values: Any, named: str | None = None) -> list[BadRequest]:
    """Return queries whose payload has one wrong value each."""
    wrong = ({"mass": 1.0, "com": [0.0, 0.0, 0.1], name: value} for value in values)
    return with_value(PREDICT, QUERY, "payload", *wrong, named=named or f"payload.{name}")


TIMED = QUERY | {"t": 0.0}


def with_history(name: str, *values: Any, named: str | None = None) -> list[BadRequest]:
    """Return queries whose history has one wrong value each."""
    wrong = ({"t": [-2.0, -1.0], "q": [ZERO] * 2, "dq": [ZERO] * 2, name: value} for value in values)
    return with_value(PREDICT, TIMED, "history", *wrong, named=named or f"history.{name}")


DIAGONAL = [[1, 0, 0], [0, 1, 0]]
NO_OBJECTS = [
    *(body(PREDICT, text, "body") for text in TEXTS),
    *(body(path, text, "body") for path in ROUTES for text in (b"", b"[]", b"[" * 100_000)),
    body(LEARNING, b"{", "body", method="PUT"),
    *(body(path, text, named) for path, named, text in TWICE),
]
PREDICTING = [
    *with_value(PREDICT, QUERY, "q", None, "0", {}, 0, [], [[]], [0.0] * 6, [0.0] * 8),
    *with_value(
        PREDICT, QUERY, "q", *first_wrong("0", True, None, {}, HALF, NAN, INF, -INF, 10**400, 90.0), named="q[0]"
    ),
    *with_value(PREDICT, QUERY, "q", [ZERO, ZERO[1:]], [ZERO, 0.0], *first_wrong([0.0]), named="q[1]"),
    *with_value(PREDICT, QUERY, "q", first_wrong(NAN), [[ZERO]], named="q[0][0]"),
    *with_value(PREDICT, QUERY, "dq", [ZERO], ZERO[1:]),
    *with_value(PREDICT, QUERY, "ddq", [ZERO, ZERO]),
    *(body(PREDICT, {key: value for key, value in QUERY.items() if key != name}, name) for name in QUERY),
    *with_value(PREDICT, QUERY, "covariance", "true", 1, None),
    *with_value(PREDICT, QUERY, "components", "gravity", None),
    *with_value(PREDICT, QUERY, "components", ["mass"], [None], named="components[0]"),
    *with_value(PREDICT, QUERY, "components", ["gravity", "gravity"], named="components[1]"),
    *with_value(PREDICT, QUERY, "version", "1", 1.0, True, 0, 2**31, 10**30, NAN),
    *with_missing_name(PREDICT, QUERY, "version", 99),
    *with_value(PREDICT, QUERY, "min_revision", "1", -1, 2**31),
    *with_value(PREDICT, QUERY, "tau", ZERO, []),
    *(body(PREDICT, QUERY | {name: 0}, name.encode("unicode_escape").decode()) for name in ("Q", "__proto__", BIDI)),
    *with_value(PREDICT, QUERY, "alias", "A", *ODD),
    *with_missing_name(PREDICT, QUERY, "alias", "nobody"),
    body(PREDICT, QUERY | {"alias": "serving", "version": 1}, "alias"),
    *with_value(PREDICT, QUERY, "payload", 5, [], "2"),
    *with_value(PREDICT, QUERY, "payload", {}, {"com": [0, 0, 0]}, named="payload.mass"),
    *with_payload("mass", 0, -1, "2", True, None, NAN, INF, 1e7, 10**400),
    *with_payload("com", None, 0.1, "0,0,0", {}, [0, 0], [0, 0, 0, 0]),
    *with_payload("com", [0, NAN, 0], [0, "0", 0], [0, [0], 0], named="payload.com[1]"),
    *with_payload("inertia", 1, [1, 1, 1, 0, 0, 0], [[1, 0, 0], [0, 1, 0]]),
    *with_payload("inertia", [[1, 0, 0], [0, 1, 0], [0, 0, 2.1]], [[-1, 0, 0], [0, 1, 0], [0, 0, 1]]),
    *with_payload("inertia", [[1, 1, 0], [0, 1, 0], [0, 0, 1]]),
    *with_payload("inertia", [*DIAGONAL, [0, 0]], named="payload.inertia[2]"),
    *with_payload("inertia", [*DIAGONAL, [0, 0, NAN]], named="payload.inertia[2][2]"),
    *with_payload("colour", "red"),
    *with_value(PREDICT, QUERY, "t", 0.5, []),
    *with_value(PREDICT, QUERY, "t", "0", [None], True, NAN, 10**400, [[0.0]], named="t[0]"),
    *with_value(PREDICT, QUERY, "trajectory", True, 1, "true", None),
    *with_value(PREDICT, TIMED, "history", 5, [], "2"),
    *with_history("t", [], [0.0]),
    *with_history("t", "0", [None, 0.0], named="history.t[0]"),
    *with_history("t", [-1.0, -1.5], named="history.t[1]"),
    *with_history("q", ZERO, [[0.0] * 6] * 2, [], None),
    *with_history("dq", [ZERO], [ZERO] * 3, 0.0),
    *with_history("dq", [ZERO, ZERO[1:]], named="history.dq[1]"),
    *with_history("q", [ZERO, first_wrong(NAN)[0]], [ZERO, first_wrong(90.0)[0]], named="history.q[1][0]"),
    *with_history("ddq", [ZERO, ZERO]),
]
TRAINING = [
    *with_value(JOBS, JOB, "model", "A", *ODD, None, 5),
    *with_value(JOBS, JOB, "datasets", [], "ds_0", [f"ds_{i}" for i in range(101)]),
    *with_value(JOBS, JOB, "datasets", [5], ["d" * 201], [None], [HALF], named="datasets[0]"),
    *with_missing_name(JOBS, JOB, "datasets", ["ds_0"], ["../x"], [""], named="dataset"),
    *with_value(JOBS, JOB, "estimator", None, "e" * 41),
    *with_value(JOBS, JOB, "joint_types", "revolute"),
    *with_value(JOBS, JOB, "joint_types", ["revolut"], named="joint_types[0]"),
    *with_value(JOBS, JOB, "robot", 5, "r" * 41),
    *with_value(JOBS, JOB, "options", [], "quick"),
    *with_option("hyperparameter_samples", 9, "many", 10.5, NAN, INF, 10**400),
    *with_option("posterior_samples", 9, "60", 60.0, True),
    *with_option("max_iterations", 0, 10_001),
    *with_option("starts", 0, 21),
    *with_option("tied", "true", 1),
    *with_option("prior", "none"),
    *with_option("device", "gpu", "cuda"),  # the second: none of the estimators of `auto` benefits from a GPU
    *with_option("compact_tolerance", "0.1", True, 0, 1.1, NAN),
    *with_option("max_inducing_outputs", 0, "all"),
    *with_option("statistics", "some", True),
    *with_option("epochs", 5),
    *with_value(JOBS, JOB, "priority", 1),
]
TEACHING = [
    *with_value(OBSERVE, BATCH, "stream_id", *ODD, None, 5),
    *with_value(OBSERVE, BATCH, "sequence", -1, 2**53, 1.5, "1", True, NAN),
    *with_value(OBSERVE, BATCH, "q", [], "0", None, [0.0] * 6),
    *with_value(OBSERVE, BATCH, "q", *first_wrong("0", True, 10**400), named="q[0]"),
    *with_value(OBSERVE, BATCH, "tau", [ZERO, ZERO], []),
    *with_value(OBSERVE, BATCH, "t", [0.0, 1.0], []),
    *with_value(OBSERVE, BATCH, "t", "now", named="t[0]"),
    *with_value(OBSERVE, BATCH, "joint_names", "joint1", ["a"] * 1001),
    *with_value(OBSERVE, BATCH, "joint_names", ["elbow"] * 7, named="joint_names[0]"),
    *with_value(OBSERVE, BATCH, "temperature", 20),
    body(OBSERVE, {key: value for key, value in BATCH.items() if key != "ddq"}, "ddq"),
    *(body(f"{OBSERVE}/bad/{each}/replay", {}, "sequence") for each in ("x", "-1")),
    body(OBSERVE + "/b%20d/0/replay", {}, "stream_id"),
    *with_value(OBSERVE + "/bad/0/replay", {}, "codes", [], "contact", ["learnt"], [None]),
]
SETTING = [
    *with_learning("enabled", "on", None, 1),
    *with_learning("forgetting_s", 0, -1, 1e308, NAN, INF, "1 h"),
    *with_learning("friction_walk_s", 0, 9.9, 1e308, NAN, INF, "1 h"),
    *with_learning("on_change", "wait", None),
    *with_learning("torque_limits", [1.0] * 6, "87"),
    *with_learning("torque_limits", *first_wrong(-1, 5e-324, 1e7, NAN, INF), named="torque_limits[0]"),
    *with_learning("contact_threshold", 0, 5e-324, 2.9, 100.1, 1e308, NAN, None),
    *with_learning("rate", 1),
    *with_value(ROLLBACK, {}, "revision", "0", False, -1, 2**53, 1.5, NAN),
    *with_value(ROLLBACK, {}, "version", 0, "x"),
    *with_missing_name(ROLLBACK, {}, "version", 99),
    *with_value("/v1/models/panda-sim/learning/change", {}, "decision", "wait", None),
    *with_value("/v1/models/panda-sim/refresh", {}, "estimator", "lip"),
    *with_value(VERSION, {}, "note", 1, ["a"], "a" * 501, BIDI, NUL, HALF, method="PATCH"),
    *with_value(VERSION, {}, "tags", "a", ["a"] * 11, method="PATCH"),
    *(body(VERSION, {"tags": [tag]}, "tags[0]", method="PATCH") for tag in ("", " ", "a,b", "a\nb", "a" * 41, NUL, 1)),
    body(f"{VERSION}9", {"note": "a"}, "version", status=404, code="not_found", method="PATCH"),
    *with_value(f"{ALIASES}/best", {}, "version", 0, "x", 1.5, method="PUT"),
    *with_value(f"{ALIASES}/best", {}, "version", 99, status=404, code="not_found", method="PUT"),
    *(body(f"{ALIASES}/{alias}", {"version": 1}, "alias", method="PUT") for alias in ("A", "1", "a%20b", "a" * 65)),
    *with_value(f"{ALIASES}/best", {}, "alias", "No", method="PUT"),
    *with_value(f"{ALIASES}/best", {}, "alias", "nowhere", status=404, code="not_found", method="PUT"),
    *with_value(f"{ALIASES}/best", {"version": 1}, "to", 2, method="PUT"),
    *(body(f"{ALIASES}/best", each, "version or alias", method="PUT") for each in ({}, {"version": 1, "alias": "a"})),
]
OF_DATA = {"dataset": "ds_0"}
ASSESSING = [
    *(each for path in (EVALUATE, TRACE) for each in with_value(path, {}, "dataset", None, 5, "d" * 1000)),
    *(each for path in (EVALUATE, TRACE) for each in with_missing_name(path, {}, "dataset", "ds_0", "")),
    *(each for path in (EVALUATE, TRACE) for each in with_value(path, OF_DATA, "version", 0, "x", 10**30)),
    *with_value(EVALUATE, OF_DATA, "min_revision", -1, "x"),
    *with_value(EVALUATE, OF_DATA, "level", 0.9),
    *with_value(TRACE, OF_DATA, "part", "held", None),
    *with_value(TRACE, OF_DATA, "start", -1, 1.5, "0", True, 2**53, NAN),
    *with_value(TRACE, OF_DATA, "stop", -1, "10", INF),
    *with_value(TRACE, OF_DATA, "points", 0, 2001, "100", 1.0),
    *with_value(TRACE, OF_DATA, "components", "gravity"),
    *with_value(TRACE, OF_DATA, "components", ["inertia_matrix"], named="components[0]"),
    *with_value(TRACE, OF_DATA, "components", ["gravity", "gravity"], named="components[1]"),
    *with_value(COMPARE, OF_DATA, "versions", [], [1], [1, 2, 3], "12"),
    *with_value(COMPARE, OF_DATA, "versions", [1, 1], named="versions[1]"),
]
BAD: list[BadRequest] = [*NO_OBJECTS, *PREDICTING, *TRAINING, *TEACHING, *SETTING, *ASSESSING]
