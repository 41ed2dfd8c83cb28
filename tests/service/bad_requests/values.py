"""JSON bodies with one wrong value, of the wrong type, out of range, or of a name that is none."""

from __future__ import annotations

import json
from typing import Any

from tests.service.bad_requests.bad import (
    ALIASES,
    BATCH,
    COMPARE,
    EVALUATE,
    INFER,
    JOB,
    JOBS,
    LEARNING,
    OBSERVE,
    PREDICT,
    QUERY,
    ROLLBACK,
    TENSORS,
    TRACE,
    ZERO,
    Bad,
    body,
)

INF, NAN = float("inf"), float("nan")
HOMOGLYPH, BIDI, ZERO_WIDTH, NUL, HALF = "p\u0430nda", "a\u202eb", "a\u200bb", "a\x00b", "a\ud800"
NO_NAMES = (
    "",
    "A",
    "a b",
    " a",
    "a\n",
    ".a",
    "-a",
    "../a",
    "a/b",
    "a\\b",
    "a" * 65,
    HOMOGLYPH,
    BIDI,
    ZERO_WIDTH,
    NUL,
    HALF,
)
"""What is no name of a model; of these, all but a few are no names of streams or aliases either."""


def raw(base: dict[str, Any], name: str, text: str) -> bytes:
    """A body whose field is JSON as it stands."""
    return json.dumps(base | {name: "@"}).replace('"@"', text).encode()


def wrong(path: str, base: dict[str, Any], name: str, *values: Any, named: str | None = None, **more: Any) -> list[Bad]:
    """A right body with one wrong value at a time."""
    return [body(path, base | {name: value}, named or name, **more) for value in values]


def first(value: Any) -> list[Any]:
    """Seven numbers, the first of which is none."""
    return [value, *ZERO[1:]]


def option(name: str, *values: Any) -> list[Bad]:
    """Wrong options of a training job."""
    return [body(JOBS, JOB | {"options": {name: value}}, f"options.{name}") for value in values]


PREDICTING = [
    *wrong(PREDICT, QUERY, "q", None, "0", {}, True, 0, []),
    *wrong(PREDICT, QUERY, "q", *map(first, ("0", True, None, {}, NAN, INF, -INF, 10**400)), named="q[0]"),
    body(PREDICT, raw(QUERY, "q", "[1e400,0,0,0,0,0,0]"), "q[0]"),
    body(PREDICT, raw(QUERY, "q", '["\\ud800",0,0,0,0,0,0]'), "q[0]"),
    *wrong(PREDICT, QUERY, "q", [[]], [0.0] * 6, [0.0] * 8, named="q"),
    *wrong(PREDICT, QUERY, "q", [ZERO, ZERO[1:]], named="q[1]"),
    *wrong(PREDICT, QUERY, "q", first(90.0), named="q[0]"),
    *wrong(PREDICT, QUERY, "dq", [ZERO], ZERO[1:]),
    *wrong(PREDICT, QUERY, "ddq", [ZERO, ZERO]),
    *(body(PREDICT, {key: value for key, value in QUERY.items() if key != name}, name) for name in QUERY),
    *wrong(PREDICT, QUERY, "covariance", "perhaps", "true", 0, 1, 2, None, []),
    *wrong(PREDICT, QUERY, "components", "gravity", None, {}),
    *wrong(PREDICT, QUERY, "components", ["mass"], ["Gravity"], [None], [["gravity"]], named="components[0]"),
    *wrong(PREDICT, QUERY, "components", ["gravity", "gravity"], named="components[1]"),
    *wrong(PREDICT, QUERY, "version", "1", 1.0, True, 0, -1, 1.5, 2**31, 10**30, "x", [], {}, NAN),
    *wrong(PREDICT, QUERY, "version", 99, status=404, code="not_found"),
    *wrong(PREDICT, QUERY, "min_revision", "1", 1.0, True, -1, 1.5, 2**31, 10**30, [], NAN),
    *wrong(PREDICT, QUERY, "tau", ZERO, [], "0"),
    *wrong(PREDICT, QUERY, "Q", ZERO),
    *wrong(PREDICT, QUERY, "qdd", ZERO),
    *wrong(PREDICT, QUERY, "__proto__", {}),
    *wrong(PREDICT, QUERY, "q\u200b", ZERO, named="q\\u200b"),
    *wrong(PREDICT, QUERY, "\u202eq", ZERO, named="\\u202eq"),
    *wrong(PREDICT, QUERY, "alias", *(name for name in NO_NAMES)),
    *wrong(PREDICT, QUERY, "alias", "nobody", status=404, code="not_found"),
    body(PREDICT, QUERY | {"alias": "serving", "version": 1}, "alias"),
]
TRAINING = [
    *wrong(JOBS, JOB, "model", *NO_NAMES, None, 5, [], {}),
    *wrong(JOBS, JOB, "datasets", [], "ds_0", None, {}),
    *wrong(JOBS, JOB, "datasets", [5], ["d" * 41], [None], [HALF], named="datasets[0]"),
    *wrong(JOBS, JOB, "datasets", [f"ds_{i}" for i in range(101)]),
    *wrong(JOBS, JOB, "datasets", ["ds_0"], ["../x"], [""], named="dataset", status=404, code="not_found"),
    *wrong(JOBS, JOB, "estimator", None, 5, "e" * 41),
    *wrong(JOBS, JOB, "joint_types", "revolute", {}),
    *wrong(JOBS, JOB, "joint_types", ["revolut"], [None], named="joint_types[0]"),
    *wrong(JOBS, JOB, "robot", 5, "r" * 41, []),
    *wrong(JOBS, JOB, "options", [], "quick", 5),
    *option("hyperparameter_samples", 9, -1, "many", 10.5, NAN, INF, 10**400, None),
    *option("posterior_samples", 9, "x", "60", 60.0, True),
    *option("max_iterations", 0, 10_001),
    *option("starts", 0, 21),
    *option("tied", "perhaps", "true", 0, 1, 2),
    *option("prior", "none", None),
    *option("device", "gpu", "CPU"),
    *option("compact_tolerance", "0.1", True, 0, -1, 1.1, NAN, INF),
    *option("max_inducing_outputs", 0, "all"),
    *option("statistics", "some", None, True),
    *option("epochs", 5),
    *wrong(JOBS, JOB, "priority", 1),
]
TEACHING = [
    *wrong(
        OBSERVE,
        BATCH,
        "stream_id",
        "",
        "a b",
        "-a",
        "a/b",
        "a\n",
        "a" * 65,
        HOMOGLYPH,
        BIDI,
        ZERO_WIDTH,
        NUL,
        HALF,
        None,
        5,
    ),
    *wrong(OBSERVE, BATCH, "sequence", -1, 2**53, 10**30, 1.5, "1", True, None, NAN),
    *wrong(OBSERVE, BATCH, "q", [], "0", None, {}),
    *wrong(OBSERVE, BATCH, "q", first("0"), first(True), first(10**400), named="q[0]"),
    *wrong(OBSERVE, BATCH, "q", [0.0] * 6, named="q"),
    *wrong(OBSERVE, BATCH, "tau", [ZERO, ZERO], []),
    *wrong(OBSERVE, BATCH, "t", [0.0, 1.0], []),
    *wrong(OBSERVE, BATCH, "t", "now", named="t[0]"),
    *wrong(OBSERVE, BATCH, "joint_names", "joint1", ["a"] * 1001),
    *wrong(OBSERVE, BATCH, "joint_names", ["elbow"] * 7, named="joint_names[0]"),
    *wrong(OBSERVE, BATCH, "temperature", 20),
    body(OBSERVE, {key: value for key, value in BATCH.items() if key != "ddq"}, "ddq"),
    body(OBSERVE + "/bad/x/replay", {}, "sequence"),
    body(OBSERVE + "/bad/-1/replay", {}, "sequence"),
    body(OBSERVE + "/b%20d/0/replay", {}, "stream_id"),
    *wrong(OBSERVE + "/bad/0/replay", {}, "codes", [], "contact"),
    *wrong(OBSERVE + "/bad/0/replay", {}, "codes", ["learnt"], ["edge"], [None]),
]
SETTING = [
    *wrong(LEARNING, {}, "enabled", "perhaps", "on", None, 0, 1, 2, method="PUT"),
    *wrong(LEARNING, {}, "forgetting_s", 0, -1, NAN, INF, "1 h", [], method="PUT"),
    *wrong(LEARNING, {}, "on_change", "wait", None, method="PUT"),
    *wrong(LEARNING, {}, "torque_limits", [1.0] * 6, [1.0] * 8, "87", method="PUT"),
    *wrong(LEARNING, {}, "torque_limits", first(-1), first(NAN), first(INF), named="torque_limits[0]", method="PUT"),
    *wrong(LEARNING, {}, "contact_threshold", 0, NAN, INF, None, method="PUT"),
    *wrong(LEARNING, {}, "rate", 1, method="PUT"),
    *wrong(ROLLBACK, {}, "revision", "0", False, -1, 2**53, "x", 1.5, NAN),
    *wrong(ROLLBACK, {}, "version", 0, 2**31, "x"),
    *wrong(ROLLBACK, {}, "version", 99, status=404, code="not_found"),
    *wrong("/v1/models/panda-sim/learning/change", {}, "decision", "wait", None),
    *wrong("/v1/models/panda-sim/refresh", {}, "estimator", "lip"),
    *wrong(f"{ALIASES}/best", {}, "version", 0, "x", 1.5, [], method="PUT"),
    *wrong(f"{ALIASES}/best", {}, "version", 99, status=404, code="not_found", method="PUT"),
    *(body(f"{ALIASES}/{alias}", {"version": 1}, "alias", method="PUT") for alias in ("A", "1", "a%20b")),
]
ASSESSING = [
    *wrong(EVALUATE, {}, "dataset", None, 5, [], "d" * 1000),
    *wrong(EVALUATE, {}, "dataset", "ds_0", "", status=404, code="not_found"),
    *wrong(EVALUATE, {"dataset": "ds_0"}, "version", 0, "x", 10**30),
    *wrong(EVALUATE, {"dataset": "ds_0"}, "min_revision", -1, "x", 10**30),
    *wrong(TRACE, {}, "dataset", None, 5, [], "d" * 1000),
    *wrong(TRACE, {}, "dataset", "ds_0", "", "../x", status=404, code="not_found"),
    *wrong(TRACE, {"dataset": "ds_0"}, "part", "held", None, 5),
    *wrong(TRACE, {"dataset": "ds_0"}, "start", -1, 1.5, "0", None, True, 2**53, NAN),
    *wrong(TRACE, {"dataset": "ds_0"}, "stop", -1, "10", True, 2**53, INF),
    *wrong(TRACE, {"dataset": "ds_0"}, "points", 0, -1, 2001, 2**31, "100", None, 1.0),
    *wrong(TRACE, {"dataset": "ds_0"}, "components", "gravity", None, {}),
    *wrong(TRACE, {"dataset": "ds_0"}, "components", ["inertia_matrix"], ["Gravity"], [None], named="components[0]"),
    *wrong(TRACE, {"dataset": "ds_0"}, "components", ["gravity", "gravity"], named="components[1]"),
    *wrong(TRACE, {"dataset": "ds_0"}, "version", 0, "x", 10**30),
    *wrong(COMPARE, {"dataset": "ds_0"}, "versions", [], [1], [1, 2, 3], "12", None),
    *wrong(COMPARE, {"dataset": "ds_0"}, "versions", [1, 1], named="versions[1]"),
]
INFERRING = [
    *(
        body(INFER, TENSORS | {name: value}, named, status=400)
        for name, value, named in (
            ("inputs", None, "inputs"),
            ("inputs", {}, "inputs"),
            ("inputs", [], "q"),
            ("inputs", [5], "inputs[0]"),
            ("inputs", [*TENSORS["inputs"], TENSORS["inputs"][0]], "inputs[3].name"),
            ("inputs", [TENSORS["inputs"][0] | {"shape": [-7]}, *TENSORS["inputs"][1:]], "inputs[0].shape[0]"),
            ("inputs", [TENSORS["inputs"][0] | {"data": [NAN] * 7}, *TENSORS["inputs"][1:]], "inputs[0].data[0]"),
            ("inputs", [TENSORS["inputs"][0] | {"datatype": "BYTES"}, *TENSORS["inputs"][1:]], "q.datatype"),
            ("outputs", "tau", "outputs"),
            ("outputs", [{"name": "mass"}], "outputs[0].name"),
            ("id", 5, "id"),
            ("model_name", "other", "model_name"),
            ("extra", 5, "extra"),
        )
    ),
    *(
        body(
            INFER, TENSORS, "Inference-Header-Content-Length", 400, headers={"inference-header-content-length": length}
        )
        for length in ("x", "-1", "1.5", "", "9" * 40)
    ),
]
NAMING = [
    body(path, JOB, "Idempotency-Key", headers={"idempotency-key": key})
    for path in (JOBS, f"{JOBS}/job_0/retry")
    for key in ("", "k" * 101, "two words", "tab\there")
]
BAD: list[Bad] = [*PREDICTING, *TRAINING, *NAMING, *TEACHING, *SETTING, *ASSESSING, *INFERRING]
