"""Streams and payloads by the thousand, and clocks that jump."""

import json
import struct
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from math import isnan
from random import Random

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus

from tests.attack.attacked import DEADLINE, AttackedService, attack_random, query
from tests.service.data import eventually
from tests.service.streams import frame, open_stream, read, read_hello
from tests.system.faults.ledger import ARM, ROWS, batch, predict_queries, query_rows

MODEL = f"/v1/models/{ARM}"
STREAM = f"{MODEL}/stream"
MAX_STREAMS, CONNECTIONS = 8, 200
MAX_KNOWN_STREAMS = 1000
"""Streams in use of a model; more are rejected."""
TIMES = (
    *(0.0, -1.0, 1e-300, 1e9, 1.7e9, 4e9, -4e9, 1e15, 2**53, 1e300, -1e300),
    *(None, float("nan"), float("inf"), -float("inf")),
)


@pytest.fixture(scope="module")
def attacked(tmp_path_factory: pytest.TempPathFactory) -> Iterator[AttackedService]:
    with AttackedService(tmp_path_factory.mktemp("streams"), MAX_STREAMS=str(MAX_STREAMS)) as service:
        yield service


def test_connections_of_streams_by_the_hundred(attacked):
    """Beyond the limit they are refused; those that are open go on, and a closed one makes room."""
    random = attack_random("connections")
    with ExitStack() as stack:
        kept = [stack.enter_context(open_stream(attacked.server, STREAM)) for _ in range(MAX_STREAMS)]
        for connection in kept:
            read_hello(connection)
        for _ in range(CONNECTIONS):
            with pytest.raises(InvalidStatus) as refused, open_stream(attacked.server, STREAM):
                pass
            assert refused.value.response.status_code == 429
        for number, connection in enumerate(kept):
            connection.send(frame(sequence=number))
            assert read(connection.recv(DEADLINE)).sequence == number
    for _ in range(CONNECTIONS):
        with eventually(lambda: _opened(attacked)) as connection:
            if random.random() < 0.5:
                read_hello(connection)
    attacked.check_sound()


def _opened(attacked: AttackedService):
    """Return a new stream, None if the service still counts one that was closed."""
    try:
        return open_stream(attacked.server, STREAM)
    except InvalidStatus:
        return None


def wild_frame(random: Random) -> bytes | str:
    """Return a frame that is wrong in some way, or rarely right."""
    made = bytearray(frame(sequence=random.getrandbits(32)))
    kind = random.randrange(6)
    if kind == 0:
        return random.randbytes(random.randrange(200))
    if kind == 1:
        return "".join(chr(random.randrange(32, 1000)) for _ in range(random.randrange(200)))
    if kind == 2:
        return bytes(made[: random.randrange(len(made))])
    if kind == 3:
        struct.pack_into("<d", made, 16 + 8 * random.randrange(6), random.choice((1e308, float("nan"), float("inf"))))
    elif kind == 4:
        struct.pack_into("<HH", made, 4, random.getrandbits(16), random.choice((0, 1, 2, 3, 65535)))
    else:
        made[random.randrange(len(made))] ^= 1 << random.randrange(8)
    return bytes(made)


def test_wild_frames_are_answered_one_by_one(attacked):
    random, answered = attack_random("frames"), 0
    for _ in range(5):
        path = random.choice((STREAM, f"{STREAM}?stream_id=wild", f"{STREAM}?rich=1&std=1"))
        with eventually(lambda path=path: open_stream(attacked.server, path)) as connection:
            read_hello(connection)
            with suppress(ConnectionClosed):
                for _ in range(500):
                    connection.send(wild_frame(random))
                    while isinstance(received := connection.recv(DEADLINE), str):
                        json.loads(received)
                    read(received)
                    answered += 1
            assert connection.close_code in (None, 1000, 1002, 1003, 1007, 1008, 1009)
    assert answered > 100
    attacked.check_sound()


def test_streams_of_observations_by_the_thousand(attacked):
    """The model knows a thousand streams: another one replaces the one that was silent longest, or has to wait."""
    statuses = Counter()
    body = {name: value[:2] if isinstance(value, list) else value for name, value in batch(0).items()}
    for number in range(MAX_KNOWN_STREAMS + 50):
        answer = attacked.client.post(f"{MODEL}/observations", json=body | {"stream_id": f"s-{number}"})
        statuses[answer.status_code] += 1
    assert set(statuses) <= {200, 429}
    assert query_rows(attacked.home, "SELECT count(*) FROM streams WHERE model = ?", ARM)[0][0] <= MAX_KNOWN_STREAMS
    newest = f"s-{statuses[200] - 1}" if statuses[429] else f"s-{MAX_KNOWN_STREAMS + 49}"
    answer = attacked.client.post(f"{MODEL}/observations", json=body | {"stream_id": newest, "sequence": 1})
    assert answer.status_code == 200, answer.text
    assert attacked.client.get(f"{MODEL}/learning").status_code == 200
    assert attacked.client.get("/v1/overview").status_code == 200
    for number in range(MAX_KNOWN_STREAMS):
        answer = attacked.client.delete(f"{MODEL}/streams/s-{number}")
        assert answer.status_code in (200, 204, 404), answer.text
    attacked.check_sound()


def test_payloads_by_the_thousand(attacked):
    """Each query names another payload; those of the model are bounded, and answers without one stay the same."""
    random, zeros = attack_random("payloads"), {name: [0.0] * 7 for name in ("q", "dq", "ddq")}
    path = "/v1/models/panda-sim/predict"
    before = attacked.client.post(path, json=zeros).content
    statuses = Counter()
    for _ in range(1200):
        mass = random.choice((random.uniform(0.01, 10), 10 ** random.uniform(-300, 6)))
        payload = {"mass": mass, "com": [random.uniform(-1, 1) * 10 ** random.uniform(-3, 6) for _ in range(3)]}
        answer = attacked.client.post(path, json=zeros | {"payload": payload})
        query(answer)
        statuses[answer.status_code] += 1
    assert set(statuses) <= {200, 422}
    assert statuses[200] > 400
    for number in range(300):
        payload = {"stream_id": f"p-{number}", "mass": 1.0, "com": [0.0, 0.0, random.random()]}
        answer = attacked.client.put("/v1/models/panda-sim/payload", json=payload)
        assert answer.status_code in (200, 404, 409, 422, 429), answer.text
    assert attacked.client.post(path, json=zeros).content == before
    attacked.check_sound()


def test_wild_clocks_of_streams(attacked):
    """Rows of any time are answered, the model stays finite, and a stream with a correct clock is learnt."""
    random = attack_random("clocks")
    options = {"contact_threshold": 100.0, "on_change": "learn", "auto_refresh": False, "forgetting_s": 600.0}
    assert attacked.client.put(f"{MODEL}/learning", json=options).status_code == 200
    sequence = Counter()
    for number in range(200):
        stream_id, body = f"clock-{random.randrange(5)}", batch(number)
        jump, scale = random.choice(TIMES), random.choice((0.0, 1.0, -1.0, 1e-9, 1e6))
        if jump is None or isnan(jump) or random.random() < 0.2:
            body["t"] = [random.choice(TIMES) for _ in range(ROWS)]
        else:
            body["t"] = [jump + scale * row / 100 for row in range(ROWS)]
        body |= {"stream_id": stream_id, "sequence": sequence[stream_id]}
        text = json.dumps(body)  # writes NaN and Infinity, as Python does
        headers = {"content-type": "application/json"}
        answer = attacked.client.post(f"{MODEL}/observations", content=text, headers=headers)
        assert answer.status_code in (200, 422), answer.text
        seen = query(answer)
        if answer.status_code == 200:
            assert 0 <= seen["accepted"] <= ROWS
            sequence[stream_id] += 1
    assert sequence.total() > 50
    good = attacked.client.post(f"{MODEL}/observations", json=batch(201) | {"stream_id": "good", "sequence": 0})
    assert good.json()["accepted"] == ROWS, good.text
    seen = eventually(
        lambda: (at := predict_queries(attacked.client, ARM))["revision"] >= good.json()["revision"] and at
    )
    assert min(map(min, seen["tau_std"])) > 0
    for part in ("quality", "learning", "alarms", "observations"):
        query(attacked.client.get(f"{MODEL}/{part}"))
    attacked.check_sound()
