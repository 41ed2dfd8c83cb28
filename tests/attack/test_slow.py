"""Slow clients: headers and bodies of a byte at a time, and answers that nobody reads."""

import selectors
import socket
from collections import Counter
from contextlib import ExitStack
from threading import Event, Thread

import httpx

from service.api.limits.requests import PATIENCE
from tests.attack.attacked import DEADLINE, REFERENCE, AttackedService, attack_random

ADDRESS = "127.0.0.2"
"""Address of the attacker. Limits of a client are those of an address, and the other client has another."""
CLIENTS = 60
HEAD = "POST {} HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/json\r\ncontent-length: 90000\r\n\r\n"
PATHS = (
    *("/v1/models/panda-sim/predict", "/v1/models/panda-sim/observations", "/v1/jobs", "/v1/datasets", "/v1/echo"),
    *("/v2/models/panda-sim/infer", "/v1/robots", "/v1/models/import", "/v1/models/panda-sim/evaluate"),
)


def test_slow_clients_are_disconnected_and_delay_nobody(tmp_path):
    """Each sends a byte a second, until the service closes the connection."""
    random = attack_random("slow")
    with AttackedService(tmp_path, populated=False) as attacked, ExitStack() as stack:
        done, answers = Event(), Counter()

        def predict() -> None:
            with httpx.Client(base_url=attacked.server.url, timeout=DEADLINE) as client:
                while not done.is_set():
                    answers[client.post("/v1/models/panda-sim/predict", json=REFERENCE).status_code] += 1

        other = Thread(target=predict)
        other.start()
        stack.callback(other.join)
        stack.callback(done.set)
        waiting = selectors.DefaultSelector()
        for number in range(CLIENTS):
            made = socket.create_connection(("127.0.0.1", attacked.port), DEADLINE, (ADDRESS, 0))
            stack.enter_context(made)
            head = HEAD.format(random.choice(PATHS)).encode()
            made.sendall(head[: random.randrange(1, len(head) - 4)] if number % 3 == 0 else head)
            waiting.register(made, selectors.EVENT_READ)
        closed, rounds, most = Counter(), 0, CLIENTS + int(3 * (PATIENCE.body_s + PATIENCE.header_s))
        while waiting.get_map():
            assert rounds < most, f"{len(waiting.get_map())} slow clients are still connected"
            for key, _ in waiting.select(1.0):  # a round ends at the first answer, or after a second
                closed[_read_status(key.fileobj)] += 1
                waiting.unregister(key.fileobj)
            rounds += 1
            for key in list(waiting.get_map().values()):
                try:
                    key.fileobj.sendall(random.choice((b"a", b"1", b" ")))
                except ConnectionError:
                    waiting.unregister(key.fileobj)
                    closed[0] += 1
        done.set()
        other.join()
        assert set(closed) <= {0, 400, 408, 415, 422, 429}, closed
        assert closed[408] > CLIENTS // 4, closed
        assert set(answers) == {200}, answers
        attacked.check_sound()


def _read_status(made: socket.socket) -> int:
    """Return the status of an answer, 0 if the connection was closed without one."""
    try:
        answer = made.recv(1 << 16)
    except ConnectionError:
        return 0
    return int(answer.split()[1]) if answer else 0
