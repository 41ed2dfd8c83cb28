"""Wrong paths, methods, query parameters and headers."""

from __future__ import annotations

from tests.service.bad_requests.bad import (
    ALIASES,
    DATASETS,
    EVALUATE,
    INFER,
    JOBS,
    LEARNING,
    OBSERVE,
    PREDICT,
    QUERY,
    ROBOTS,
    TENSORS,
    Bad,
    body,
    get,
)

MODELS, EXPORT, URDF = "/v1/models", "/v1/models/panda-sim/export", "/v1/models/panda-sim/urdf"
NO_ROUTES = (
    "/dashboard",
    "/dashboard/%2e%2e/routes.py",
    "/v1",
    "/v1/",
    "//v1/models",
    "/v1//models",
    "/v1/models/",
    "/v1/models/panda-sim/",
    "/V1/models",
    "/v1/models;x=1",
    "/v1/models%00",
    "/v1/models/panda-sim/versions",
    "/v1/models/panda-sim/versions/1/files",
    "/v1/models/%2e%2e/%2e%2e/etc/passwd",
    "/v1/datasets/..%2f..%2fetc%2fpasswd",
    "/v1/datasets/../../etc/passwd",
    "/static-offline-docs/%2e%2e/core.py",
    "/static-offline-docs/..%5ccore.py",
    "/static-offline-docs/%00",
    "/static-offline-docs//etc/passwd",
    "/admin",
    "/.git/config",
    "/v1/\u202emodels",
    "/" + "a" * 5000,
)
NOBODY = (
    "nobody",
    "PANDA-SIM",
    "panda-sim%20",
    "panda-sim%00",
    "%2e%2e",
    "%ff",
    "p\u0430nda-sim",
    "panda\u200b-sim",
    "a" * 3000,
)
WRONG_METHODS = (
    ("POST", "/health/live"),
    ("DELETE", "/health/ready"),
    ("POST", "/metrics"),
    ("PUT", DATASETS),
    ("PATCH", DATASETS),
    ("OPTIONS", DATASETS),
    ("TRACE", DATASETS),
    ("BREW", DATASETS),
    ("PUT", f"{DATASETS}/ds_0"),
    ("DELETE", ROBOTS),
    ("DELETE", JOBS),
    ("GET", f"{JOBS}/job_0/cancel"),
    ("POST", MODELS),
    ("POST", f"{MODELS}/panda-sim"),
    ("GET", PREDICT),
    ("PUT", PREDICT),
    ("GET", EVALUATE),
    ("POST", LEARNING),
    ("PUT", OBSERVE),
    ("GET", "/v1/echo"),
    ("POST", "/docs"),
    ("DELETE", "/openapi.json"),
)
PAGES = (DATASETS, ROBOTS, JOBS, MODELS, OBSERVE, f"{MODELS}/panda-sim/alarms")

PATHS = [
    *(get(path, None, 404, "not_found") for path in NO_ROUTES),
    *(get(f"{MODELS}/{name}", "model", 404, "not_found") for name in NOBODY),
    *(get(f"{DATASETS}/{name}", "dataset", 404, "not_found") for name in ("ds_0", "%00", "%2e%2e", "x" * 500)),
    *(get(f"{ROBOTS}/{name}", "robot", 404, "not_found") for name in ("urdf_0", "panda", "%F0%9F%A4%96")),
    *(get(f"{ROBOTS}/profiles/{name}", "robot", 404, "not_found") for name in ("urdf_0", "%2e%2e", "%00", "x" * 500)),
    *(get(f"{JOBS}/{name}", "job", 404, "not_found") for name in ("job_0", "%E2%80%AE")),
    *(
        get(f"{MODELS}/panda-sim/versions/{v}", "version")
        for v in ("x", "0", "-1", "1.5", "1e3", "2147483648", "%31x", "٣%20")
    ),
    get(f"{MODELS}/panda-sim/versions/99", "version", 404, "not_found"),
    *(get(f"{OBSERVE}/cell-3/{n}", "sequence") for n in ("x", "-1", "9007199254740992", "1.5")),
    get(f"{OBSERVE}/c%0all/0", "stream_id"),
    body(f"{MODELS}/nobody/predict", QUERY, "model", 404, "not_found"),
    Bad("DELETE", f"{DATASETS}/ds_0", 404, "not_found", "dataset"),
    *(Bad("POST", f"{JOBS}/job_0/{verb}", 404, "not_found", "job") for verb in ("cancel", "retry")),
    get(f"{JOBS}/job_0/events", "job", 404, "not_found"),
    *(
        get(f"{MODELS}/nobody/{part}", "model", 404, "not_found")
        for part in ("aliases", "export", "urdf", "alarms", "quality", "live")
    ),
    Bad("DELETE", f"{MODELS}/nobody", 404, "not_found", "model"),
    Bad("DELETE", f"{MODELS}/panda-sim/versions/99", 404, "not_found", "version"),
    Bad("DELETE", f"{MODELS}/panda-sim/versions/0", 422, "invalid_request", "version"),
    Bad("DELETE", f"{MODELS}/panda-sim/versions/1", 409, "conflict", None),
    Bad("DELETE", f"{ALIASES}/serving", 409, "conflict", None),
    *(
        Bad(*one, 404, "not_found", "alias")
        for one in (("DELETE", f"{ALIASES}/no"), ("POST", f"{ALIASES}/no/rollback"))
    ),
    *(Bad("DELETE", f"{ALIASES}/{alias}", 422, "invalid_request", "alias") for alias in ("A", "1", "s%D0%B5rving")),
    *(
        get(path, "no route", 404, "")
        for path in ("/v2/", "/v2/models", "/v2//models/panda-sim", "/v2/%2e%2e/v1/models")
    ),
    *(get(f"/v2/models/{name}", "no model", 404, "") for name in ("nobody", "%2e%2e", "p\u0430nda-sim")),
    *(get(f"/v2/models/panda-sim/versions/{v}", "version is", 404, "") for v in ("0", "01", "x", "%00", "9" * 50)),
]
METHODS = [
    *(Bad(method, path, 405, "method_not_allowed", None) for method, path in WRONG_METHODS),
    Bad("GET", INFER, 405, "", "no route GET"),
    Bad("POST", "/v2", 405, "", "no route POST"),
]
PARAMETERS = [
    *(get(f"{path}?limit={value}", "limit") for path in PAGES for value in ("0", "x", "101")),
    *(
        get(f"{DATASETS}?limit={value}", "limit")
        for value in ("-1", "1.5", "1e400", "", "nan", "%00", "1;cursor=2", "9" * 400)
    ),
    *(get(f"{JOBS}?cursor={value}", "cursor") for value in ("x", "", "-1", "1.5", "9" * 20, "%D9%A3", "1%00", "1%20")),
    *(get(f"{path}?limt=1", "limt") for path in PAGES),
    *(get(f"{path}?x", "x") for path in ("/health/live", "/health/ready", "/metrics", f"{MODELS}/panda-sim", LEARNING)),
    get(f"{MODELS}/panda-sim/live?every=1", "every"),
    get(f"{DATASETS}?limit=1&limit=2", "limit"),
    get(f"{DATASETS}?Limit=1", "Limit"),
    get(f"{DATASETS}?limit%00=1", "limit\\x00"),
    get(f"{DATASETS}?%E2%80%AElimit=1", "\\u202elimit"),
    get(f"{DATASETS}?=1", "query"),
    get(f"{DATASETS}?{'&'.join(f'a{i}=1' for i in range(101))}", "query"),
    *(get(f"{EXPORT}?version={value}", "version") for value in ("0", "x", "", "1.5", "2147483648")),
    *(get(f"{EXPORT}?alias={value}", "alias") for value in ("", "A", "a%00", "1")),
    get(f"{EXPORT}?learnt=perhaps", "learnt"),
    *(get(f"{URDF}?{asked}", field) for asked, field in (("version=0", "version"), ("alias=A", "alias"), ("v=1", "v"))),
    get(f"{URDF}?version=1&alias=serving", "version or alias"),
    get(f"{URDF}?version=99", "version", 404, "not_found"),
    get(f"{URDF}?alias=nobody", "alias", 404, "not_found"),
    get(f"{EXPORT}?version=1&alias=serving", "version or alias"),
    get(f"{EXPORT}?version=99", "version", 404, "not_found"),
    get(f"{EXPORT}?alias=nobody", "alias", 404, "not_found"),
    get(f"{OBSERVE}?rejected=perhaps", "rejected"),
    get(f"{OBSERVE}?stream_id=a%20b", "stream_id"),
    get(f"{OBSERVE}/cell-3/0?rows=2", "rows"),
    body(f"{PREDICT}?version=1", QUERY, "version"),
    body(f"{EVALUATE}?x=1", {"dataset": "ds_0"}, "x"),
    body(f"{OBSERVE}?x=1", {}, "x"),
    body("/v1/echo?x=1", {}, "x"),
    body(f"{JOBS}?x=1", {}, "x"),
    Bad("DELETE", f"{DATASETS}/ds_0?force=1", 422, "invalid_request", "force"),
    *(get(f"{path}?x=1", "x is 1", 400, "") for path in ("/v2", "/v2/health/live", "/v2/models/panda-sim")),
    body(f"{INFER}?x=1", TENSORS, "x is 1", 400),
]
HEADERS = [
    *(
        body(path, QUERY, "Content-Encoding", 415, "unsupported_media_type", headers={"content-encoding": encoding})
        for path in (EVALUATE, JOBS)
        for encoding in ("gzip", "br", "zstd", "rot13", "")
    ),
    body(INFER, TENSORS, "Content-Encoding", 415, headers={"content-encoding": "gzip"}),
    *(
        get(MODELS, "host", 403, "forbidden", host=name)
        for name in ("evil.example", "localhost.evil.example", "10.0.0.1", "")
    ),
    *(
        body(path, {}, "origin", 403, "forbidden", headers={"origin": origin})
        for path in (PREDICT, JOBS)
        for origin in ("https://evil.example", "null", "http://localhost.evil.example")
    ),
    *(body(path, b" " * (8 * 2**20 + 1), None, 413, "too_large") for path in (PREDICT, EVALUATE, JOBS, OBSERVE)),
    body(INFER, b" " * (8 * 2**20 + 1), "the body has more", 413),
]
BAD: list[Bad] = [*PATHS, *METHODS, *PARAMETERS, *HEADERS]
