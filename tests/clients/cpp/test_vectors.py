"""Both clients write and read the bytes of clients/stream-vectors.txt (docs/reference/stream-protocol.md).

The Python client is tested here, the C++ client by a separate program.
"""

import base64
import math
import struct
from collections import defaultdict
from typing import Any

import numpy as np
import pytest
from websockets.frames import Frame, Opcode
from websockets.utils import accept_key, apply_mask

from lipserve.answers import StreamAnswer, StreamError, StreamPart, read_answer
from lipserve.exchange import Exchange
from tests.clients.cpp.building import CPP, VECTORS, built, checked, fuzzes, here
from tests.service.streams import read


def vectors() -> dict[str, list[dict[str, Any]]]:
    """Return the vectors by kind, as dictionaries of texts; `bytes` is bytes."""
    found: dict[str, list[dict[str, Any]]] = defaultdict(list)
    group: list[dict[str, Any]] = []
    for line in VECTORS.read_text("utf-8").splitlines():
        if not line or line.startswith("#"):
            continue
        word, _, rest = line.strip().partition(" ")
        if not line.startswith(" "):
            group = found[word]
            group.append({"name": rest})
        else:
            group[-1][word] = bytes.fromhex(rest) if word == "bytes" else rest
    return found


KINDS = vectors()


def each(kind: str) -> Any:
    return pytest.mark.parametrize("vector", KINDS[kind], ids=lambda vector: vector["name"])


def numbers(text: str) -> np.ndarray:
    return np.array([float(word) for word in text.split()])


def test_vectors_cover_every_kind():
    assert {kind: len(group) for kind, group in KINDS.items()} == {
        "request": 7, "answer": 9, "error": 3, "text": 2, "websocket": 3, "handshake": 1,
    }  # fmt: skip


@each("request")
def test_python_client_writes_requests(vector):
    flags, tau = int(vector["flags"]), vector.get("tau")
    exchange = Exchange("arm", int(vector["sequence"]))
    if flags >= 8:
        states = [numbers(vector[name]) for name in ("q", "dq") if name in vector]
        made = exchange.part_frame(flags, float(vector["deadline"]), *states)
        assert made == (int(vector["sequence"]), vector["bytes"])
        return
    sequence, made = exchange.frame(
        *(numbers(vector[name]) for name in ("q", "dq", "ddq")),
        std=bool(flags & 1),
        deadline=float(vector["deadline"]),
        tau=None if tau is None else numbers(tau),
        external=bool(flags & 4),
        learn=bool(flags & 2),
    )
    assert (sequence, made) == (int(vector["sequence"]), vector["bytes"])


@each("answer")
def test_python_client_reads_answers(vector):
    answer = read_answer(vector["bytes"])
    assert not isinstance(answer, StreamError)
    for name in ("sequence", "version", "late_answers", "revision"):
        assert getattr(answer, name) == int(vector[name])
    assert answer.seconds == float(vector["seconds"])
    assert answer.late == bool(int(vector["flags"]) & 2)
    if isinstance(answer, StreamPart):
        (name,) = {"gravity", "mass_matrix", "coriolis"} & vector.keys()
        assert answer.mean.shape == ((2, 2) if name == "mass_matrix" else (2,))
        np.testing.assert_array_equal(answer.mean.ravel(), numbers(vector[name]))
        assert (answer.std is not None) == ("gravity_std" in vector)
        if answer.std is not None:
            np.testing.assert_array_equal(answer.std, numbers(vector["gravity_std"]))
        return
    assert isinstance(answer, StreamAnswer)
    assert answer.fallback == bool(int(vector["flags"]) & 128)
    for name in ("tau", "tau_std", "scale"):
        assert (getattr(answer, name) is not None) == (name in vector)
        if name in vector:
            np.testing.assert_array_equal(getattr(answer, name), numbers(vector[name]))
    assert (answer.external is not None) == ("external_tau" in vector)
    if answer.external is not None:
        for name in ("tau", "std", "z", "statistic", "p"):
            np.testing.assert_array_equal(np.ravel(getattr(answer.external, name)), numbers(vector[f"external_{name}"]))
    assert (answer.payload is not None) == ("payload" in vector)
    if answer.payload is not None:
        np.testing.assert_array_equal(answer.payload, numbers(vector["payload"]))


@each("answer")
def test_reader_of_the_tests_agrees(vector):
    answer = read(vector["bytes"])
    name = next(name for name in ("tau", "gravity", "mass_matrix", "coriolis") if name in vector)
    np.testing.assert_array_equal(np.ravel(getattr(answer, "tau" if name == "tau" else "part")), numbers(vector[name]))
    assert (answer.scale is not None) == ("scale" in vector)


@each("error")
def test_python_client_reads_errors(vector):
    error = read_answer(vector["bytes"])
    assert isinstance(error, StreamError)
    assert (error.code, error.message) == (vector["code"], vector["message"])
    assert error.sequence == (None if int(vector["flags"]) & 8 else int(vector["sequence"]))


@each("text")
def test_python_client_reads_texts(vector):
    exchange = Exchange("arm", 1)
    exchange.receive(vector["bytes"].decode())
    if vector["name"] == "learnt":
        learnt = exchange.learnt
        rejected = sum(learnt.rejected.values())
        seen = {"through": learnt.through, "accepted": learnt.accepted, "duplicates": learnt.duplicates}
        seen |= {"rejected": rejected, "revision": learnt.revision}
    else:
        refusal = exchange.refusals[0]
        seen = {name: getattr(refusal, name) for name in ("first", "through", "code", "message")}
    assert {name: str(value) for name, value in seen.items()} == {
        name: value for name, value in vector.items() if name not in ("name", "bytes")
    }


@each("websocket")
def test_frames_match_a_websocket_library(vector):
    payload = bytes.fromhex(vector["payload"])
    unmasked = Frame(Opcode(int(vector["opcode"])), payload).serialize(mask=False)
    head = unmasked[: len(unmasked) - len(payload)]
    masked = bytes([head[0], head[1] | 128]) + head[2:] + bytes.fromhex(vector["mask"])
    assert masked + apply_mask(payload, bytes.fromhex(vector["mask"])) == vector["bytes"]


@each("handshake")
def test_accepted_key_matches_a_websocket_library(vector):
    assert accept_key(vector["key"]).encode() == vector["bytes"]
    assert len(base64.b64decode(vector["key"])) == 16


def test_vectors_contain_edge_cases():
    values = np.concatenate([numbers(vector[name]) for vector in KINDS["request"][:4] for name in ("q", "dq", "ddq")])
    assert any(math.copysign(1.0, value) < 0 and value == 0 for value in values)
    assert struct.unpack_from("<I", KINDS["request"][2]["bytes"])[0] == 2**32 - 1


@pytest.mark.journey
def test_cpp_client_agrees(any_compiler, tmp_path):
    program = built(any_compiler, "tests/check_vectors.cpp", tmp_path)
    assert f"{sum(map(len, KINDS.values()))} vectors, 0 failures" in checked(program, str(VECTORS))


def test_cpp_client_compiles_optimised_and_without_exceptions(compiler, tmp_path):
    assert "throw" not in [word for line in (CPP / "include/lipserve/client.hpp").read_text().splitlines()
                           for word in line.partition("//")[0].split()]  # fmt: skip
    source = tmp_path / "bare.cpp"
    source.write_text("#include <lipserve/client.hpp>\nint main() { lipserve::Client client{{}}; }\n")
    built(compiler, str(source), tmp_path, "-O3", "-fno-exceptions", "-fno-rtti")


def test_cpp_client_never_reads_out_of_bounds(tmp_path):
    """Fuzz from the vectors with a fixed seed; the fuzzer fails if a sanitizer reports an error."""
    options = ("-O1", "-g", "-fsanitize=fuzzer,address,undefined", "-fno-sanitize-recover=all")
    if not here("clang++") or not fuzzes("clang++"):
        pytest.skip("clang++ with its fuzzer is not installed")
    corpus = tmp_path / "corpus"
    corpus.mkdir()
    for kind, group in KINDS.items():
        for vector in group:
            data = vector["bytes"][32:] if kind == "error" else vector["bytes"]
            (corpus / f"{kind}-{vector['name']}").write_bytes(data)
    program = built("clang++", "tests/fuzz.cpp", tmp_path, *options)
    checked(program, "-runs=100000", "-seed=1", "-max_len=400", str(corpus))
