"""Time and memory that invalid request bodies cost, and the delay of other requests.

    python benchmarks/studies/bodies.py [MODEL_FOLDER]

Each route of the OpenAPI document that reads JSON gets bodies of 64 KiB to 2 MiB in several shapes, while another
connection requests `/health/live` continuously. For each shape the slowest route is printed.
"""

from __future__ import annotations

import json
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx

import lipcore
from benchmarks.online.bed import Bed, install, serving
from benchmarks.processes import resident_mib
from service.contract.observations import LearningOptions

MODEL, SIZES = "panda-sim", (1 << 16, 1 << 18, 1 << 20, (1 << 21) - 4096)
PLACES = {
    "model": MODEL,
    "version": "1",
    "dataset": "ds_0",
    "robot": "ur_0",
    "job": "job_0",
    "alias": "a",
    "stream_id": "s",
}
Route = tuple[str, str, tuple[str, ...]]
"""Method, path, and the fields that are lists."""


def routes(document: dict[str, Any]) -> Iterator[Route]:
    """Yield the routes that read JSON."""
    schemas = document["components"]["schemas"]
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            content = operation.get("requestBody", {}).get("content", {})
            if "application/json" in content and "text/csv" not in content:
                schema = content["application/json"].get("schema", {})
                fields = schemas.get(schema.get("$ref", "").rpartition("/")[2], schema).get("properties", {})
                lists = tuple(name for name, each in fields.items() if '"array"' in json.dumps(each))
                yield method.upper(), path.format_map(_Places(PLACES)), lists


class _Places(dict[str, str]):
    def __missing__(self, name: str) -> str:
        return name


def shapes(size: int, lists: tuple[str, ...]) -> Iterator[tuple[str, bytes]]:
    """Yield name and content of invalid bodies of about `size` bytes."""
    many = b",".join(b'"k%d":0' % number for number in range(size // 12))
    yield "unknown fields", b"{" + many + b"}"
    yield "one field twice", b"{" + many + b',"k0":0}'
    yield "nested", b'{"q":' + b"[" * (size // 2) + b"]" * (size // 2) + b"}"
    yield "a long text", b'{"model":"' + b"x" * size + b'"}'
    yield "one long number", b'{"version":' + b"1" * size + b"}"
    for kind, item in (("wrong items", b'"?"'), ("numbers", b"0"), ("objects", b"{}")):
        for name in lists:
            yield f"lists of {kind}", b'{"%b":[' % name.encode() + b",".join([item] * (size // (len(item) + 1))) + b"]}"


@contextmanager
def asking(bed: Bed) -> Iterator[list[float]]:
    """Send cheap requests continuously; yield a list with the longest time, s."""
    over, longest = threading.Event(), [0.0]

    def ask() -> None:
        with httpx.Client(base_url="http://{}:{}".format(*bed.tcp), timeout=120) as client:
            while not over.is_set():
                began = time.monotonic()
                client.get("/health/live")
                longest[0] = max(longest[0], time.monotonic() - began)

    thread = threading.Thread(target=ask)
    thread.start()
    try:
        yield longest
    finally:
        over.set()
        thread.join()


def measured(bed: Bed, client: httpx.Client, route: Route, body: bytes) -> tuple[float, float, float, int]:
    """Return seconds until the answer, the longest time of other answers, s, additional MiB, and the status."""
    Path(f"/proc/{bed.pid}/clear_refs").write_text("5")  # reset the peak
    before = resident_mib(bed.pid, "VmRSS") or 0.0
    with asking(bed) as longest:
        began = time.monotonic()
        status = client.request(
            route[0], route[1], content=body, headers={"content-type": "application/json"}
        ).status_code
        seconds = time.monotonic() - began
    return seconds, longest[0], (resident_mib(bed.pid, "VmHWM") or 0.0) - before, status


def main(folder: Path) -> None:
    """Measure and print."""
    with tempfile.TemporaryDirectory() as made:
        home = Path(made) / "home"
        install(home, folder, {MODEL: LearningOptions(auto_refresh=False)}, lipcore.load(folder).n_joints)
        with serving(home) as bed, httpx.Client(base_url="http://{}:{}".format(*bed.tcp), timeout=600) as client:
            worst: dict[tuple[str, int], tuple[float, float, float, str]] = {}
            for route in routes(client.get("/openapi.json").json()):
                for size in SIZES:
                    for shape, body in shapes(size, route[2]):
                        seconds, other, more, status = measured(bed, client, route, body)
                        found = seconds, other, more, f"{status} {route[0]} {route[1]}"
                        worst[shape, size] = max(worst.get((shape, size), found), found)
    print(f"{'':20} {'KiB':>5} {'answer ms':>10} {'others ms':>10} {'MiB':>6}")
    for (shape, size), (seconds, other, more, which) in sorted(worst.items()):
        print(f"{shape:20} {size >> 10:5} {1e3 * seconds:10.0f} {1e3 * other:10.0f} {more:6.0f}  {which}")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if sys.argv[1:] else Path(__file__).parents[2] / "models" / MODEL)
