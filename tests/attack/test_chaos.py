"""Chaos of a model's history: learning, unlearning, replays, rollbacks, options and aliases, between kills.

After each kill all snapshots are lost, so that the service learns its log again: the answer must stay the same.
"""

import shutil
from collections.abc import Callable, Iterator
from random import Random
from typing import Any

import numpy as np
import pytest

from tests.attack.attacked import AttackedService, attack_random
from tests.service.data import eventually
from tests.system.faults.ledger import ARM, STREAM_ID, batch, list_items, predict_queries, query_rows
from tests.system.faults.storage import lock_database

ROUNDS, ACTIONS = 4, 20
MAX_RELATIVE_DIFFERENCE = 1e-9
"""Largest difference of a torque after a restart, relative to the largest torque: the learner sums in another order."""
OPTIONS = {"contact_threshold": 100.0, "on_change": "learn", "auto_refresh": False}
MODEL = f"/v1/models/{ARM}"


class History:
    """A service, and what it has acknowledged: the state of each batch, the options, the versions of aliases."""

    def __init__(self, attacked: AttackedService, random: Random) -> None:
        self.attacked, self.random = attacked, random
        self.batches: dict[int, str] = {}
        self.bodies: dict[int, dict[str, Any]] = {}
        self.options: dict[str, Any] = OPTIONS
        self.aliases: dict[str, int] = {}
        self.serving = 1

    def request(self, method: str, path: str, *statuses: int, **options: Any) -> Any:
        """Send a request; return the body of its answer, None if it was rejected with one of these statuses."""
        answer = self.attacked.client.request(method, f"{MODEL}/{path}", **options)
        if answer.status_code in statuses:
            return None
        assert answer.status_code in (200, 204), (path, answer.text)
        return answer.json() if answer.content else {}

    def observe(self) -> None:
        """Send one or more new batches, or one that was sent before."""
        if self.batches and self.random.random() < 0.2:
            sequence = self.random.choice(list(self.batches))
            seen = self.request("POST", "observations", json=self.bodies[sequence])
            assert (seen["duplicate"], seen["state"]) == (True, self.batches[sequence])
            return
        for _ in range(self.random.randrange(1, 4)):
            sequence = max(self.batches, default=-1) + 1
            self.bodies[sequence] = body = batch(sequence)
            if self.random.random() < 0.3:  # rows that are kept out, for replays
                body["t"] = [time + 3600.0 for time in body["t"]]
            self.request("POST", "observations", json=body)
            self.batches[sequence] = "learnt"

    def unlearn(self) -> None:
        sequence = self.random.choice(list(self.batches) or [0])
        if self.request("DELETE", f"observations/{STREAM_ID}/{sequence}", 404, 409) is not None:
            assert self.batches[sequence] == "learnt"
            self.batches[sequence] = "unlearnt"

    def replay(self) -> None:
        sequence = self.random.choice(list(self.batches) or [0])
        self.request("POST", f"observations/{STREAM_ID}/{sequence}/replay", 404, 409, 422, json={})

    def roll_back(self) -> None:
        """Roll back to a revision; later batches and time constants are undone."""
        newest = predict_queries(self.attacked.client, ARM)["revision"]
        if self.request("POST", "rollback", 409, 422, json={"revision": self.random.randrange(newest + 1)}) is None:
            return
        for sequence in self.batches:
            self.batches[sequence] = self.request("GET", f"observations/{STREAM_ID}/{sequence}")["state"]
        self.options = self.request("GET", "learning")["options"]

    def serve_other_version(self) -> None:
        self.serving = 3 - self.serving
        self.request("POST", "rollback", json={"version": self.serving})

    def set_options(self) -> None:
        forgetting = self.random.choice((None, None, 600.0, 1e6))
        enabled = self.random.random() < 0.8
        self.options = OPTIONS | {"forgetting_s": forgetting, "enabled": enabled}
        self.request("PUT", "learning", json=self.options)

    def move_alias(self) -> None:
        alias, version = self.random.choice(("production", "staging")), self.random.randrange(1, 4)
        if version < 3:
            self.request("PUT", f"aliases/{alias}", json={"version": version})
            self.aliases[alias] = version
        elif self.request("DELETE", f"aliases/{alias}", 404) is not None:
            del self.aliases[alias]

    def lock_storage(self) -> None:
        """Send a batch while another process holds the database for a moment."""
        with lock_database(self.attacked.home / "lipserve.sqlite3"):
            predict_queries(self.attacked.client, ARM)

    def check(self) -> None:
        """Compare the service with what it has acknowledged."""
        for sequence, state in self.batches.items():
            assert self.request("GET", f"observations/{STREAM_ID}/{sequence}")["state"] == state, sequence
        found = self.request("GET", "learning")["options"]
        assert {name: found[name] for name in self.options} == self.options
        aliases = {each["alias"]: each["version"] for each in list_items(self.attacked.client, f"{MODEL}/aliases")}
        assert aliases == {"serving": self.serving, **self.aliases}
        numbers = [row[0] for row in query_rows(self.attacked.home, EVENTS, ARM)]
        assert numbers == list(range(1, len(numbers) + 1))

    def settled_answer(self) -> dict[str, Any]:
        """Return the answer that contains everything logged."""
        start = query_rows(self.attacked.home, STARTS, ARM, self.serving)
        numbers = query_rows(self.attacked.home, EVENTS, ARM)
        newest = len(numbers) - (start[0][0] if start else 0)
        return eventually(lambda: (seen := predict_queries(self.attacked.client, ARM))["revision"] >= newest and seen)


EVENTS = "SELECT number FROM events WHERE model = ? ORDER BY number"
STARTS = "SELECT start FROM learners WHERE model = ? AND version = ?"
CHANCES: dict[Callable[[History], None], int] = {
    History.observe: 10,
    History.unlearn: 3,
    History.replay: 3,
    History.roll_back: 2,
    History.serve_other_version: 1,
    History.set_options: 2,
    History.move_alias: 2,
    History.lock_storage: 1,
}


@pytest.fixture(scope="module")
def attacked(tmp_path_factory: pytest.TempPathFactory) -> Iterator[AttackedService]:
    with AttackedService(tmp_path_factory.mktemp("chaos")) as service:
        yield service


def lose_snapshots(attacked: AttackedService) -> None:
    """Kill the service, delete the files of all snapshots, and start it again."""
    attacked.server.kill()
    attacked.server.client.close()
    shutil.rmtree(attacked.home / "learning")
    (attacked.home / "learning").mkdir()
    attacked.start()


def test_history_survives_kills_and_loss_of_all_snapshots(attacked):
    random = attack_random("chaos")
    history = History(attacked, random)
    history.request("PUT", "learning", json=OPTIONS)
    for number in range(ROUNDS):
        for action in random.choices(list(CHANCES), list(CHANCES.values()), k=ACTIONS):
            action(history)
        before = history.settled_answer()
        history.check()
        if number % 2:
            attacked.restart()
        else:
            lose_snapshots(attacked)
        history.check()
        after = history.settled_answer()
        assert (after["version"], after["revision"]) == (before["version"], before["revision"])
        for name in ("tau", "tau_std"):
            expected = np.array(before[name])
            tolerance = MAX_RELATIVE_DIFFERENCE * np.abs(expected).max()
            np.testing.assert_allclose(np.array(after[name]), expected, rtol=0, atol=tolerance, err_msg=name)
    attacked.check_sound()
