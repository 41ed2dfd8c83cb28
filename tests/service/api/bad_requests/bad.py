"""A wrong request and the answer that it must get."""

import json
from dataclasses import dataclass, field
from typing import Any

JSON = "application/json"
PREDICT = "/v1/models/panda-sim/predict"
EVALUATE = "/v1/models/panda-sim/evaluate"
OBSERVE = "/v1/models/panda-sim/observations"
LEARNING = "/v1/models/panda-sim/learning"
ROLLBACK = "/v1/models/panda-sim/rollback"
TRACE = "/v1/models/panda-sim/trace"
COMPARE = "/v1/models/panda-sim/compare"
ALIASES = "/v1/models/panda-sim/aliases"
INFER = "/v2/models/panda-sim/infer"
JOBS, DATASETS, ROBOTS = "/v1/jobs", "/v1/datasets", "/v1/robots"
ZERO = [0.0] * 7
QUERY = {"q": ZERO, "dq": ZERO, "ddq": ZERO}
BATCH = {"stream_id": "bad", "sequence": 0, **QUERY, "tau": ZERO}
JOB = {"model": "bad", "datasets": ["ds_0"]}
TENSORS = {"inputs": [{"name": name, "shape": [7], "datatype": "FP64", "data": ZERO} for name in QUERY]}


@dataclass(frozen=True)
class BadRequest:
    """A wrong request and its answer: status, code, and the field that the first detail names, None if no value is
    wrong. Errors below /v2 have no code, and their message begins with `named`."""

    method: str
    path: str
    status: int
    code: str
    named: str | None
    content: bytes = b""
    headers: dict[str, str] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """Return a text that identifies the request."""
        sent = self.content if len(self.content) <= 60 else self.content[:28] + b"..%d.." % len(self.content)
        about = " ".join(f"{name}:{value}" for name, value in self.headers.items() if value != JSON)
        return ascii(f"{self.method} {self.path} {about} {sent.decode('latin-1')}")[1:-1]


def body(
    path: str, content: Any, named: str | None, status: int = 422, code: str = "invalid_request", **more: Any
) -> BadRequest:
    """Return a request with a wrong JSON body: bytes, or a value to encode as JSON."""
    sent = content if isinstance(content, bytes) else json.dumps(content).encode()
    headers = {"content-type": JSON} | more.pop("headers", {})
    return BadRequest(more.pop("method", "POST"), path, status, code, named, sent, headers, **more)


def get(path: str, named: str | None, status: int = 422, code: str = "invalid_request", **headers: str) -> BadRequest:
    """Return a request that reads a wrong address."""
    return BadRequest("GET", path, status, code, named, headers=headers)
