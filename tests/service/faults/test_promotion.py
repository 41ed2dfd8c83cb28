"""A process killed while a refreshed version takes over: it has done so as a whole, or not at all."""

import os
import signal
import subprocess
import sys

import pytest

from service.storage.database import Database, LearnerRow
from tests.service.faults.house import House
from tests.service.faults.injection import COMMIT, Fault
from tests.service.faults.ledger import ARM, predicted, rows

pytestmark = pytest.mark.slow
DECIDE = "service.learning.refresh:decide"
POINTS = {
    "roles are changed": (Fault("service.models.registry:serve", "after", DECIDE, "itself"), False),
    "before the commit": (Fault(COMMIT, "before", DECIDE, "itself"), False),
    "after the commit": (Fault(COMMIT, "after", DECIDE, "itself"), True),
    "before it answers": (Fault("service.models.loaded:LoadedModels.adopt", "before", DECIDE, "itself"), True),
}
VERDICT = f"""
import sys
from pathlib import Path
from service.foundation.settings import Settings
from service.storage.storage import Storage
from service.learning.learner.learnt import LearntVersions
from service.models.loaded import LoadedModels
from service.learning.learner.publication import Contested
from service.learning import refresh

storage = Storage.open(Settings(home=Path(sys.argv[1])))
loaded = LoadedModels(storage, LearntVersions(storage.database, storage.files), 2)
loaded.preload()
refresh.decide(storage.database, loaded, print, Contested("{ARM}", 1, 2, "promote", {{"rows": 700}}))
"""
"""What a service does with the verdict of a contest, which takes minutes to come to."""


@pytest.mark.parametrize(("fault", "promoted"), POINTS.values(), ids=POINTS)
def test_a_version_takes_over_as_a_whole_or_not_at_all(tmp_path, fault, promoted):
    house = House(tmp_path, {fault.target for fault, _ in POINTS.values()})
    make_rival(house)
    house.injector.arm(fault, 0)
    environment = {**os.environ, **house.injector.environment}
    ended = subprocess.run([sys.executable, "-c", VERDICT, str(house.home)], env=environment, check=False)
    assert ended.returncode == -signal.SIGKILL
    assert house.injector.happened() is not None
    house.injector.disarm()

    house.ledger.serving = 2 if promoted else 1
    with house:
        house.verify()
        roles = rows(house.home, "SELECT version, role FROM learners WHERE model = ? ORDER BY version", ARM)
        assert roles == ([(1, "dismissed"), (2, "serving")] if promoted else [(1, "serving"), (2, "candidate")])
        alarms = house.client.get(f"/v1/models/{ARM}/alarms").json()["items"]
        assert [each["evidence"]["promoted"] for each in alarms] == [True] * promoted
        assert predicted(house.client, ARM)["version"] == house.ledger.serving


def make_rival(house: House) -> None:
    """Let the second version of the model be a candidate again."""
    database = Database(house.home)
    with database.transaction() as session:
        session.get_one(LearnerRow, (ARM, 2)).role = "candidate"
    database.close()
