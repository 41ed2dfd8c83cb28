"""The demo, as a new user runs it."""

import os
import re
import subprocess
import sys

import pytest

DEADLINE = 600
ROW = re.compile(r"(panda_joint[1-7]) +│ +([0-9.]+) │ ([0-9.e+-]+) │ +([0-9.]+) │ +([0-9.]+) %")


def demo(home, *options):
    return subprocess.run(
        [sys.executable, "-m", "service", "demo", "--once", "--port", "0", *options],
        env={**os.environ, "LIPSERVE_HOME": str(home)},
        capture_output=True,
        text=True,
        timeout=DEADLINE,
        check=False,
    )


@pytest.mark.slow
def test_demo_learns_a_panda_and_predicts_unseen_trajectories(tmp_path):
    ended = demo(tmp_path / "home", "--plot", str(tmp_path / "demo.png"))
    assert ended.returncode == 0, ended.stdout + ended.stderr
    rows = ROW.findall(ended.stdout)
    assert [joint for joint, *_ in rows] == [f"panda_joint{j}" for j in range(1, 8)] * 2
    for joint, _, nmse, _, coverage in rows:
        if joint != "panda_joint7":  # its torque is hardly above the sensor noise
            assert float(nmse) < 0.02
        assert float(coverage) > 80
    assert (tmp_path / "demo.png").stat().st_size > 10_000
