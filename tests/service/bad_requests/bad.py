"""One wrong request and what it has to be answered with."""

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
class Bad:
    """A request and its answer: status, code, and the field that the first of its details names, None where no value
    is wrong. Below /v2 there is no code, and `named` is what the message begins with."""

    method: str
    path: str
    status: int
    code: str
    named: str | None
    content: bytes = b""
    headers: dict[str, str] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """What tells it from the others."""
        sent = self.content if len(self.content) <= 60 else self.content[:28] + b"..%d.." % len(self.content)
        about = " ".join(f"{name}:{value}" for name, value in self.headers.items() if value != JSON)
        return ascii(f"{self.method} {self.path} {about} {sent.decode('latin-1')}")[1:-1]


def body(
    path: str, content: Any, named: str | None, status: int = 422, code: str = "invalid_request", **more: Any
) -> Bad:
    """A wrong JSON body: bytes as they are, or what is to be written as JSON."""
    sent = content if isinstance(content, bytes) else json.dumps(content).encode()
    headers = {"content-type": JSON} | more.pop("headers", {})
    return Bad(more.pop("method", "POST"), path, status, code, named, sent, headers, **more)


def get(path: str, named: str | None, status: int = 422, code: str = "invalid_request", **headers: str) -> Bad:
    """A wrong address of something to be read."""
    return Bad("GET", path, status, code, named, headers=headers)
