"""A motion whose requests both planes answer is one motion."""

import sys

import httpx
import numpy as np
import pytest
from numpy.testing import assert_allclose

from lipcore.kernels.drive.play import PlayState, element_widths
from tests.service.api.oip.requests import infer_path, message, tensors
from tests.service.api.oip.test_sequences import EXACT, NAME, model, slow_motion
from tests.service.data import eventually
from tests.service.models.archives.packing import exported, imported
from tests.service.planes.test_sums import LIVE, ids, is_from, two_planes

__all__ = ["model"]  # a fixture
pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform != "linux", reason="planes need Linux")]
PARTS = (slice(0, 1), slice(1, 4), slice(4, 5), slice(5, 6), slice(6, 20), slice(20, 21))


def test_small_and_large_requests_of_a_sequence_are_one_motion(api, model, tmp_path):
    motion = slow_motion(21)
    motion["dq"][:] = 0.0  # explains its steps, whenever requests arrive
    deflections, _ = PlayState.unknown(2).follow(
        np.zeros(21), motion["q"], motion["dq"], element_widths(model.joint_types)
    )
    expected, alone = model.predict(**motion, deflections=deflections).tau, model.predict(**motion).tau
    assert np.abs(expected - alone)[1:].max() > 1e-3
    no_gap = {"lipcore.kernels.drive.play.MAX_GAP_S": 1e9}
    with two_planes(tmp_path / "home", no_gap) as server, httpx.Client(base_url=server.url) as client:
        imported(client, exported(api, NAME), name=NAME, promotion="always")
        data_plane = ids(server, LIVE)

        def ask(part, sequence):
            rows = {
                name: (values[part][0] if part.stop == part.start + 1 else values[part])
                for name, values in motion.items()
            }
            answer = client.post(infer_path(NAME), json=message(rows, "tau", parameters={"sequence_id": sequence}))
            return is_from(data_plane, answer), tensors(answer.json())["tau"].reshape(-1, 2)

        eventually(lambda: ask(slice(0, 1), 1)[0])
        planes = set()
        for part in PARTS:
            by_data_plane, tau = ask(part, 2)
            planes.add(by_data_plane)
            assert_allclose(tau, expected[part], **EXACT)
        assert planes == {True, False}
