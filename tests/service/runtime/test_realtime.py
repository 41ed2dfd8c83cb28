"""Real-time scheduling: what is reported is what the kernel says, with and without permission.

Each case enters real time in a process of its own, which tells what `enter_real_time` returned and what the kernel has.
"""

import json
import os
import resource
import subprocess
import sys

import pytest

from service.runtime import realtime

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="SCHED_FIFO and /proc are Linux")

ENTER = """
import json, mmap, os, resource, sys, threading
from dataclasses import asdict
from pathlib import Path
from service.runtime import realtime

case = json.loads(sys.argv[1])
try:
    for name, limit in case.get("limits", {}).items():
        resource.setrlimit(getattr(resource, name), limit)
except ValueError:  # only with CAP_SYS_RESOURCE a process raises its hard limits
    sys.exit("no permission")
if case.get("one_cpu"):
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:1])
if "rt_time" in case:
    for name, text in zip(("runtime", "period"), case["rt_time"]):
        Path(name).write_text(text)
    realtime._RT_TIME = Path("runtime"), Path("period")
if "isolated" in case:
    Path("isolated").write_text(case["isolated"])
    realtime._ISOLATED = Path("isolated")
if case.get("drop"):
    os.setresuid(65534, 65534, 65534)  # without capabilities

def kernel():
    status = dict(line.split(":", 1) for line in Path("/proc/thread-self/status").read_text().splitlines())
    policy = os.sched_getscheduler(0)
    return {
        "policy": policy & ~os.SCHED_RESET_ON_FORK,
        "reset_on_fork": bool(policy & os.SCHED_RESET_ON_FORK),
        "priority": os.sched_getparam(0).sched_priority,
        "locked_kib": int(status["VmLck"].split()[0]),
        "resident_kib": int(status["VmRSS"].split()[0]),
        "cpus": sorted(os.sched_getaffinity(0)),
    }

def in_child():
    read, write = os.pipe()
    if os.fork() == 0:
        os.write(write, json.dumps(kernel()).encode())
        os._exit(0)
    os.wait()
    return json.loads(os.read(read, 10_000))

told, started = {}, []
probed = realtime.probe_real_time()
unused = mmap.mmap(-1, 256 << 20)
told["after_probe"] = kernel()
granted = realtime.enter_real_time(**case.get("arguments", {}))
told["kernel"] = kernel()
thread = threading.Thread(target=lambda: started.append(kernel()))
thread.start()
thread.join()
told["thread"], told["child"] = started[0], in_child()
grown = bytearray(32 << 20)  # an allocation after the lock succeeds
told["probed"], told["granted"] = asdict(probed), asdict(granted)
print(json.dumps(told))
"""


@pytest.fixture
def enter(tmp_path):
    """Enter real time in a process; return what it told."""

    def run(**case):
        done = subprocess.run(
            [sys.executable, "-c", ENTER, json.dumps(case)],
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        if done.stderr == "no permission\n":
            pytest.skip("limits may not be raised")
        assert done.returncode == 0, done.stderr
        told = json.loads(done.stdout)
        assert_consistent(told, case.get("arguments", {}))
        return told

    return run


def assert_consistent(told, arguments):
    """Compare the report with the kernel."""
    granted, kernel = told["granted"], told["kernel"]
    assert told["after_probe"]["policy"] == os.SCHED_OTHER
    assert told["after_probe"]["locked_kib"] == 0
    assert {"fifo": os.SCHED_FIFO, "other": os.SCHED_OTHER}[granted["policy"]] == kernel["policy"]
    assert granted["priority"] == kernel["priority"]
    assert granted["pages_locked"] == (kernel["locked_kib"] > 0)
    assert granted["cpus"] in (None, kernel["cpus"])
    refused = {each["what"] for each in granted["refusals"]}
    assert ("policy" in refused) == (granted["policy"] == "other")
    assert all(each["reason"] and each["remedy"] for each in granted["refusals"])
    if not arguments:
        assert told["probed"] == granted
        assert ("pages" in refused) == (not granted["pages_locked"])
        for heir in (told["thread"], told["child"]):
            assert (heir["policy"], heir["priority"]) == (os.SCHED_OTHER, 0)
    assert told["child"]["locked_kib"] == 0
    assert kernel["resident_kib"] < told["after_probe"]["resident_kib"] + 128 * 1024  # unused memory is not filled


IS_ROOT = hasattr(os, "geteuid") and os.geteuid() == 0


def test_what_is_granted_is_what_the_kernel_says(enter):
    enter()


def test_without_permission_nothing_is_granted(enter):
    told = enter(drop=IS_ROOT, limits={"RLIMIT_RTPRIO": (0, 0), "RLIMIT_MEMLOCK": (65536, 65536)})
    assert (told["granted"]["policy"], told["granted"]["pages_locked"]) == ("other", False)
    policy, pages = (each["reason"] for each in told["granted"]["refusals"])
    assert policy == "RLIMIT_RTPRIO is 0 and CAP_SYS_NICE is missing"
    assert pages == "RLIMIT_MEMLOCK is 64 KiB and CAP_IPC_LOCK is missing"


def test_hard_limits_permit_a_lower_priority_and_locked_pages(enter):
    told = enter(drop=True, limits={"RLIMIT_RTPRIO": (0, 5), "RLIMIT_MEMLOCK": (0, -1)})
    granted = told["granted"]
    assert granted["pages_locked"]
    assert granted["priority"] == 5 or "control group" in granted["refusals"][0]["reason"]


@pytest.mark.parametrize(
    ("limit", "most", "priority"), [(5, 5, 5), (5, 99, 10), (-1, 99, 10), (99, 10, 10), (5, 0, 0), (0, 0, 0)]
)
def test_highest_permitted_priority_is_used(monkeypatch, limit, most, priority):
    """limit: RLIMIT_RTPRIO; most: the highest priority that the kernel grants."""
    granted = []

    def set_scheduler(thread, policy, parameters):
        if parameters.sched_priority > most:
            raise PermissionError
        granted.append(parameters.sched_priority)

    monkeypatch.setattr(realtime, "_raised", lambda kind: limit if kind == resource.RLIMIT_RTPRIO else -1)
    monkeypatch.setattr(os, "sched_setscheduler", set_scheduler)
    told = realtime.enter_real_time(10, lock_pages=False)
    assert (told.priority, granted) == (priority, [priority] if priority else [])
    assert [("control group" in each.reason) for each in told.refusals] == ([] if priority else [limit != 0])


def test_threads_inherit_on_request(enter):
    told = enter(arguments={"inherit": True, "lock_pages": False})
    for heir in (told["thread"], told["child"]):
        assert heir["policy"] == told["kernel"]["policy"]
        assert heir["priority"] == told["granted"]["priority"]
    assert not told["granted"]["pages_locked"]


def test_limit_that_kills_busy_threads_keeps_plain_priority(enter):
    granted = enter(limits={"RLIMIT_RTTIME": (200_000, 300_000)})["granted"]
    assert granted["policy"] == "other"
    assert granted["refusals"][0]["reason"].startswith("RLIMIT_RTTIME is 300000 µs")


@pytest.mark.parametrize(
    ("rt_time", "endangers"),
    [(("-1", "1000000"), True), (("1000000", "1000000"), True), (("950000", "1000000"), False), (("", ""), False)],
)
def test_thread_without_end_cannot_halt_the_only_cpu(enter, rt_time, endangers):
    for one_cpu in (True, False) if endangers and len(os.sched_getaffinity(0)) > 1 else (True,):
        reasons = [each["reason"] for each in enter(one_cpu=one_cpu, rt_time=rt_time)["granted"]["refusals"]]
        assert any("there is one CPU" in each for each in reasons) == (one_cpu and endangers)


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity") or len(os.sched_getaffinity(0)) < 2, reason="needs two CPUs")
def test_only_an_isolated_cpu_is_pinned(enter):
    last = max(os.sched_getaffinity(0))
    told = enter(isolated=f"{last}-{last + 3}\n")
    if told["granted"]["policy"] == "fifo":
        assert told["granted"]["cpus"] == [last]
    assert enter(isolated=f"{last + 1},{last + 3}")["granted"]["cpus"] is None
    assert enter(isolated=str(last), one_cpu=True)["granted"]["cpus"] is None


def test_lists_of_cpus_are_read(tmp_path):
    for text, cpus in (("", set()), ("\n", set()), ("3", {3}), ("0-2,5\n", {0, 1, 2, 5}), ("none", set())):
        (tmp_path / "list").write_text(text)
        assert realtime.read_cpus(tmp_path / "list") == cpus
    assert realtime.read_cpus(tmp_path / "missing") == set()


def test_other_systems_grant_nothing(monkeypatch):
    monkeypatch.setattr(sys, "platform", "darwin")
    for granted in (realtime.enter_real_time(), realtime.probe_real_time()):
        assert (granted.policy, granted.priority, granted.pages_locked, granted.cpus) == ("other", 0, False, None)
        assert granted.refusals[0].what == "policy"
