"""`lipserve doctor`: verdicts about described machines, and the whole command."""

import gzip
import json
import os
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from service.cli.doctor import clocks, command, loops, processor, resources
from service.cli.doctor.findings import System
from service.foundation.settings import Settings
from service.runtime.realtime import RealTime, Refusal, probe_real_time
from tests.service.cli.conftest import lacking
from tests.service.server import free_port

CPU = "sys/devices/system/cpu"
GROUP2, GROUP1 = (
    {"proc/self/cgroup": "0::/user/lip"},
    {"proc/self/cgroup": "4:cpu,cpuacct:/docker/ab\n3:memory:/docker/ab"},
)
RELEASE = "Linux version 6.1.0-lip (a@b) #1 SMP"
OLD = {"proc/version": f"{RELEASE} now", "boot/config-6.1.0-lip": "CONFIG_X=y\nCONFIG_PREEMPT_VOLUNTARY=y\n"}
IDLE = f"{CPU}/cpu0/cpuidle"
MEMINFO = "MemTotal: 8388608 kB\nMemAvailable: {} kB\nSwapTotal: {} kB"
LIMITED = {"sys/fs/cgroup/memory.max": "2147483648", "sys/fs/cgroup/memory.current": "1610612736"}
SOURCE = "sys/devices/system/clocksource/clocksource0/current_clocksource"


@pytest.fixture
def system(tmp_path):
    """Return a machine that is described by files."""

    def write(files):
        for name, text in files.items():
            path = tmp_path / "machine" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return System(tmp_path / "machine")

    return write


def states(**latencies):
    """Return the files of idle states; a negative latency means that the state is disabled."""
    files = {}
    for number, (name, latency) in enumerate(latencies.items()):
        at = f"{IDLE}/state{number}"
        files |= {f"{at}/name": name, f"{at}/latency": str(abs(latency)), f"{at}/disable": str(int(latency < 0))}
    return files


@pytest.mark.parametrize(
    ("look", "files", "verdict", "value"),
    [
        (processor.quota, {}, "unknown", "not readable"),
        (processor.quota, {**GROUP2, "sys/fs/cgroup/cpu.max": "max 100000"}, "ok", "none"),
        (processor.quota, {**GROUP2, "sys/fs/cgroup/cpu.max": "150000 100000"}, "warning", "1.5 CPUs, each 100 ms"),
        (
            processor.quota,  # the strictest of all groups counts
            {**GROUP2, "sys/fs/cgroup/user/cpu.max": "50000 100000", "sys/fs/cgroup/user/lip/cpu.max": "max 100000"},
            "warning",
            "0.5 CPUs, each 100 ms",
        ),
        (
            processor.quota,
            {
                **GROUP1,
                "sys/fs/cgroup/cpu,cpuacct/cpu.cfs_quota_us": "20000",
                "sys/fs/cgroup/cpu,cpuacct/cpu.cfs_period_us": "10000",
            },
            "warning",
            "2 CPUs, each 10 ms",
        ),
        (
            processor.quota,
            {
                **GROUP1,
                "sys/fs/cgroup/cpu,cpuacct/docker/ab/cpu.cfs_quota_us": "-1",
                "sys/fs/cgroup/cpu,cpuacct/docker/ab/cpu.cfs_period_us": "100000",
            },
            "ok",
            "none",
        ),
        (processor.isolated, {}, "unknown", "not readable"),
        (processor.isolated, {f"{CPU}/isolated": "\n"}, "ok", "none"),
        (processor.isolated, {f"{CPU}/isolated": "2-3\n"}, "ok", "2-3"),
        (processor.preemption, {}, "unknown", "not readable"),
        (processor.preemption, {"proc/version": f"{RELEASE} PREEMPT_RT now"}, "ok", "PREEMPT_RT"),
        (processor.preemption, {**OLD, "sys/kernel/realtime": "1\n"}, "ok", "PREEMPT_RT"),
        (processor.preemption, OLD, "warning", "voluntary"),
        (processor.preemption, {**OLD, "proc/cmdline": "quiet preempt=full"}, "ok", "full"),
        (
            processor.preemption,
            {**OLD, "sys/kernel/debug/sched/preempt": "none (voluntary) full"},
            "warning",
            "voluntary",
        ),
        (processor.preemption, {**OLD, "proc/config.gz": gzip.compress(b"A=1\nCONFIG_PREEMPT=y\n")}, "ok", "full"),
        (processor.preemption, {**OLD, "proc/config.gz": gzip.compress(b"CONFIG_PREEMPT_NONE=y")}, "warning", "none"),
        (processor.preemption, {**OLD, "proc/config.gz": b"damaged"}, "warning", "voluntary"),
        (
            processor.preemption,
            {"proc/version": f"{RELEASE} PREEMPT_DYNAMIC now"},
            "unknown",
            "not readable (PREEMPT_DYNAMIC)",
        ),
        (processor.governor, {}, "unknown", "not readable; in a virtual machine, the host chooses"),
        (
            processor.governor,
            {
                f"{CPU}/cpu0/cpufreq/scaling_governor": "performance\n",
                f"{CPU}/cpu1/cpufreq/scaling_governor": "powersave\n",
                f"{CPU}/intel_pstate/no_turbo": "0",
            },
            "warning",
            "governor performance and powersave, turbo on",
        ),
        (
            processor.governor,
            {f"{CPU}/cpu0/cpufreq/scaling_governor": "performance", f"{CPU}/cpufreq/boost": "0"},
            "ok",
            "governor performance, turbo off",
        ),
        (processor.idle_states, {}, "unknown", "not readable"),
        (processor.idle_states, states(POLL=0, C1=2, C6=133), "warning", "deepest C6, left in 133 µs"),
        (processor.idle_states, states(POLL=0, C1=2, C6=-133), "ok", "deepest C1, left in 2 µs"),
        (processor.real_time_share, {}, "unknown", "not readable"),
        (
            processor.real_time_share,
            {"proc/sys/kernel/sched_rt_runtime_us": "950000", "proc/sys/kernel/sched_rt_period_us": "1000000"},
            "ok",
            "95 % of each 1 s",
        ),
    ],
)
def test_processor_is_judged(system, look, files, verdict, value):
    finding = look(system(files))
    assert (finding.verdict, finding.value) == (verdict, value)
    assert bool(finding.advice) == (verdict == "warning")


@pytest.mark.parametrize(
    ("files", "locked", "found"),
    [
        ({}, True, {"memory": ("unknown", "not readable"), "swap": ("unknown", "not readable")}),
        (
            {"proc/meminfo": MEMINFO.format(4194304, 0)},
            False,
            {"memory": ("ok", "4 GiB free of 8 GiB"), "swap": ("ok", "none")},
        ),
        (
            {"proc/meminfo": MEMINFO.format(524288, 2097152)},
            False,
            {"memory": ("warning", "0.5 GiB free of 8 GiB"), "swap": ("warning", "2 GiB")},
        ),
        (
            {"proc/meminfo": MEMINFO.format(4194304, 2097152), **GROUP2, **LIMITED},
            True,
            {
                "memory": ("warning", "0.5 GiB free of 2 GiB, limit of the control group"),
                "swap": ("ok", "2 GiB; locked pages are not swapped"),
            },
        ),
    ],
)
def test_memory_is_judged(system, files, locked, found):
    findings = {each.name: (each.verdict, each.value) for each in resources.memory(system(files), locked)}
    assert findings == found


MOUNTS = """\
22 1 8:1 / / rw - overlay overlay rw
23 22 0:2 / /mnt/lab\\040disk rw shared:1 - nfs4 host:/a rw
24 22 0:3 / /data rw - tmpfs tmpfs rw
25 22 0:4 / /data rw - ext4 /dev/sda rw
26 24 0:5 / /database rw - xfs /dev/sdb rw
"""


def test_file_system_of_a_folder_is_the_innermost_and_newest_mount(system, tmp_path):
    described = system({"proc/self/mountinfo": MOUNTS})
    kinds = {"/": "overlay", "/mnt/lab disk/x": "nfs4", "/mnt/lab": "overlay", "/data/home": "ext4", "/database": "xfs"}
    for folder, kind in kinds.items():
        assert resources.file_system_of(described, Path(folder)) == kind
    assert resources.file_system_of(System(tmp_path / "nothing"), tmp_path) is None


@pytest.mark.parametrize(
    ("kind", "verdict"), [("ext4", "ok"), ("nfs4", "warning"), ("overlay", "warning"), ("tmpfs", "warning")]
)
def test_disk_of_a_home_that_does_not_exist_yet_is_judged(system, tmp_path, kind, verdict):
    described = system({"proc/self/mountinfo": f"22 1 8:1 / / rw - {kind} x rw"})
    settings = Settings(home=tmp_path / "no" / "home")
    findings = {each.name: each for each in resources.disk(described, settings)}
    assert findings["home"].value == f"{tmp_path}/no/home (does not exist yet)"
    assert (findings["file system"].value, findings["file system"].verdict) == (kind, verdict)
    assert findings["sync of 4 KiB"].verdict in ("ok", "warning")
    assert not list(tmp_path.glob("*doctor*"))


def test_home_that_cannot_be_written_is_not_measured(system, tmp_path, monkeypatch):
    def refuse(folder):
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(resources, "_sync_times", refuse)
    finding = list(resources.disk(system({}), Settings(home=tmp_path)))[-1]
    assert (finding.verdict, finding.value) == ("unknown", "not measured: Read-only file system")


def test_limit_of_open_files_is_compared_with_connections(monkeypatch):
    for limit, verdict in ((256, "warning"), (767, "warning"), (768, "ok"), (-1, "ok")):
        monkeypatch.setattr(resources.resource, "getrlimit", lambda kind, limit=limit: (limit, limit))
        assert resources.open_files(512).verdict == verdict, limit


@pytest.mark.parametrize(
    ("granted", "verdicts", "advice"),
    [
        (RealTime("fifo", 10, True, (3,)), ["ok", "ok"], ""),
        (
            RealTime(refusals=(Refusal("policy", "no permission", "Ask."), Refusal("pages", "too few", "Raise."))),
            ["warning", "warning"],
            "Ask.Raise.",
        ),
        (
            RealTime(refusals=(Refusal("policy", "the system is not Linux", "Use it."),)),
            ["warning", "unknown"],
            "Use it.",
        ),
    ],
)
def test_priorities_repeat_what_real_time_reports(system, granted, verdicts, advice):
    policy, pages, *_ = processor.priorities(system({}), granted)
    assert [policy.verdict, pages.verdict] == verdicts
    assert policy.advice + pages.advice == advice
    assert "CPU 3" in policy.value or granted.cpus is None


def test_clock_source_is_judged(system):
    for source, verdict in (("tsc", "ok"), ("kvm-clock", "ok"), ("hpet", "warning")):
        assert next(clocks.clocks(system({SOURCE: source}))).verdict == verdict
    state = clocks.Adjustment(max_error=2500, status=1)
    assert clocks.synchronisation(state)[2:4] == ("synchronised, error at most 2.5 ms", "ok")
    state.status |= 0x40
    assert clocks.synchronisation(state).verdict == "warning"
    assert clocks.synchronisation(None).verdict == "unknown"
    assert clocks.step(1e-3).verdict == "ok"
    assert clocks.step(-3600.0)[2:4] == ("-3.6e+03 s", "warning")


def test_load_is_the_share_of_time_that_is_not_idle(system):
    before = processor.cpu_times(system({"proc/stat": "cpu  100 0 100 1000 0 0 0 0 0 0\ncpu0 1 2 3"}))
    for now, verdicts in (
        ("cpu  150 0 100 1040 10 0 0 0 0 0", {"load": ("ok", "50 %")}),
        ("cpu  180 0 100 1020 0 0 0 0 0 0", {"load": ("warning", "80 %")}),
        ("cpu  140 0 100 1055 0 0 0 5 0 0", {"load": ("ok", "45 %"), "stolen time": ("warning", "5.0 %")}),
    ):
        after = processor.cpu_times(system({"proc/stat": now}))
        found = {each.name: (each.verdict, each.value.partition(" of")[0]) for each in processor.load(before, after)}
        assert found == verdicts
    assert [each.verdict for each in processor.load([], [])] == ["unknown"]


def test_machine_that_describes_nothing_is_unknown_but_not_an_error(system, monkeypatch):
    """As in a container without /sys and /proc, and on macOS."""
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    monkeypatch.delattr(processor.resource, "RLIMIT_NICE", raising=False)
    monkeypatch.setattr(clocks, "_adjustment", lambda: None)
    nothing = system({})
    found = [*processor.processor(nothing), *clocks.clocks(nothing), *resources.memory(nothing, False)]
    unknown = {each.name for each in found if each.verdict == "unknown"}
    assert unknown >= {"CPU quota", "isolated CPUs", "preemption", "frequency", "idle states", "clock source", "swap"}
    assert processor.cpus(nothing).value == str(os.cpu_count())
    assert "may not be lowered" in processor.niceness().value


@pytest.fixture
def in_home(monkeypatch, tmp_path):
    """Set an empty home, and measure at two rates only."""
    monkeypatch.setenv("LIPSERVE_HOME", str(tmp_path))
    monkeypatch.setattr(loops, "RATES_HZ", (250, 1000))
    monkeypatch.setattr(resources, "SYNCS", 3)


@pytest.mark.usefixtures("in_home")
def test_machine_is_examined_without_a_service(lipserve):
    code, out, err = lipserve("doctor", "--seconds", 0.05, "--json")
    assert code == 0, err
    told, granted = json.loads(out), probe_real_time()
    assert all(each["verdict"] in ("ok", "warning", "unknown") for each in told["findings"] + told["loops"])
    assert all(bool(each["advice"]) == (each["verdict"] == "warning") for each in told["findings"])
    policies = ["plain", *(["SCHED_FIFO"] if granted.policy == "fifo" else [])]
    assert [(each["policy"], each["rate_hz"]) for each in told["loops"]] == [
        (policy, rate) for policy in policies for rate in loops.RATES_HZ
    ]
    assert (told["real_time"]["policy"], told["real_time"]["priority"]) == (granted.policy, granted.priority)
    names = {each["name"] for each in told["findings"]}
    assert names >= {"CPUs", "SCHED_FIFO", "locked pages", "clock source", "memory", "file system", "load"}
    for policy in policies:
        held = [each["rate_hz"] for each in told["loops"] if (each["policy"], each["verdict"]) == (policy, "ok")]
        (rate,) = (each for each in told["findings"] if each["name"] == f"wake-up, {policy}")
        assert rate["value"].startswith(f"{max(held)} Hz" if held else "none of")


@pytest.mark.usefixtures("in_home")
def test_grants_and_refusals_are_printed_as_json(lipserve, monkeypatch):
    for granted in (RealTime("other", 0, True, (1,)), RealTime(refusals=(Refusal("pages", "too few", "Raise."),))):
        monkeypatch.setattr(command, "probe_real_time", lambda granted=granted: granted)
        told = json.loads(lipserve("doctor", "--seconds", 0.05, "--json")[1])["real_time"]
        assert told == json.loads(json.dumps(asdict(granted)))


@pytest.mark.usefixtures("in_home")
def test_service_is_measured_by_echo_and_torque(run_on_server):
    code, out, err = run_on_server("doctor", "--model", "panda-sim", "--seconds", 0.05)
    assert code == 0, err
    assert lacking(out, "Processor", "Priority", "Clock", "Memory", "Disk", "Highest loop rate") == []
    rows = [[cell.strip() for cell in line.split("│")[1:4]] for line in out.splitlines() if line.startswith("│")]
    best = "SCHED_FIFO" if probe_real_time().policy == "fifo" else "plain"
    for what, policy in (("wake-up", "plain"), ("echo", best), ("torque", best)):
        verdicts = [verdict for verdict, *kind in rows if kind == [what, policy]]
        assert len(verdicts) == len(loops.RATES_HZ)
        assert set(verdicts) <= {"ok", "warning"}
        assert f"{what}, {policy}  " in out
    told = json.loads(run_on_server("doctor", "--seconds", 0.05, "--json")[1])
    assert [each["rate_hz"] for each in told["loops"] if each["what"] == "echo"] == list(loops.RATES_HZ)
    assert "torque" not in {each["what"] for each in told["loops"]}


def test_echo_returns_the_query(server):
    with loops.EchoClient("echo", server.url) as stream:
        sent = []
        stream._socket.send, send = sent.append, stream._socket.send
        stream.send(*np.arange(21.0).reshape(3, 7))
        send(sent[0])
        assert stream._socket.recv(10.0) == sent[0]


@pytest.mark.usefixtures("in_home")
def test_service_that_does_not_answer_is_reported_before_anything_is_measured(lipserve, run_rejected_command):
    code, out, err = lipserve("doctor", "--url", f"http://127.0.0.1:{free_port()}", "--seconds", 600)
    assert (code, out, "lipserve serve" in err) == (1, "", True)
    assert "no model" in run_rejected_command("doctor", "--model", "no-such-model", "--seconds", 600)
