"""Bodies that are no JSON object, and JSON with one value that is of the wrong type, out of range, or no name."""

from typing import Any

from tests.service.bad_requests.bad import (
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
    Bad,
    body,
)

INF, NAN = float("inf"), float("nan")
HOMOGLYPH, BIDI, ZERO_WIDTH, NUL, HALF = "p\u0430nda", "a\u202eb", "a\u200bb", "a\x00b", "a\ud800"
ODD = ("", "a b", "a\n", "-a", "../a", "a" * 65, HOMOGLYPH, BIDI, ZERO_WIDTH, NUL, HALF)
"""What is no name of a model, a stream or an alias."""
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


def wrong(path: str, base: dict[str, Any], name: str, *values: Any, named: str | None = None, **more: Any) -> list[Bad]:
    """A right body with one wrong value at a time."""
    return [body(path, base | {name: value}, named or name, **more) for value in values]


def missing(path: str, base: dict[str, Any], name: str, *values: Any, named: str | None = None) -> list[Bad]:
    """A right body with the name of what there is not."""
    return wrong(path, base, name, *values, named=named, status=404, code="not_found")


def first(value: Any) -> list[Any]:
    """Seven numbers, the first of which is none."""
    return [value, *ZERO[1:]]


def option(name: str, *values: Any) -> list[Bad]:
    """Wrong options of a training job."""
    return [body(JOBS, JOB | {"options": {name: value}}, f"options.{name}") for value in values]


def carried(name: str, *values: Any, named: str | None = None) -> list[Bad]:
    """Payloads with one wrong value at a time."""
    right = {"mass": 1.0, "com": [0.0, 0.0, 0.1]}
    return wrong(
        PREDICT, QUERY, "payload", *(right | {name: value} for value in values), named=named or f"payload.{name}"
    )


DIAGONAL = [[1, 0, 0], [0, 1, 0]]
NO_OBJECTS = [
    *(body(PREDICT, text, "body") for text in TEXTS),
    *(body(path, text, "body") for path in ROUTES for text in (b"", b"[]", b"[" * 100_000)),
    body(LEARNING, b"{", "body", method="PUT"),
    *(body(path, text, named) for path, named, text in TWICE),
]
PREDICTING = [
    *wrong(PREDICT, QUERY, "q", None, "0", {}, 0, [], [[]], [0.0] * 6, [0.0] * 8),
    *wrong(PREDICT, QUERY, "q", *map(first, ("0", True, None, {}, HALF, NAN, INF, -INF, 10**400, 90.0)), named="q[0]"),
    *wrong(PREDICT, QUERY, "q", [ZERO, ZERO[1:]], [ZERO, 0.0], first([0.0]), named="q[1]"),
    *wrong(PREDICT, QUERY, "q", [first(NAN)], [[ZERO]], named="q[0][0]"),
    *wrong(PREDICT, QUERY, "dq", [ZERO], ZERO[1:]),
    *wrong(PREDICT, QUERY, "ddq", [ZERO, ZERO]),
    *(body(PREDICT, {key: value for key, value in QUERY.items() if key != name}, name) for name in QUERY),
    *wrong(PREDICT, QUERY, "covariance", "true", 1, None),
    *wrong(PREDICT, QUERY, "components", "gravity", None),
    *wrong(PREDICT, QUERY, "components", ["mass"], [None], named="components[0]"),
    *wrong(PREDICT, QUERY, "components", ["gravity", "gravity"], named="components[1]"),
    *wrong(PREDICT, QUERY, "version", "1", 1.0, True, 0, 2**31, 10**30, NAN),
    *missing(PREDICT, QUERY, "version", 99),
    *wrong(PREDICT, QUERY, "min_revision", "1", -1, 2**31),
    *wrong(PREDICT, QUERY, "tau", ZERO, []),
    *(body(PREDICT, QUERY | {name: 0}, name.encode("unicode_escape").decode()) for name in ("Q", "__proto__", BIDI)),
    *wrong(PREDICT, QUERY, "alias", "A", *ODD),
    *missing(PREDICT, QUERY, "alias", "nobody"),
    body(PREDICT, QUERY | {"alias": "serving", "version": 1}, "alias"),
    *wrong(PREDICT, QUERY, "payload", 5, [], "2"),
    *wrong(PREDICT, QUERY, "payload", {}, {"com": [0, 0, 0]}, named="payload.mass"),
    *carried("mass", 0, -1, "2", True, None, NAN, INF, 1e7, 10**400),
    *carried("com", None, 0.1, "0,0,0", {}, [0, 0], [0, 0, 0, 0]),
    *carried("com", [0, NAN, 0], [0, "0", 0], [0, [0], 0], named="payload.com[1]"),
    *carried("inertia", 1, [1, 1, 1, 0, 0, 0], [[1, 0, 0], [0, 1, 0]]),
    *carried("inertia", [[1, 0, 0], [0, 1, 0], [0, 0, 2.1]], [[-1, 0, 0], [0, 1, 0], [0, 0, 1]]),
    *carried("inertia", [[1, 1, 0], [0, 1, 0], [0, 0, 1]]),
    *carried("inertia", [*DIAGONAL, [0, 0]], named="payload.inertia[2]"),
    *carried("inertia", [*DIAGONAL, [0, 0, NAN]], named="payload.inertia[2][2]"),
    *carried("colour", "red"),
]
TRAINING = [
    *wrong(JOBS, JOB, "model", "A", *ODD, None, 5),
    *wrong(JOBS, JOB, "datasets", [], "ds_0", [f"ds_{i}" for i in range(101)]),
    *wrong(JOBS, JOB, "datasets", [5], ["d" * 201], [None], [HALF], named="datasets[0]"),
    *missing(JOBS, JOB, "datasets", ["ds_0"], ["../x"], [""], named="dataset"),
    *wrong(JOBS, JOB, "estimator", None, "e" * 41),
    *wrong(JOBS, JOB, "joint_types", "revolute"),
    *wrong(JOBS, JOB, "joint_types", ["revolut"], named="joint_types[0]"),
    *wrong(JOBS, JOB, "robot", 5, "r" * 41),
    *wrong(JOBS, JOB, "options", [], "quick"),
    *option("hyperparameter_samples", 9, "many", 10.5, NAN, INF, 10**400),
    *option("posterior_samples", 9, "60", 60.0, True),
    *option("max_iterations", 0, 10_001),
    *option("starts", 0, 21),
    *option("tied", "true", 1),
    *option("prior", "none"),
    *option("device", "gpu", "cuda"),  # the second: `auto` tries none that gains from a GPU
    *option("compact_tolerance", "0.1", True, 0, 1.1, NAN),
    *option("max_inducing_outputs", 0, "all"),
    *option("statistics", "some", True),
    *option("epochs", 5),
    *wrong(JOBS, JOB, "priority", 1),
]
TEACHING = [
    *wrong(OBSERVE, BATCH, "stream_id", *ODD, None, 5),
    *wrong(OBSERVE, BATCH, "sequence", -1, 2**53, 1.5, "1", True, NAN),
    *wrong(OBSERVE, BATCH, "q", [], "0", None, [0.0] * 6),
    *wrong(OBSERVE, BATCH, "q", first("0"), first(True), first(10**400), named="q[0]"),
    *wrong(OBSERVE, BATCH, "tau", [ZERO, ZERO], []),
    *wrong(OBSERVE, BATCH, "t", [0.0, 1.0], []),
    *wrong(OBSERVE, BATCH, "t", "now", named="t[0]"),
    *wrong(OBSERVE, BATCH, "joint_names", "joint1", ["a"] * 1001),
    *wrong(OBSERVE, BATCH, "joint_names", ["elbow"] * 7, named="joint_names[0]"),
    *wrong(OBSERVE, BATCH, "temperature", 20),
    body(OBSERVE, {key: value for key, value in BATCH.items() if key != "ddq"}, "ddq"),
    *(body(f"{OBSERVE}/bad/{each}/replay", {}, "sequence") for each in ("x", "-1")),
    body(OBSERVE + "/b%20d/0/replay", {}, "stream_id"),
    *wrong(OBSERVE + "/bad/0/replay", {}, "codes", [], "contact", ["learnt"], [None]),
]
SETTING = [
    *wrong(LEARNING, {}, "enabled", "on", None, 1, method="PUT"),
    *wrong(LEARNING, {}, "forgetting_s", 0, -1, 1e308, NAN, INF, "1 h", method="PUT"),
    *wrong(LEARNING, {}, "friction_walk_s", 0, 9.9, 1e308, NAN, INF, "1 h", method="PUT"),
    *wrong(LEARNING, {}, "on_change", "wait", None, method="PUT"),
    *wrong(LEARNING, {}, "torque_limits", [1.0] * 6, "87", method="PUT"),
    *wrong(
        LEARNING,
        {},
        "torque_limits",
        first(-1),
        first(5e-324),
        first(1e7),
        first(NAN),
        first(INF),
        named="torque_limits[0]",
        method="PUT",
    ),
    *wrong(LEARNING, {}, "contact_threshold", 0, 5e-324, 2.9, 100.1, 1e308, NAN, None, method="PUT"),
    *wrong(LEARNING, {}, "rate", 1, method="PUT"),
    *wrong(ROLLBACK, {}, "revision", "0", False, -1, 2**53, 1.5, NAN),
    *wrong(ROLLBACK, {}, "version", 0, "x"),
    *missing(ROLLBACK, {}, "version", 99),
    *wrong("/v1/models/panda-sim/learning/change", {}, "decision", "wait", None),
    *wrong("/v1/models/panda-sim/refresh", {}, "estimator", "lip"),
    *wrong(f"{ALIASES}/best", {}, "version", 0, "x", 1.5, method="PUT"),
    *wrong(f"{ALIASES}/best", {}, "version", 99, status=404, code="not_found", method="PUT"),
    *(body(f"{ALIASES}/{alias}", {"version": 1}, "alias", method="PUT") for alias in ("A", "1", "a%20b", "a" * 65)),
    *wrong(f"{ALIASES}/best", {}, "alias", "No", method="PUT"),
    *wrong(f"{ALIASES}/best", {}, "alias", "nowhere", status=404, code="not_found", method="PUT"),
    *wrong(f"{ALIASES}/best", {"version": 1}, "to", 2, method="PUT"),
    *(body(f"{ALIASES}/best", each, "version or alias", method="PUT") for each in ({}, {"version": 1, "alias": "a"})),
]
OF_DATA = {"dataset": "ds_0"}
ASSESSING = [
    *(each for path in (EVALUATE, TRACE) for each in wrong(path, {}, "dataset", None, 5, "d" * 1000)),
    *(each for path in (EVALUATE, TRACE) for each in missing(path, {}, "dataset", "ds_0", "")),
    *(each for path in (EVALUATE, TRACE) for each in wrong(path, OF_DATA, "version", 0, "x", 10**30)),
    *wrong(EVALUATE, OF_DATA, "min_revision", -1, "x"),
    *wrong(EVALUATE, OF_DATA, "level", 0.9),
    *wrong(TRACE, OF_DATA, "part", "held", None),
    *wrong(TRACE, OF_DATA, "start", -1, 1.5, "0", True, 2**53, NAN),
    *wrong(TRACE, OF_DATA, "stop", -1, "10", INF),
    *wrong(TRACE, OF_DATA, "points", 0, 2001, "100", 1.0),
    *wrong(TRACE, OF_DATA, "components", "gravity"),
    *wrong(TRACE, OF_DATA, "components", ["inertia_matrix"], named="components[0]"),
    *wrong(TRACE, OF_DATA, "components", ["gravity", "gravity"], named="components[1]"),
    *wrong(COMPARE, OF_DATA, "versions", [], [1], [1, 2, 3], "12"),
    *wrong(COMPARE, OF_DATA, "versions", [1, 1], named="versions[1]"),
]
BAD: list[Bad] = [*NO_OBJECTS, *PREDICTING, *TRAINING, *TEACHING, *SETTING, *ASSESSING]
