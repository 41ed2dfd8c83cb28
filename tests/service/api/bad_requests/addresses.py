"""Wrong paths, methods, query parameters and headers."""

from tests.service.api.bad_requests.bad import (
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
    BadRequest,
    body,
    get,
)

MODELS, EXPORT = "/v1/models", "/v1/models/panda-sim/export"
NO_ROUTES = (
    *("/dashboard", "/dashboard/%2e%2e/routes.py", "/v1", "//v1/models", "/v1/models/", "/V1/models", "/v1/models;x=1"),
    *("/v1/models%00", "/v1/models/%2e%2e/%2e%2e/etc/passwd", "/v1/datasets/..%2f..%2fetc%2fpasswd"),
    *("/v1/\u202emodels", "/static-offline-docs/%2e%2e/core.py", "/static-offline-docs/%00", "/.git/config"),
    "/" + "a" * 5000,
)
NOBODY = ("nobody", "PANDA-SIM", "panda-sim%00", "%2e%2e", "%ff", "p\u0430nda-sim", "a" * 3000)
WRONG_METHODS = (
    *(("POST", "/health/live"), ("POST", "/metrics"), ("PUT", DATASETS), ("OPTIONS", DATASETS), ("BREW", DATASETS)),
    *(("DELETE", JOBS), ("GET", f"{JOBS}/job_0/cancel"), ("POST", MODELS), ("GET", PREDICT), ("GET", EVALUATE)),
    *(("POST", LEARNING), ("PUT", OBSERVE), ("GET", "/v1/echo"), ("DELETE", "/openapi.json")),
)
PAGES = (DATASETS, ROBOTS, JOBS, MODELS, OBSERVE, f"{MODELS}/panda-sim/alarms")
PARTS = ("aliases", "export", "alarms", "quality", "live")
MISSING = (
    *(("GET", f"{DATASETS}/ds_0", "dataset"), ("DELETE", f"{DATASETS}/ds_0", "dataset")),
    *(("GET", f"{DATASETS}/ds_0/preview", "dataset"), ("GET", f"{ROBOTS}/urdf_0", "robot")),
    *(("GET", f"{ROBOTS}/profiles/%2e%2e", "robot"), ("GET", f"{JOBS}/%E2%80%AE", "job")),
    *(("GET", f"{JOBS}/job_0/events", "job"), ("POST", f"{JOBS}/job_0/cancel", "job")),
    *(("POST", f"{JOBS}/job_0/retry", "job"), ("DELETE", f"{MODELS}/nobody", "model")),
    *(("GET", f"{MODELS}/nobody/{part}", "model") for part in PARTS),
    *(("GET", f"{MODELS}/nobody/versions/1", "model"), ("GET", f"{MODELS}/panda-sim/versions/99", "version")),
    *(("DELETE", f"{MODELS}/panda-sim/versions/99", "version"), ("DELETE", f"{ALIASES}/no", "alias")),
    *(("POST", f"{ALIASES}/no/rollback", "alias"), ("GET", f"{EXPORT}?version=99", "version")),
    *(("GET", f"{EXPORT}?alias=nobody", "alias"), ("GET", f"{EXPORT}?version=99&format=urdf", "version")),
)
"""Paths of things that do not exist, and the field that the error names."""

PATHS = [
    *(get(path, None, 404, "not_found") for path in NO_ROUTES),
    *(get(f"{MODELS}/{name}", "model", 404, "not_found") for name in NOBODY),
    *(BadRequest(method, path, 404, "not_found", named) for method, path, named in MISSING),
    *(get(f"{MODELS}/panda-sim/versions/{v}", "version") for v in ("x", "0", "1.5", "2147483648", "٣%20")),
    *(get(f"{OBSERVE}/cell-3/{n}", "sequence") for n in ("x", "-1", "9007199254740992")),
    get(f"{OBSERVE}/c%0all/0", "stream_id"),
    body(f"{MODELS}/nobody/predict", QUERY, "model", 404, "not_found"),
    BadRequest("DELETE", f"{MODELS}/panda-sim/versions/1", 409, "conflict", None),
    BadRequest("DELETE", f"{ALIASES}/serving", 409, "conflict", None),
    *(
        BadRequest("DELETE", f"{ALIASES}/{alias}", 422, "invalid_request", "alias")
        for alias in ("A", "1", "s%D0%B5rving")
    ),
    *(get(path, "There is no route", 404, "") for path in ("/v2/", "/v2//models/panda-sim", "/v2/%2e%2e/v1/models")),
]
METHODS = [
    *(BadRequest(method, path, 405, "method_not_allowed", None) for method, path in WRONG_METHODS),
    BadRequest("GET", INFER, 405, "", "There is no route GET"),
]
PARAMETERS = [
    *(get(f"{path}?limit={value}", "limit") for path in PAGES for value in ("0", "x", "101")),
    *(get(f"{DATASETS}?limit={value}", "limit") for value in ("1.5", "1e400", "", "%00", "1;cursor=2", "9" * 400)),
    *(get(f"{JOBS}?cursor={value}", "cursor") for value in ("x", "", "-1", "9" * 20, "%D9%A3", "1%00", "1%20")),
    *(get(f"{path}?limt=1", "limt") for path in PAGES),
    *(get(f"{path}?x", "x") for path in ("/health/live", "/health/ready", "/metrics", f"{MODELS}/panda-sim", LEARNING)),
    get(f"{MODELS}/panda-sim/live?every=1", "every"),
    get(f"{DATASETS}/ds_0/preview?points=1", "points"),
    *(get(f"{DATASETS}/ds_0/preview?quantities={value}", "quantities") for value in ("q,force", "q,q")),
    get(f"{DATASETS}?limit=1&limit=2", "limit"),
    get(f"{DATASETS}?Limit=1", "Limit"),
    get(f"{DATASETS}?limit%00=1", "limit\\x00"),
    get(f"{DATASETS}?%E2%80%AElimit=1", "\\u202elimit"),
    get(f"{DATASETS}?=1", "query"),
    get(f"{DATASETS}?{'&'.join(f'a{i}=1' for i in range(101))}", "query"),
    *(get(f"{EXPORT}?version={value}", "version") for value in ("0", "x", "2147483648")),
    *(get(f"{EXPORT}?alias={value}", "alias") for value in ("", "A", "a%00")),
    get(f"{EXPORT}?version=1&alias=serving", "version or alias"),
    get(f"{EXPORT}?learnt=perhaps", "learnt"),
    get(f"{EXPORT}?v=1", "v"),
    get(f"{OBSERVE}?rejected=perhaps", "rejected"),
    get(f"{OBSERVE}?stream_id=a%20b", "stream_id"),
    get(f"{OBSERVE}/cell-3/0?rows=2", "rows"),
    body(f"{PREDICT}?version=1", QUERY, "version"),
    *(body(f"{path}?x=1", {}, "x") for path in (EVALUATE, OBSERVE, "/v1/echo", JOBS)),
    BadRequest("DELETE", f"{DATASETS}/ds_0?force=1", 422, "invalid_request", "force"),
    *(
        get(f"{path}?x=1", "Unknown query parameter `x`", 400, "")
        for path in ("/v2", "/v2/health/live", "/v2/models/panda-sim")
    ),
    body(f"{INFER}?x=1", TENSORS, "Unknown query parameter `x`", 400),
]
ENCODED, TYPED = ("Content-Encoding", 415, "unsupported_media_type"), ("content-type", 415, "unsupported_media_type")
HEADERS = [
    *(body(path, QUERY, *ENCODED, headers={"content-encoding": kind}) for path, kind in ((EVALUATE, "br"), (JOBS, ""))),
    *(body(path, b"{}", *TYPED, headers={"content-type": "text/plain"}) for path in (EVALUATE, OBSERVE, JOBS)),
    *(get(MODELS, "host", 403, "forbidden", host=name) for name in ("localhost.evil.example", "10.0.0.1", "")),
    *(
        body(path, {}, "origin", 403, "forbidden", headers={"origin": origin})
        for path in (PREDICT, JOBS)
        for origin in ("null", "http://localhost.evil.example")
    ),
    *(
        body(path, {}, "Idempotency-Key", headers={"idempotency-key": key})
        for path in (JOBS, f"{JOBS}/job_0/retry")
        for key in ("", "k" * 101, "two words", "tab\there")
    ),
    *(body(path, b" " * (8 * 2**20 + 1), None, 413, "too_large") for path in (PREDICT, EVALUATE, JOBS, OBSERVE)),
]
BAD: list[BadRequest] = [*PATHS, *METHODS, *PARAMETERS, *HEADERS]
