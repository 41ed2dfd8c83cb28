"""Damaged homes, page by page: what is served is right, or an error that names the damage."""

import shutil
from dataclasses import dataclass, field
from json import JSONDecodeError
from pathlib import Path
from random import Random
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy.exc import SQLAlchemyError

from service.app import create_app
from service.cli.verify import verify_home
from service.foundation.settings import Settings
from service.storage.database.engine import FILE
from service.storage.storage import HomeError, check_home, explain_home_errors
from tests.attack.attacked import AttackedService, attack_random, query
from tests.service.data import ADDRESS, eventually, stream, upload
from tests.system.faults.ledger import ARM, QUERIES, batch, predict_queries, query_rows

PAGE = 4096
DATABASE_PAGES, FILE_PAGES = 24, 24
"""Pages that are damaged, each in a home of its own."""
BATCHES = 8
DAMAGED = {"unreadable_version", "damaged_data"}
"""Codes of errors that name a damaged object."""
Numbers = tuple[list[list[float]], list[list[float]]]


@dataclass
class UsedHome:
    """A home, and all correct answers by model, version and revision."""

    path: Path
    answers: dict[tuple[str, int, int], Numbers] = field(default_factory=dict)
    dataset: str = ""

    def note(self, client: Any, model: str, **wanted: Any) -> int:
        """Remember an answer; return its revision."""
        seen = predict_queries(client, model, **wanted)
        self.answers[model, seen["version"], seen["revision"]] = seen["tau"], seen["tau_std"]
        return seen["revision"]


@pytest.fixture(scope="module")
def used_home(tmp_path_factory: pytest.TempPathFactory) -> UsedHome:
    """A home whose model has learnt batches, revision by revision."""
    with AttackedService(tmp_path_factory.mktemp("damage"), PUBLISH_EVERY_S="0.001") as service:
        used = UsedHome(service.home)
        used.dataset = upload(service.client, stream(samples=60))["id"]
        for number in (1, 2):
            used.note(service.client, ARM, version=number)
        for sequence in range(BATCHES):
            answer = service.client.post(f"/v1/models/{ARM}/observations", json=batch(sequence)).json()
            eventually(lambda at=answer["revision"]: used.note(service.client, ARM) >= at)
        snapshot = "SELECT id FROM snapshots WHERE model = ? AND number >= ?"
        newest = "SELECT max(number) FROM events WHERE model = ?"
        eventually(lambda: query_rows(used.path, snapshot, ARM, query_rows(used.path, newest, ARM)[0][0]))
        service.check_sound()
        service.server.terminate()
    return used


def flip_page(path: Path, page: int, random: Random) -> None:
    """Flip some bits of a page, or overwrite it."""
    content = bytearray(path.read_bytes())
    start, end = page * PAGE, min((page + 1) * PAGE, len(content))
    if random.random() < 0.3:
        content[start:end] = random.choice((bytes(end - start), random.randbytes(end - start)))
    else:
        for _ in range(random.randrange(1, 30)):
            content[random.randrange(start, end)] ^= 1 << random.randrange(8)
    path.write_bytes(content)


def damages_of(home: Path) -> list[str]:
    """Return what `lipserve verify` reports; an unreadable database counts as one damage."""
    settings = Settings(home=home)
    try:
        with explain_home_errors(settings):  # as the command does
            return [str(each) for each in verify_home(settings).damages]
    except HomeError as error:
        return [f"database: {error}"]


def check_answers(home: Path, used: UsedHome) -> set[str]:
    """Start a service on a damaged home, if it starts; check its answers and return the codes of its errors."""
    settings, codes = Settings(home=home, publish_every_s=0.001, learner_niceness=0), set()
    try:
        check_home(settings)  # as `lipserve serve` does first
        with TestClient(create_app(settings), ADDRESS, raise_server_exceptions=False) as client:
            for version in (None, 1, 2):
                wanted = QUERIES if version is None else QUERIES | {"version": version}
                answer = client.post(f"/v1/models/{ARM}/predict", json=wanted)
                if answer.status_code == 200:
                    seen = query(answer)
                    known = used.answers.get((ARM, seen["version"], seen["revision"]))
                    assert known is None or known == (seen["tau"], seen["tau_std"]), "a wrong answer"
                else:
                    codes.add(answer.json()["error"]["code"])
    except HomeError:
        codes.add("home")
    return codes


def files_of(home: Path) -> list[Path]:
    """Return the files whose contents are served, in a fixed order."""
    found = (*home.glob("versions/mv_arm*/*"), *home.glob("learning/*.safetensors"), *home.glob("datasets/*"))
    return sorted(path for path in found if path.is_file())


def test_each_damaged_file_page_is_found(used_home, tmp_path):
    random, files = attack_random("files"), files_of(used_home.path)
    pages = [(path, page) for path in files for page in range(-(-path.stat().st_size // PAGE))]
    for number, (path, page) in enumerate(random.sample(pages, min(FILE_PAGES, len(pages)))):
        home = shutil.copytree(used_home.path, tmp_path / str(number))
        spoilt = home / path.relative_to(used_home.path)
        before = spoilt.read_bytes()
        flip_page(spoilt, page, random)
        if spoilt.read_bytes() == before:
            continue
        place = f"page {page} of {path.relative_to(used_home.path)}"
        assert damages_of(home), f"{place}: verify reports nothing"
        codes = check_answers(home, used_home)
        assert codes <= DAMAGED, place
        if "mv_arm1" in str(spoilt):
            assert codes == {"unreadable_version"}, place
        shutil.rmtree(home)


def test_no_damaged_database_page_leads_to_a_wrong_answer(used_home, tmp_path):
    random = attack_random("database")
    wrong: list[str] = []
    codes: set[str] = set()
    pages = range(-(-(used_home.path / FILE).stat().st_size // PAGE))
    for number, page in enumerate(random.sample(pages, DATABASE_PAGES)):
        home = shutil.copytree(used_home.path, tmp_path / str(number))
        flip_page(home / FILE, page, random)
        found = damages_of(home)
        try:
            codes = check_answers(home, used_home)
        except AssertionError as error:
            wrong.append(f"page {page}: {error}")
        except (SQLAlchemyError, JSONDecodeError) as error:
            wrong.append(f"page {page}: {error!r} instead of advice")
        except Exception as error:  # a readable text with other contents: the service does not start
            codes = {repr(error)}
        if codes - {"no_serving_version", "not_found"} and not found:
            wrong.append(f"page {page}: {codes}, but verify reports nothing")
        shutil.rmtree(home)
    assert wrong == []
